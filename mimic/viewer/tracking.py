"""Compiled functions that move the learner to a pose of the expert, a set for each pair of arms and correspondence."""

import dataclasses
import functools
import math
from collections.abc import Callable, Hashable, Iterator, Mapping
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float

from mimic.arms.arm import Arm, build_arm
from mimic.arms.embodiment import Embodiment
from mimic.arms.pose_limits import continuous_joints
from mimic.base import registry
from mimic.base.compilation import Background, in_background
from mimic.envs.config import EnvConfig
from mimic.metric.distance import DistanceWeights, Metric
from mimic.metric.kinematics import link_states
from mimic.metric.similarity import centre_line, similarity
from mimic.retargeting.pose import imitate_pose, wrap_angles

Mapper = Callable[[Array], Array]  # pose of the expert -> pose of the learner [rad]

_MAX_COMPILED = 16  # sets of functions that are kept; each takes some MB
_TRACKING_ITERATIONS = 8  # Newton steps from the current pose, which is close: sliders move in small steps


@dataclasses.dataclass(frozen=True)
class Settings:
    """Settings that the user can change while the viewer runs.

    Attributes:
      locked: angle of each locked joint of the learner by name [rad].
      correspondence: see `MetricConfig`.
      translation, rotation: weights of the metric.
    """

    locked: Mapping[str, float]
    correspondence: str
    translation: float
    rotation: float

    def __post_init__(self) -> None:
        registry.check("correspondence", self.correspondence, "correspondence")
        for name, weight in (("translation", self.translation), ("rotation", self.rotation)):
            if not 0 <= weight < math.inf:
                raise ValueError(f"{name}: expected a finite weight of at least 0, got {weight}")

    @property
    def compilation_key(self) -> Hashable:
        """Settings with equal keys share functions: weights are arguments, except a translation weight of 0."""
        return tuple(sorted(self.locked.items())), self.correspondence, self.translation == 0

    @property
    def weights(self) -> Float[np.ndarray, "2"]:
        """Weights of translation and rotation, as an argument of the compiled functions."""
        return np.array([self.translation, self.rotation], np.float32)


def initial_settings(env: EnvConfig) -> Settings:
    """The settings of an environment."""
    metric, locked = env.metric, env.build_arm("learner").locked
    return Settings(locked, metric.correspondence, metric.translation, metric.rotation)


class PoseComparison(NamedTuple):
    """Distance and similarity of two poses.

    Attributes:
      distance: embodiment distance.
      matrix: correspondence matrix W.
      links: weighted distance D' of every pair of links.
      similarity: measures of `mimic.metric.similarity` by name.
    """

    distance: Float[Any, ""]
    matrix: Float[Any, "expert learner"]
    links: Float[Any, "expert learner"]
    similarity: Mapping[str, Any]


@dataclasses.dataclass(frozen=True, eq=False)
class CompiledFunctions:
    """Compiled functions of the expert's pose [rad] and the weights (translation, rotation).

    Attributes:
      learner: learner with its locked joints.
      track: (expert_qpos, learner_qpos, weights) -> pose of the local minimum reached from the learner's pose [rad].
      compare: (expert_qpos, learner_qpos, weights) -> `PoseComparison`.
      best: (expert_qpos, weights) -> best pose from many initial guesses [rad], and its distance: the kinematic bound.
        None until it is compiled; its compilation takes longest.
    """

    learner: Arm
    track: Callable[..., Any]
    compare: Callable[..., PoseComparison]
    best: Callable[..., Any] | None


def learner_arm(env: EnvConfig, locked: Mapping[str, float]) -> Arm:
    """Builds the learner with these joints locked at these angles [rad].

    Raises:
      ValueError: a joint is unknown, or no joint is free.
    """
    return build_arm(dataclasses.replace(env.learner, locked=dict(locked)), env.limits, env.metric.links)


def lock_angles(env: EnvConfig) -> Mapping[str, float]:
    """Angle at which each of the learner's joints is locked [rad]: that of the config, or else of the start pose."""
    free = build_arm(dataclasses.replace(env.learner, locked=()), env.limits).embodiment
    home = dict(zip(free.joint_names, map(float, free.home), strict=True))
    return {**home, **env.build_arm("learner").locked}


def compile_functions(env: EnvConfig, settings: Settings, mapper: Mapper | None = None) -> Iterator[CompiledFunctions]:
    """Compiles the functions, which takes seconds; yields them first without `best`, then with it.

    Args:
      env: environment that defines the arms and the other settings of the metric.
      settings: settings of the viewer, see `Settings.compilation_key`.
      mapper: pose mapper that moves the learner instead of the optimiser.

    Raises:
      ValueError: the locked joints are invalid.
    """
    expert = env.build_arm("expert").embodiment
    arm = learner_arm(env, settings.locked)
    learner = arm.embodiment
    metric = _metric_of_weights(env, settings, expert, learner)

    def track(qpos: Array, current: Array, weights: Array) -> Array:
        if mapper is not None:
            return mapper(qpos)
        options = {"warm_start": current, "iterations": _TRACKING_ITERATIONS, **metric(weights).arguments}
        return imitate_pose(expert, learner, qpos, **options).qpos

    def compare(qpos: Array, learner_qpos: Array, weights: Array) -> PoseComparison:
        states = link_states(expert, qpos), link_states(learner, learner_qpos)
        lines = centre_line(expert, qpos), centre_line(learner, learner_qpos)
        weighted = metric(weights)
        links = weighted.link_distances(*states)
        return PoseComparison(weighted(*states), weighted.matrix(links), links, similarity(*lines))

    def best(qpos: Array, weights: Array) -> tuple[Array, Array]:
        solution = imitate_pose(expert, learner, qpos, **metric(weights).arguments)
        return solution.qpos, solution.distance

    q, q_hat = (jax.ShapeDtypeStruct((n.num_joints,), np.float32) for n in (expert, learner))
    w = jax.ShapeDtypeStruct((2,), np.float32)
    functions = CompiledFunctions(arm, _compiled(track, q, q_hat, w), _compiled(compare, q, q_hat, w), None)
    yield functions
    yield dataclasses.replace(functions, best=_compiled(best, q, w))


def _metric_of_weights(
    env: EnvConfig, settings: Settings, expert: Embodiment, learner: Embodiment
) -> Callable[[Array], Metric]:
    """The metric as a function of the weights (translation, rotation)."""
    base_metric = dataclasses.replace(env.metric, correspondence=settings.correspondence).build(expert, learner)

    def metric(weights: Array) -> Metric:
        if env.metric.adaptive or env.metric.link_distance:
            return base_metric
        # A constant weight of 0 removes its term, which makes the optimiser's derivatives much simpler.
        constant = DistanceWeights(0.0 if settings.translation == 0 else weights[0], weights[1])
        return dataclasses.replace(base_metric, weights=constant)

    return metric


def _compiled(function: Callable[..., Any], *shapes: Any) -> Callable[..., Any]:
    """The function, compiled for arguments of these shapes; it never compiles again."""
    return jax.jit(function).lower(*shapes).compile()


class FunctionCache:
    """Compiled functions by settings, compiled in a background thread, one set at a time."""

    def __init__(self, env: EnvConfig, mapper: Mapper | None = None):
        self._compile = functools.partial(compile_functions, env, mapper=mapper)
        self._results: dict[Any, CompiledFunctions | Exception] = {}
        self._running: Background[None] | None = None

    def get(self, settings: Settings) -> CompiledFunctions | None:
        """The functions; None until those that move the learner are compiled.

        Raises:
          ValueError: the locked joints are invalid.
        """
        is_free = self._running is None or self._running.done  # asked first: what has ended has its result
        result = self._results.get(settings.compilation_key)
        if result is None and is_free:
            self._running = in_background(functools.partial(self._run, settings))
        if isinstance(result, Exception):
            raise result
        return result

    def is_complete(self, settings: Settings) -> bool:
        """Whether all functions are compiled, or their compilation has failed."""
        result = self._results.get(settings.compilation_key)
        return isinstance(result, Exception) or (result is not None and result.best is not None)

    def wait(self, settings: Settings) -> CompiledFunctions:
        """Waits for all functions and returns them."""
        while (functions := self.get(settings)) is None or functions.best is None:
            self.finish()
        return functions

    def finish(self) -> None:
        """Waits for a running compilation: a process must not end during it."""
        if self._running is not None:
            self._running()

    def _run(self, settings: Settings) -> None:
        while len(self._results) >= _MAX_COMPILED:
            del self._results[next(iter(self._results))]
        try:
            for functions in self._compile(settings):
                self._results[settings.compilation_key] = functions
        except Exception as error:  # raised by `get`
            self._results[settings.compilation_key] = error


def step_towards(
    arm: Embodiment,
    current: Float[np.ndarray, " joints"],
    goal: Float[np.ndarray, " joints"],
    largest_jump: Float[np.ndarray, " joints"],
) -> tuple[Float[np.ndarray, " joints"], bool]:
    """Moves a pose towards a goal by at most a maximum change of each joint [rad].

    Returns:
      The next pose [rad], and whether it is at the goal.
    """
    continuous = continuous_joints(arm)
    change = wrap_angles(goal - current, continuous)
    next_pose = current + np.clip(change, -largest_jump, largest_jump)
    return wrap_angles(next_pose, continuous), bool(np.all(np.abs(change) <= largest_jump))
