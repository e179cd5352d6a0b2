"""What a video shows, as plain numbers; made of a policy's rollout, a pose mapper, or retargeted motions."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from mimic.arms.arm import build_arm
from mimic.arms.embodiment import Embodiment
from mimic.commands.config import RenderConfig
from mimic.envs import env_config
from mimic.envs.config import EnvConfig
from mimic.envs.demonstrations import Demonstrations, load_demonstrations
from mimic.envs.recording import record_demonstrations
from mimic.evaluation.rollout_frames import RolloutFrames, demonstration_index, interpolate
from mimic.metric.kinematics import link_states
from mimic.retargeting.pose import imitate_pose, pose_limits
from mimic.runs.checkpoints import load_checkpoint
from mimic.trainers.make import make_ppo_trainer
from mimic.trainers.pose_mapper.model import PoseMapper
from mimic.trainers.run_config import load_config, policy_run

FRAMES_PER_SECOND = 30
_HOLD, _OPTIMUM = {"linestyle": ":", "color": "grey"}, {"linestyle": "--", "color": "black", "lw": 1}


class Curve(NamedTuple):
    """A line over time: its name, its values [samples], and how matplotlib draws it."""

    label: str
    values: Float[np.ndarray, " samples"]
    style: dict[str, Any]


@dataclasses.dataclass(frozen=True, eq=False)
class Clip:
    """What a video shows.

    Attributes:
      title: of it all.
      labels: of the arms, left to right.
      time: [frames] [s].
      poses: of each arm, [frames, joints] [rad].
      curve_time: [samples] of the curves and the bars [s].
      curves: embodiment distances.
      bars: [samples, links] what each link of the learner adds to the distance.
      bar_names: of these links.
    """

    title: str
    labels: tuple[str, ...]
    time: Float[np.ndarray, " frames"]
    poses: tuple[Float[np.ndarray, "frames joints"], ...]
    curve_time: Float[np.ndarray, " samples"]
    curves: tuple[Curve, ...]
    bars: Float[np.ndarray, "samples links"]
    bar_names: tuple[str, ...]


class Recipe(NamedTuple):
    """A clip that can be made: of whose arms, where its video goes unless told, and what makes it, which takes time."""

    env: EnvConfig
    out: Path | None
    make: Callable[[], Clip]


def prepare_clip(config: RenderConfig) -> Recipe:
    """The clip that a config asks for.

    Raises:
      ValueError: no run directory, no such checkpoint or demonstration, files that do not fit, or keys that do not go
        together.
    """
    if config.retargeted or (config.demonstrations and not config.run):
        return _of_retargeted(config)
    if config.run and load_config(Path(config.run).expanduser()).trainer.name == "pose_mapper":
        return _of_mapper(config)
    return _of_policy(config)


def _of_policy(config: RenderConfig) -> Recipe:
    """A policy's rollout, with the lower bound and an arm at rest."""
    run_dir, trained = policy_run(config.run, config.checkpoint)
    _check_unused(config, "a run of trainer=ppo", "demonstrations", "learner", "limits", "seed")
    trainer = make_ppo_trainer(trained, run_dir)
    index = demonstration_index(trainer.evaluator, config.split, config.demonstration)
    _, params = load_checkpoint(run_dir, trainer.params_template(), config.checkpoint)
    title = f"{trained.env.name}, {config.split.replace('_', '-')} demonstration {config.demonstration}"

    def make() -> Clip:
        story = RolloutFrames(trainer.evaluator, trainer.evaluate(params), index, FRAMES_PER_SECOND)
        curves = (
            Curve("holding the start pose", story.hold, _HOLD),
            Curve("policy", story.distance, {"color": "tab:blue"}),
            Curve("lower bound", story.bound, _OPTIMUM),
        )
        steps = story.dt * np.arange(1, len(story.distance) + 1)
        poses = story.expert, story.learner
        return Clip(title, ("expert", "learner"), story.time, poses, steps, curves, story.by_link, story.link_names)

    return Recipe(trained.env, run_dir / "videos" / f"{config.split}-{config.demonstration}.mp4", make)


def _of_mapper(config: RenderConfig) -> Recipe:
    """An expert on its way through a demonstration, and the pose that a mapper makes of it at each frame."""
    _check_unused(config, "a run of trainer=pose_mapper", "split", "learner", "limits")
    run_dir = Path(config.run).expanduser()
    env = load_config(run_dir).env
    mapper = PoseMapper.load(run_dir, config.checkpoint)
    if config.demonstrations:
        _check_unused(config, "demonstrations=FILE", "seed")
        demonstrations = load_demonstrations(Path(config.demonstrations).expanduser())
        _check_arm("demonstrations", demonstrations, mapper.expert)
        _check_number(config.demonstration, demonstrations)
        name = f"{Path(config.demonstrations).stem}-{config.demonstration}"
    else:
        if config.demonstration < 0 or config.seed < 0:
            raise ValueError(f"demonstration, seed: expected at least 0, got {config.demonstration} and {config.seed}")
        demonstrations = None
        name = f"{env.demonstrations.kind}-seed{config.seed}-{config.demonstration}"

    def make() -> Clip:
        shown = demonstrations or record_demonstrations(
            build_arm(env.expert, env.limits),
            config.demonstration + 1,
            kind=env.demonstrations.kind,
            seed=config.seed,
            horizon=env.horizon,
            dt=env.control_dt,
            substeps=env.substeps,
        )
        time, qpos = _resampled(shown, config.demonstration)
        qpos = np.clip(qpos, *pose_limits(mapper.expert, float))  # a cubic may lead a little beyond its samples
        learner_qpos = np.asarray(mapper(qpos.astype(np.float32)))
        title = f"{env.name}, demonstration {config.demonstration}"
        return _static_clip(env, title, time, qpos, learner_qpos, by="pose mapper")

    return Recipe(env, run_dir / "videos" / f"{name}.mp4", make)


def _of_retargeted(config: RenderConfig) -> Recipe:
    """An expert's demonstration, and the learner's motion that `mimic.retarget` made of it."""
    _check_unused(config, "retargeted=FILE", "run", "checkpoint", "split", "seed")
    for key, example in (("demonstrations", "EXPERT.npz"), ("retargeted", "LEARNER.npz"), ("learner", "panda4dof")):
        if not getattr(config, key):
            raise ValueError(f"{key}: expected what mimic.retarget was given or wrote, as in {key}={example}")
    env = env_config(config.learner, limits=config.limits)
    expert, learner = env.build_arms().embodiments
    demonstrations = load_demonstrations(Path(config.demonstrations).expanduser())
    motions = load_demonstrations(Path(config.retargeted).expanduser())
    _check_arm("demonstrations", demonstrations, expert)
    _check_arm("retargeted", motions, learner)
    sizes = [(part.count, part.horizon, part.dt) for part in (demonstrations, motions)]
    if sizes[0] != sizes[1]:
        expected, got = ("{} motions of {} steps of {} s".format(*size) for size in sizes)
        raise ValueError(f"retargeted: expected {expected}, as the demonstrations, got {got}")
    _check_number(config.demonstration, demonstrations)

    def make() -> Clip:
        time, qpos = _resampled(demonstrations, config.demonstration)
        _, learner_qpos = _resampled(motions, config.demonstration)
        title = f"{env.name}, demonstration {config.demonstration}"
        return _static_clip(env, title, time, qpos, learner_qpos, by="retargeted")

    return Recipe(env, None, make)


def _static_clip(
    env: EnvConfig, title: str, time: np.ndarray, qpos: np.ndarray, learner_qpos: np.ndarray, *, by: str
) -> Clip:
    """Two arms moved pose by pose: velocities do not count; with the optimal pose's distance at each frame."""
    expert, learner = env.build_arms().embodiments
    metric = env.metric.build(expert, learner)

    def judged(qpos: jax.Array, learner_qpos: jax.Array) -> tuple[jax.Array, jax.Array]:
        states = link_states(expert, qpos), link_states(learner, learner_qpos)
        distances = metric.link_distances(*states)
        by_link = (metric.matrix(distances) * distances).sum(axis=0) / distances.size
        return metric.reduced(distances), by_link

    judge = jax.jit(jax.vmap(judged))
    distance, by_link = map(np.asarray, judge(qpos, learner_qpos))
    hold = np.asarray(judge(qpos, np.broadcast_to(np.asarray(learner.home), learner_qpos.shape))[0])
    optimum = imitate_pose(expert, learner, qpos.astype(np.float32), kept=None, **metric.arguments)
    curves = (
        Curve("holding the start pose", hold, _HOLD),
        Curve(by, distance, {"color": "tab:blue"}),
        Curve("optimal poses", np.asarray(optimum.distance), _OPTIMUM),
    )
    labels = "expert", f"learner, {by}"
    return Clip(title, labels, time, (qpos, learner_qpos), time, curves, by_link, learner.link_names)


def _resampled(motions: Demonstrations, number: int) -> tuple[np.ndarray, np.ndarray]:
    """Times and angles of the frames of one motion."""
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
        raise ValueError(f"demonstration: expected 0 to {motions.count - 1}, those of the file, got {number}")


def _check_unused(config: RenderConfig, what: str, *keys: str) -> None:
    """Rejects keys that mean nothing for what is shown."""
    defaults = RenderConfig()
    for key in keys:
        if getattr(config, key) != getattr(defaults, key):
            raise ValueError(f"{key}: does not go with {what}; leave it out, got {getattr(config, key)!r}")
