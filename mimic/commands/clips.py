"""Content of a video as arrays: a policy's rollout, or retargeted motions."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from mimic.arms.arm import ArmConfig, build_arm
from mimic.arms.embodiment import Embodiment
from mimic.arms.kinematic_tree import ALL_ENDS
from mimic.arms.link_match import LinkMatch
from mimic.base.config import check_unused
from mimic.commands.arm_keys import ROLES, arm_of_environment
from mimic.commands.config import RenderConfig
from mimic.commands.retargeted_motions import read_motions
from mimic.envs import env_config, environments
from mimic.envs.config import EnvConfig
from mimic.evaluation.rollout_frames import RolloutFrames, demonstration_index
from mimic.metric.kinematics import link_states
from mimic.metric.similarity import centre_line_table, similarity
from mimic.retargeting.certificate import hand_errors
from mimic.retargeting.hand_target import placement, states_in_base
from mimic.retargeting.pose import imitate_pose
from mimic.runs.checkpoints import load_checkpoint
from mimic.runs.parameters import has_network
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
      objects: poses of objects, in the expert's base frame [m].
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
    objects: Float[np.ndarray, "frames objects 4 4"] | None = None


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
    return _data_set_clip(config) if config.retargeted else _policy_clip(config)


def _policy_clip(config: RenderConfig) -> ClipPlan:
    """A policy's rollout, with the kinematic bound and the distance of holding the start pose."""
    run_dir, trained = policy_run(config.run, config.checkpoint)
    check_unused(config, ("expert", "limits"), "with run=DIR")
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
    out = Path(f"{trained.env.name}-{name}") if has_network(run_dir) else run_dir / "videos" / name
    return ClipPlan(trained.env, out, compute)


def _data_set_clip(config: RenderConfig) -> ClipPlan:
    """An episode of a data set that `mimic.retarget` wrote, beside that of its source."""
    check_unused(config, ("run", "checkpoint", "split", "locked"), "with retargeted=FOLDER")
    motions = read_motions(Path(config.retargeted).expanduser())
    arms = {role: _arm_of(role, config, motions.joints[role]) for role in ROLES}
    env = dataclasses.replace(env_config("pair", limits=config.limits), **arms)
    if config.demonstration >= len(motions.episodes):
        last = len(motions.episodes) - 1
        raise ValueError(f"demonstration: expected a number from 0 to {last}, got {config.demonstration}")

    def compute() -> Clip:
        own, *values, objects = motions.of_episode(config.demonstration)
        time = np.arange(own[0], own[-1] + 1e-9, 1 / FRAMES_PER_SECOND)
        qpos, learner_qpos, poses = (_interpolated(time, own, x) for x in (*values, objects.reshape(len(own), -1)))
        title = f"{Path(config.retargeted).name}, {motions.episodes[config.demonstration]}"
        clip = _static_clip(env, title, time - time[0], qpos, learner_qpos, motions.base)
        return dataclasses.replace(clip, objects=poses.reshape(len(time), *objects.shape[1:]))

    return ClipPlan(env, None, compute)


def _interpolated(time: np.ndarray, own: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Values [samples, columns] at other times."""
    columns = [np.interp(time, own, column) for column in values.T]
    return np.stack(columns, axis=1) if columns else np.zeros((len(time), 0))


def _arm_of(role: str, config: RenderConfig, joints: Sequence[str]) -> ArmConfig:
    """The arm of a role by the name that the config has: the one with these joints, at all of its ends if need be.

    Raises:
      ValueError: there is no name, or it is that of another arm.
    """
    name = getattr(config, role)
    if not name:
        raise ValueError(f"{role}: expected with retargeted=FOLDER, as mimic.retarget had it")
    first = arm_of_environment(role, name) if name in environments() else ArmConfig(model=name)
    others = []
    for candidate in [first, dataclasses.replace(first, tip=[ALL_ENDS])] if first.is_file else [first]:
        try:
            arm = build_arm(candidate, config.limits).embodiment
        except ValueError as error:  # a model that branches, whose ends count only together
            others.append(str(error))
            continue
        if arm.joint_names == tuple(joints):
            return candidate
        others.append(f"{arm.name} with {', '.join(arm.joint_names)}")
    raise ValueError(f"{role}: expected the arm of the data set, with joints {', '.join(joints)}, got {others[0]}")


def _static_clip(
    env: EnvConfig,
    title: str,
    time: np.ndarray,
    qpos: np.ndarray,
    learner_qpos: np.ndarray,
    base: Sequence[float] | None,
) -> Clip:
    """A clip of static poses, whose velocities are ignored, with the distance of the optimal pose at each frame.

    Where the learner's base is placed, the hands are compared in metres; and without optimal poses if it is turned.
    """
    expert, learner = env.build_arms().embodiments
    metric, place = env.metric.build(expert, learner), placement(base)

    def evaluate(qpos: jax.Array, learner_qpos: jax.Array) -> tuple[jax.Array, jax.Array]:
        states = states_in_base(place, link_states(expert, qpos)), link_states(learner, learner_qpos)
        distances = metric.link_distances(*states)
        by_link = (metric.matrix(distances) * distances).sum(axis=0) / distances.size
        return metric(*states), by_link  # with the hand, which is no link

    evaluate_batch = jax.jit(jax.vmap(evaluate))
    distance, by_link = map(np.asarray, evaluate_batch(qpos, learner_qpos))
    hold = np.asarray(evaluate_batch(qpos, np.broadcast_to(np.asarray(learner.home), learner_qpos.shape))[0])
    curves = [
        Curve("holding the start pose", hold, _HOLD),
        Curve("retargeted", distance, {"color": "tab:blue"}),
    ]
    if base is None or base[3] == 0:
        optimum = imitate_pose(expert, learner, qpos.astype(np.float32), kept=None, **metric.arguments)
        curves.append(Curve("optimal poses", np.asarray(optimum.distance), _OPTIMUM))
    labels = "expert", "learner, retargeted"
    poses = qpos, learner_qpos
    measures = _similarity((expert, learner), poses, place.rotation)
    if base is not None:
        position, angle = hand_errors(expert, learner, qpos, learner_qpos, base)
        del measures["hand_position_error"]  # in chain lengths
        measures |= {"hand_position_mm": 1e3 * position, "hand_rotation_deg": np.degrees(angle)}
    match = env.metric.match_links(expert, learner)
    return Clip(title, labels, time, poses, time, tuple(curves), by_link, learner.link_names, measures, match, base)


def _similarity(
    arms: tuple[Embodiment, Embodiment], poses: tuple[np.ndarray, np.ndarray], rotation: np.ndarray | None = None
) -> dict[str, np.ndarray]:
    """Similarity measures of two arms at each frame, of the expert in axes turned by a rotation."""
    expert, learner = (centre_line_table(arm, qpos) for arm, qpos in zip(arms, poses, strict=True))
    return similarity(expert if rotation is None else jax.tree.map(lambda x: x @ rotation, expert), learner)
