"""Content of a video as arrays: a policy's rollout, or retargeted motions."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from mimic.arms.embodiment import Embodiment
from mimic.arms.kinematic_tree import ALL_ENDS
from mimic.arms.link_match import LinkMatch
from mimic.base.config import check_unused
from mimic.commands.config import RenderConfig
from mimic.commands.retargeted_motions import read_motions
from mimic.envs import env_config
from mimic.envs.config import EnvConfig
from mimic.evaluation.rollout_frames import RolloutFrames, demonstration_index, interpolate
from mimic.metric.kinematics import link_states
from mimic.metric.similarity import centre_line_table, similarity
from mimic.motions.demonstrations import Demonstrations, load_demonstrations
from mimic.retargeting.pose import imitate_pose
from mimic.runs.checkpoints import load_checkpoint
from mimic.trainers.make import make_policy_trainer
from mimic.trainers.run_config import policy_run

FRAMES_PER_SECOND = 30
_HOLD, _OPTIMUM = {"linestyle": ":", "color": "grey"}, {"linestyle": "--", "color": "black", "lw": 1}


class Curve(NamedTuple):
    """A curve over time: its label, its values, and its matplotlib style."""

    label: str
    values: Float[np.ndarray, " samples"]
    style: dict[str, Any]


@dataclasses.dataclass(frozen=True, eq=False)
class Clip:
    """Content of a video.

    Attributes:
      title: title of the video.
      labels: names of the arms, left to right.
      time: time of each frame [s].
      poses: joint positions of each arm, [frames, joints] [rad].
      curve_time: time of each sample of the curves and the bars [s].
      curves: embodiment distances over time.
      bars: contribution of each link of the learner to the distance, [samples, links].
      bar_names: names of these links.
      similarity: measures of `mimic.metric.similarity` of the poses, each of shape [frames].
      match: which links correspond.
      base: of the learner in the expert's base frame, see `LinkMatch.ghost`.
    """

    title: str
    labels: tuple[str, ...]
    time: Float[np.ndarray, " frames"]
    poses: tuple[Float[np.ndarray, "frames joints"], ...]
    curve_time: Float[np.ndarray, " samples"]
    curves: tuple[Curve, ...]
    bars: Float[np.ndarray, "samples links"]
    bar_names: tuple[str, ...]
    similarity: Mapping[str, Float[np.ndarray, " frames"]]
    match: LinkMatch
    base: Sequence[float] | None = None


class ClipPlan(NamedTuple):
    """A clip to compute.

    Attributes:
      env: environment that defines the arms.
      out: default file of the video; None where there is none.
      compute: computes the clip, which takes time.
    """

    env: EnvConfig
    out: Path | None
    compute: Callable[[], Clip]


def prepare_clip(config: RenderConfig) -> ClipPlan:
    """Checks the config of a video and returns its clip, which is not computed yet.

    Raises:
      ValueError: the run directory, the checkpoint or the demonstration does not exist, files belong to other arms, or
        the keys exclude each other.
    """
    if config.retargeted and Path(config.retargeted).expanduser().is_dir():
        return _data_set_clip(config)
    if config.retargeted or (config.demonstrations and not config.run):
        return _retargeted_clip(config)
    return _policy_clip(config)


def _policy_clip(config: RenderConfig) -> ClipPlan:
    """A policy's rollout, with the kinematic bound and the distance of holding the start pose."""
    run_dir, trained = policy_run(config.run, config.checkpoint)
    check_unused(config, ("demonstrations", "expert", "limits"), "with run=DIR")
    trained, trainer = make_policy_trainer(trained, run_dir, config.learner, config.locked)
    index = demonstration_index(trainer.evaluator, config.split, config.demonstration)
    _, params = load_checkpoint(run_dir, trainer.params_template(), config.checkpoint)
    title = f"{trained.env.name}, {config.split.replace('_', '-')} demonstration {config.demonstration}"

    def compute() -> Clip:
        rollouts = jax.tree.map(lambda x: x[index : index + 1], trainer.evaluate(params))
        rollout = RolloutFrames(trainer.evaluator.only(index), rollouts, 0, FRAMES_PER_SECOND)
        curves = (
            Curve("holding the start pose", rollout.hold, _HOLD),
            Curve("policy", rollout.distance, {"color": "tab:blue"}),
            Curve("kinematic bound", rollout.bound, _OPTIMUM),
        )
        steps = rollout.dt * np.arange(1, len(rollout.distance) + 1)
        poses = rollout.expert, rollout.learner
        arms = trainer.evaluator.env.expert, trainer.evaluator.env.learner
        bars, match = (rollout.by_link, rollout.link_names), trained.env.metric.match_links(*arms)
        measures = _similarity(arms, poses)
        return Clip(title, ("expert", "learner"), rollout.time, poses, steps, curves, *bars, measures, match)

    name = f"{config.split}-{config.demonstration}.mp4"
    if config.learner:
        name = f"{trained.env.name}-{name}"
    return ClipPlan(trained.env, run_dir / "videos" / name, compute)


def _retargeted_clip(config: RenderConfig) -> ClipPlan:
    """A demonstration of the expert, and the learner's motion that `mimic.retarget` computed from it."""
    check_unused(config, ("run", "checkpoint", "split", "locked"), "with retargeted=FILE")
    for key, example in (("demonstrations", "EXPERT.npz"), ("retargeted", "LEARNER.npz"), ("learner", "panda4dof")):
        if not getattr(config, key):
            raise ValueError(f"{key}: expected with retargeted=FILE, as in {key}={example}")
    expert_model = {"expert": {"model": config.expert, "tip": [ALL_ENDS]}} if config.expert else {}
    env = env_config(config.learner, limits=config.limits, **expert_model)
    expert, learner = env.build_arms().embodiments
    demonstrations = load_demonstrations(Path(config.demonstrations).expanduser())
    motions = load_demonstrations(Path(config.retargeted).expanduser())
    _check_arm("demonstrations", demonstrations, expert)
    _check_arm("retargeted", motions, learner)
    sizes = [(arm_motions.count, arm_motions.horizon, arm_motions.dt) for arm_motions in (demonstrations, motions)]
    if sizes[0] != sizes[1]:
        expected, got = ("{} motions of {} steps of {} s".format(*size) for size in sizes)
        raise ValueError(f"retargeted: expected {expected}, as in demonstrations, got {got}")
    _check_number(config.demonstration, demonstrations)

    def compute() -> Clip:
        time, qpos = _resampled(demonstrations, config.demonstration)
        _, learner_qpos = _resampled(motions, config.demonstration)
        title = f"{env.name}, demonstration {config.demonstration}"
        return _static_clip(env, title, time, qpos, learner_qpos)

    return ClipPlan(env, None, compute)


def _data_set_clip(config: RenderConfig) -> ClipPlan:
    """An episode of a data set that `mimic.retarget` wrote, beside that of its source."""
    check_unused(config, ("run", "checkpoint", "split", "locked", "demonstrations"), "with retargeted=FOLDER")
    arms = {key: getattr(config, key) for key in ("expert", "learner")}
    for key, arm in arms.items():
        if not arm:
            raise ValueError(f"{key}: expected with retargeted=FOLDER, as mimic.retarget had it")
    env, motions = env_config("pair", limits=config.limits, **arms), read_motions(Path(config.retargeted).expanduser())
    for key, arm in zip(arms, env.build_arms().embodiments, strict=True):
        if arm.joint_names != motions.joints[key]:
            joints, found = map(", ".join, (arm.joint_names, motions.joints[key]))
            raise ValueError(
                f"{key}: expected the arm of the data set, with joints {found}, got {arm.name} with {joints}"
            )
    if config.demonstration >= len(motions.episodes):
        last = len(motions.episodes) - 1
        raise ValueError(f"demonstration: expected a number from 0 to {last}, got {config.demonstration}")

    def compute() -> Clip:
        own, qpos, learner_qpos = motions.of_episode(config.demonstration)
        time = np.arange(own[0], own[-1] + 1e-9, 1 / FRAMES_PER_SECOND)
        at_frames = [np.stack([np.interp(time, own, x) for x in angles.T], axis=1) for angles in (qpos, learner_qpos)]
        title = f"{Path(config.retargeted).name}, {motions.episodes[config.demonstration]}"
        return dataclasses.replace(_static_clip(env, title, time - time[0], *at_frames), base=motions.base)

    return ClipPlan(env, None, compute)


def _static_clip(env: EnvConfig, title: str, time: np.ndarray, qpos: np.ndarray, learner_qpos: np.ndarray) -> Clip:
    """A clip of static poses, whose velocities are ignored, with the distance of the optimal pose at each frame."""
    expert, learner = env.build_arms().embodiments
    metric = env.metric.build(expert, learner)

    def evaluate(qpos: jax.Array, learner_qpos: jax.Array) -> tuple[jax.Array, jax.Array]:
        states = link_states(expert, qpos), link_states(learner, learner_qpos)
        distances = metric.link_distances(*states)
        by_link = (metric.matrix(distances) * distances).sum(axis=0) / distances.size
        return metric(*states), by_link  # with the hand, which is no link

    evaluate_batch = jax.jit(jax.vmap(evaluate))
    distance, by_link = map(np.asarray, evaluate_batch(qpos, learner_qpos))
    hold = np.asarray(evaluate_batch(qpos, np.broadcast_to(np.asarray(learner.home), learner_qpos.shape))[0])
    optimum = imitate_pose(expert, learner, qpos.astype(np.float32), kept=None, **metric.arguments)
    curves = (
        Curve("holding the start pose", hold, _HOLD),
        Curve("retargeted", distance, {"color": "tab:blue"}),
        Curve("optimal poses", np.asarray(optimum.distance), _OPTIMUM),
    )
    labels = "expert", "learner, retargeted"
    poses = qpos, learner_qpos
    measures = _similarity((expert, learner), poses)
    match = env.metric.match_links(expert, learner)
    return Clip(title, labels, time, poses, time, curves, by_link, learner.link_names, measures, match)


def _similarity(arms: tuple[Embodiment, Embodiment], poses: tuple[np.ndarray, np.ndarray]) -> dict[str, np.ndarray]:
    """Similarity measures of two arms at each frame."""
    return similarity(*(centre_line_table(arm, qpos) for arm, qpos in zip(arms, poses, strict=True)))


def _resampled(motions: Demonstrations, number: int) -> tuple[np.ndarray, np.ndarray]:
    """Times and joint positions of one motion, at the frames of the video."""
    time = np.arange(0, motions.horizon * motions.dt + 1e-9, 1 / FRAMES_PER_SECOND)
    return time, interpolate(motions.qpos[number], motions.qvel[number], motions.dt, time)


def _check_arm(key: str, motions: Demonstrations, arm: Embodiment) -> None:
    if (motions.arm, motions.joint_names) != (arm.name, arm.joint_names):
        raise ValueError(
            f"{key}: expected motions of {arm.name} with joints {', '.join(arm.joint_names)}, "
            f"got {motions.arm} with {', '.join(motions.joint_names)}"
        )


def _check_number(number: int, motions: Demonstrations) -> None:
    if not 0 <= number < motions.count:
        raise ValueError(f"demonstration: expected an index of the file from 0 to {motions.count - 1}, got {number}")
