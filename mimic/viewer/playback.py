"""Frames of a trained policy's rollouts. Needs no browser."""

import functools

import numpy as np

from mimic.arms.arm import build_arm
from mimic.envs.config import EnvConfig
from mimic.evaluation.evaluator import Evaluator, Rollouts
from mimic.evaluation.rollout_frames import RolloutFrames, demonstration_index
from mimic.evaluation.rollout_metrics import gaps
from mimic.metric.similarity import centre_line_table, similarity
from mimic.viewer import html
from mimic.viewer.live_session import Frame

FRAMES_PER_SECOND = 30
_SAMPLES = 32  # samples of the centre lines in a frame: half the default number, to be fast


class Playback:
    """Rollouts of the policy of a run on its demonstrations.

    Args:
      env: environment of the run.
      evaluator: evaluator of the run.
      rollouts: of all demonstrations.
    """

    def __init__(self, env: EnvConfig, evaluator: Evaluator, rollouts: Rollouts):
        self._evaluator, self._rollouts = evaluator, rollouts
        self._locked = dict(build_arm(env.learner, env.limits).locked)
        self._rollout = functools.lru_cache(maxsize=16)(self._compute_rollout)

    def count(self, split: str) -> int:
        """Number of demonstrations in a split."""
        return len(range(self._evaluator.env.demonstrations.count)[self._evaluator.parts[split]])

    def _compute_rollout(self, split: str, demonstration: int) -> RolloutFrames:
        index = demonstration_index(self._evaluator, split, demonstration)
        return RolloutFrames(self._evaluator, self._rollouts, index, FRAMES_PER_SECOND)

    def frame(self, split: str, demonstration: int, time: float) -> Frame:
        """Frame of an episode at a time since its start [s]."""
        rollout, env = self._rollout(split, demonstration), self._evaluator.env
        frame_index = int(np.clip(round(time * FRAMES_PER_SECOND), 0, rollout.num_frames - 1))
        step = min(int(rollout.time[frame_index] / rollout.dt), len(rollout.distance) - 1)
        return Frame(
            expert=dict(zip(env.expert.joint_names, map(float, rollout.expert[frame_index]), strict=True)),
            learner=dict(zip(env.learner.joint_names, map(float, rollout.learner[frame_index]), strict=True))
            | self._locked,
            locked=tuple(self._locked),
            expert_links=env.expert.link_names,
            learner_links=env.learner.link_names,
            distance=float(rollout.distance[step]),
            bound=float(rollout.bound[step]),
            matrix=rollout.matrix[step],
            links=rollout.links[step],
            similarity=self._similarity(rollout.expert[frame_index], rollout.learner[frame_index]),
        )

    def _similarity(self, expert_qpos: np.ndarray, learner_qpos: np.ndarray) -> dict[str, float]:
        env = self._evaluator.env
        arms = (env.expert, expert_qpos), (env.learner, learner_qpos)
        lines = (centre_line_table(arm, qpos, samples=_SAMPLES) for arm, qpos in arms)
        return {name: float(value) for name, value in similarity(*lines).items()}

    def chart(self, split: str, demonstration: int, time: float) -> str:
        """Distance and kinematic bound over the episode, with a mark at a time [s]."""
        rollout = self._rollout(split, demonstration)
        times = rollout.dt * np.arange(1, len(rollout.distance) + 1)
        curves = [
            ("policy", rollout.distance, html.LEARNER),
            ("bound", rollout.bound, html.BOUND),
            ("holding start pose", rollout.hold, html.HOLD),
        ]
        return html.chart(times, curves, now=max(time, rollout.dt))

    def note(self, split: str, demonstration: int) -> str:
        """Optimality gap of the policy on a whole demonstration, as a sentence."""
        rollout = self._rollout(split, demonstration)
        gap = float(gaps(*(x.mean(dtype=float) for x in (rollout.distance, rollout.bound, rollout.hold))))
        if not np.isfinite(gap):
            return "no optimality gap: the best motion hardly reduces the distance of holding the start pose"
        return f"optimality gap of this demonstration: {gap:.1%}"

    def duration(self, split: str, demonstration: int) -> float:
        """Duration of an episode [s]."""
        return float(self._rollout(split, demonstration).time[-1])
