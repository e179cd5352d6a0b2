"""Compiled functions that move the learner to a pose of the expert."""

import dataclasses
import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float

from mimic.arms.embodiment import Embodiment
from mimic.arms.pose_limits import continuous_joints
from mimic.base.compilation import Background, in_background
from mimic.envs.config import EnvConfig
from mimic.metric.distance import DistanceWeights, Metric
from mimic.metric.kinematics import link_states
from mimic.metric.similarity import centre_line, similarity
from mimic.retargeting.pose import imitate_pose, wrap_angles

_TRACKING_ITERATIONS = 8  # Newton steps from the current pose, which is close: sliders move in small steps


@dataclasses.dataclass(frozen=True)
class Weights:
    """Weights of the metric that the user can change while the viewer runs."""

    translation: float
    rotation: float

    def __post_init__(self) -> None:
        for name, weight in dataclasses.asdict(self).items():
            if not 0 <= weight < math.inf:
                raise ValueError(f"{name}: expected a finite weight of at least 0, got {weight}")

    @property
    def array(self) -> Float[np.ndarray, "2"]:
        """The weights as an argument of the compiled functions."""
        return np.array([self.translation, self.rotation], np.float32)


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
      track: (expert_qpos, learner_qpos, weights) -> pose of the local minimum reached from the learner's pose [rad].
      compare: (expert_qpos, learner_qpos, weights) -> `PoseComparison`.
      best: (expert_qpos, weights) -> best pose from many initial guesses [rad], and its distance: the kinematic bound.
        It compiles in the background, which takes longest.
    """

    track: Callable[..., Any]
    compare: Callable[..., PoseComparison]
    best: Background[Callable[..., Any]]


def compile_functions(env: EnvConfig) -> CompiledFunctions:
    """Compiles the functions of an environment, which takes seconds."""
    expert, learner = env.build_arm("expert").embodiment, env.build_arm("learner").embodiment
    metric = _metric_of_weights(env, expert, learner)

    def track(qpos: Array, current: Array, weights: Array) -> Array:
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
    functions = _compiled(track, q, q_hat, w), _compiled(compare, q, q_hat, w)
    return CompiledFunctions(*functions, in_background(lambda: _compiled(best, q, w)))


def _metric_of_weights(env: EnvConfig, expert: Embodiment, learner: Embodiment) -> Callable[[Array], Metric]:
    """The metric as a function of the weights (translation, rotation)."""
    base_metric = env.metric.build(expert, learner)

    def metric(weights: Array) -> Metric:
        if env.metric.adaptive:
            return base_metric
        # A constant weight of 0 removes its term, which makes the optimiser's derivatives much simpler.
        constant = DistanceWeights(0.0 if env.metric.translation == 0 else weights[0], weights[1])
        return dataclasses.replace(base_metric, weights=constant)

    return metric


def _compiled(function: Callable[..., Any], *shapes: Any) -> Callable[..., Any]:
    """The function, compiled for arguments of these shapes; it never compiles again."""
    return jax.jit(function).lower(*shapes).compile()


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
