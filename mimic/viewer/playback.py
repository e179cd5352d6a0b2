"""A trained policy's rollouts, moment by moment. Knows no browser."""

import functools
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from mimic.arms.arm import build_arm
from mimic.envs.config import EnvConfig
from mimic.evaluation.rollout_frames import RolloutFrames, demonstration_index
from mimic.evaluation.rollout_metrics import gaps
from mimic.metric.similarity import centre_line_table, similarity
from mimic.runs.checkpoints import load_checkpoint
from mimic.trainers.config import TrainConfig
from mimic.trainers.make import make_ppo_trainer
from mimic.viewer import html
from mimic.viewer.live_session import Frame

FRAMES_PER_SECOND = 30
_SAMPLES = 32  # of the centre lines that a frame is measured by: half the usual number, to be quick


class Playback:
    """What the policy of a run does on its demonstrations.

    Args:
      trained: config of the run.
      run_dir: its directory.
      checkpoint: environment steps; the last one where None.

    Raises:
      ValueError: a run that cannot be read.
    """

    def __init__(self, trained: TrainConfig, run_dir: Path, checkpoint: int | None):
        trainer = make_ppo_trainer(trained, run_dir)
        self.env: EnvConfig = trained.env
        self._trainer, self._evaluator = trainer, trainer.evaluator
        self._params = load_checkpoint(run_dir, trainer.params_template(), checkpoint)[1]
        self._rollouts: Any = None
        self._locked = dict(build_arm(self.env.learner, self.env.limits).locked)
        self.story = functools.lru_cache(maxsize=16)(self._story)

    def run(self) -> None:
        """Runs the policy on all demonstrations, and computes their bounds."""
        with Console().status("running the policy on all demonstrations, and computing the lower bound"):
            self._rollouts = self._trainer.evaluate(self._params)
            _ = self._evaluator.lower_bound

    def count(self, split: str) -> int:
        """How many demonstrations of a split there are."""
        return len(range(self._evaluator.env.demonstrations.count)[self._evaluator.parts[split]])

    def _story(self, split: str, demonstration: int) -> RolloutFrames:
        index = demonstration_index(self._evaluator, split, demonstration)
        return RolloutFrames(self._evaluator, self._rollouts, index, FRAMES_PER_SECOND)

    def frame(self, split: str, demonstration: int, time: float) -> Frame:
        """A moment of an episode, a time [s] after its start."""
        story, env = self.story(split, demonstration), self._evaluator.env
        moment = int(np.clip(round(time * FRAMES_PER_SECOND), 0, story.num_frames - 1))
        step = min(int(story.time[moment] / story.dt), len(story.distance) - 1)
        return Frame(
            expert=dict(zip(env.expert.joint_names, map(float, story.expert[moment]), strict=True)),
            learner=dict(zip(env.learner.joint_names, map(float, story.learner[moment]), strict=True)) | self._locked,
            locked=tuple(self._locked),
            expert_links=env.expert.link_names,
            learner_links=env.learner.link_names,
            distance=float(story.distance[step]),
            bound=float(story.bound[step]),
            matrix=story.matrix[step],
            links=story.links[step],
            similarity=self._similarity(story.expert[moment], story.learner[moment]),
        )

    def _similarity(self, expert_qpos: np.ndarray, learner_qpos: np.ndarray) -> dict[str, float]:
        env = self._evaluator.env
        arms = (env.expert, expert_qpos), (env.learner, learner_qpos)
        lines = (centre_line_table(arm, qpos, samples=_SAMPLES) for arm, qpos in arms)
        return {name: float(value) for name, value in similarity(*lines).items()}

    def chart(self, split: str, demonstration: int, time: float) -> str:
        """The distance over the episode, with its bound, and where the time is."""
        story = self.story(split, demonstration)
        times = story.dt * np.arange(1, len(story.distance) + 1)
        curves = [
            ("policy", story.distance, html.LEARNER),
            ("bound", story.bound, html.BOUND),
            ("holding start pose", story.hold, html.HOLD),
        ]
        return html.chart(times, curves, now=max(time, story.dt))

    def note(self, split: str, demonstration: int) -> str:
        """How good the policy is on a demonstration as a whole."""
        story = self.story(split, demonstration)
        gap = float(gaps(*(x.mean(dtype=float) for x in (story.distance, story.bound, story.hold))))
        if not np.isfinite(gap):
            return "no optimality gap: the best motion is hardly nearer than holding the start pose"
        return f"optimality gap of this demonstration: {gap:.1%}"

    def duration(self, split: str, demonstration: int) -> float:
        """Of an episode [s]."""
        return float(self.story(split, demonstration).time[-1])
