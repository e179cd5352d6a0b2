"""How the learner follows a pose of the expert: compiled once for each pair of arms and kind of correspondence."""

import dataclasses
import functools
import threading
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float

from mimic.arms.arm import Arm, build_arm
from mimic.arms.embodiment import Embodiment
from mimic.config import check_choice
from mimic.envs.config import EnvConfig
from mimic.metric.config import CORRESPONDENCES
from mimic.metric.distance import DistanceWeights, Metric
from mimic.metric.kinematics import link_states
from mimic.metric.similarity import centre_line, similarity
from mimic.retargeting.pose import imitate_pose, pose_limits

Mapper = Callable[[Array], Array]  # the expert's pose -> the learner's

_TRACKING_ITERATIONS = 8  # Newton steps from the present pose, which is near: sliders move a little at a time


@dataclasses.dataclass(frozen=True)
class Settings:
    """What is switched while the viewer runs.

    Attributes:
      locked: the learner's locked joints.
      correspondence: see `MetricConfig`.
      translation, rotation: weights.
    """

    locked: tuple[str, ...]
    correspondence: str
    translation: float
    rotation: float

    def __post_init__(self) -> None:
        check_choice("correspondence", self.correspondence, CORRESPONDENCES)

    @property
    def program_key(self) -> tuple[tuple[str, ...], str, bool]:
        """Settings that agree in this share compiled programs: a weight of 0 is left out, others are arguments."""
        return self.locked, self.correspondence, self.translation == 0

    @property
    def weights(self) -> Float[np.ndarray, "2"]:
        """Translation and rotation, as the programs take them."""
        return np.array([self.translation, self.rotation], np.float32)


def initial_settings(env: EnvConfig) -> Settings:
    """What an environment says."""
    metric = env.metric
    locked = tuple(build_arm(env.learner, env.limits).locked)
    return Settings(locked, metric.correspondence, metric.translation, metric.rotation)


class Measured(NamedTuple):
    """How far apart two poses are.

    Attributes:
      distance: embodiment distance.
      matrix: correspondence W.
      links: weighted distance of every pair of links D'.
      similarity: see `mimic.metric.similarity`.
    """

    distance: Float[Any, ""]
    matrix: Float[Any, "expert learner"]
    links: Float[Any, "expert learner"]
    similarity: Mapping[str, Any]


@dataclasses.dataclass(frozen=True, eq=False)
class Programs:
    """Compiled functions of the expert's pose [rad] and the weights (translation, rotation).

    Attributes:
      learner: the arm.
      follow: (expert_qpos, learner_qpos, weights) -> the nearest minimum to the learner's present pose.
      measure: (expert_qpos, learner_qpos, weights) -> `Measured`.
      best: (expert_qpos, weights) -> the best pose of many starts, and its distance: the lower bound. None until it
        is compiled too, which takes longest.
    """

    learner: Arm
    follow: Callable[..., Any]
    measure: Callable[..., Measured]
    best: Callable[..., Any] | None


def learner_arm(env: EnvConfig, locked: tuple[str, ...]) -> Arm:
    """The learner with these joints locked, at the angles that the environment names or else where it starts.

    Raises:
      ValueError: an unknown joint, or none left free.
    """
    angles = build_arm(env.learner, env.limits).locked
    at = {name: angles[name] for name in locked if name in angles}
    start = home_angles(env)
    locked_at = {name: at.get(name, start[name]) for name in start if name in locked}
    unknown = set(locked) - set(start)
    if unknown:
        raise ValueError(f"locked: expected some of {', '.join(start)}, got {', '.join(sorted(unknown))}")
    return build_arm(dataclasses.replace(env.learner, locked=locked_at), env.limits, env.metric.links)


def home_angles(env: EnvConfig) -> Mapping[str, float]:
    """Where each of the learner's joints starts [rad], base to tip."""
    free = build_arm(dataclasses.replace(env.learner, locked=()), env.limits).embodiment
    return dict(zip(free.joint_names, map(float, free.home), strict=True))


def compile_programs(env: EnvConfig, settings: Settings, mapper: Mapper | None = None) -> Iterator[Programs]:
    """Compiles, which takes seconds: first what the learner moves by, then the same with the lower bound.

    Args:
      env: the arms and the rest of the metric.
      settings: what decides on the program: see `Settings.program_key`.
      mapper: moves the learner instead of the optimiser.

    Raises:
      ValueError: joints that cannot be locked.
    """
    expert = build_arm(env.expert, env.limits, env.metric.links).embodiment
    arm = learner_arm(env, settings.locked)
    learner = arm.embodiment
    chosen = dataclasses.replace(env.metric, correspondence=settings.correspondence).build(expert, learner)

    def metric(weights: Array) -> Metric:
        if env.metric.adaptive:
            return chosen
        # A weight that is known to be 0 costs nothing: the optimiser's derivatives are then much simpler.
        constant = DistanceWeights(0.0 if settings.translation == 0 else weights[0], weights[1])
        return dataclasses.replace(chosen, weights=constant)

    def follow(qpos: Array, present: Array, weights: Array) -> Array:
        if mapper is not None:
            return mapper(qpos)
        options = {"warm_start": present, "iterations": _TRACKING_ITERATIONS, **metric(weights).arguments}
        return imitate_pose(expert, learner, qpos, **options).qpos

    def measure(qpos: Array, learner_qpos: Array, weights: Array) -> Measured:
        states = link_states(expert, qpos), link_states(learner, learner_qpos)
        lines = centre_line(expert, qpos), centre_line(learner, learner_qpos)
        weighted = metric(weights)
        links = weighted.link_distances(*states)
        return Measured(weighted.reduced(links), weighted.matrix(links), links, similarity(*lines))

    def best(qpos: Array, weights: Array) -> tuple[Array, Array]:
        found = imitate_pose(expert, learner, qpos, **metric(weights).arguments)
        return found.qpos, found.distance

    q, q_hat = (jax.ShapeDtypeStruct((n.num_joints,), np.float32) for n in (expert, learner))
    w = jax.ShapeDtypeStruct((2,), np.float32)
    moving = Programs(arm, _compiled(follow, q, q_hat, w), _compiled(measure, q, q_hat, w), None)
    yield moving
    yield dataclasses.replace(moving, best=_compiled(best, q, w))


def _compiled(function: Callable[..., Any], *shapes: Any) -> Callable[..., Any]:
    return jax.jit(function).lower(*shapes).compile()


class ProgramCache:
    """Programs by settings, compiled in the background, one set at a time."""

    def __init__(self, env: EnvConfig, mapper: Mapper | None = None):
        self._compile = functools.partial(compile_programs, env, mapper=mapper)
        self._made: dict[Any, Programs | Exception] = {}
        self._thread: threading.Thread | None = None

    def get(self, settings: Settings) -> Programs | None:
        """The programs, or None while those that the learner moves by are compiled.

        Raises:
          ValueError: joints that cannot be locked.
        """
        key = settings.program_key
        if key not in self._made:
            if self._thread is None or not self._thread.is_alive():
                self._thread = threading.Thread(target=self._make, args=(key, settings), daemon=True, name="compile")
                self._thread.start()
            return None
        made = self._made[key]
        if isinstance(made, Exception):
            raise made
        return made

    def is_complete(self, settings: Settings) -> bool:
        """Whether all programs are there, or there will be none."""
        made = self._made.get(settings.program_key)
        return isinstance(made, Exception) or (made is not None and made.best is not None)

    def wait(self, settings: Settings) -> Programs:
        """All programs; waits for them."""
        while (programs := self.get(settings)) is None or programs.best is None:
            if self._thread is not None:
                self._thread.join()
        return programs

    def finish(self) -> None:
        """Waits for what is being compiled: a process must not end within it."""
        if self._thread is not None:
            self._thread.join()

    def _make(self, key: Any, settings: Settings) -> None:
        try:
            for programs in self._compile(settings):
                self._made[key] = programs
        except Exception as error:  # raised where the programs are asked for
            self._made[key] = error


def turned(arm: Embodiment, change: Float[np.ndarray, " joints"]) -> Float[np.ndarray, " joints"]:
    """Changes of angles [rad] the short way round, for joints that can do a full turn."""
    full_turn = np.isinf(pose_limits(arm, change.dtype)[0])
    return np.where(full_turn, change - 2 * np.pi * np.round(change / (2 * np.pi)), change)


def step_towards(
    arm: Embodiment,
    present: Float[np.ndarray, " joints"],
    goal: Float[np.ndarray, " joints"],
    largest_jump: Float[np.ndarray, " joints"],
) -> tuple[Float[np.ndarray, " joints"], bool]:
    """The next pose on the way to a goal, no joint faster than its bound [rad]; and whether it is there."""
    change = turned(arm, goal - present)
    after = present + np.clip(change, -largest_jump, largest_jump)
    return turned(arm, after), bool(np.all(np.abs(change) <= largest_jump))
