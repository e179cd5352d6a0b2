"""The embodiment distance as a function of the learner's pose, with its first two derivatives."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Int

from mimic.arms.embodiment import Embodiment, in_chain_lengths
from mimic.metric import spatial
from mimic.metric.distance import DistanceWeights, Metric
from mimic.metric.kinematics import LinkStates, joint_axes, joint_frames, link_states, link_vectors
from mimic.metric.spatial import Scalar, Vector
from mimic.retargeting.closed_form import SMOOTHING, Body, Pull, smoothed_length, static_derivatives
from mimic.retargeting.optimizers import Derivatives, Scalars, Store, call

Target = Any  # pytree: the data of the expert's pose that the objective needs


@dataclasses.dataclass(frozen=True)
class PoseObjective:
    """The objective of pose imitation, as functions.

    Attributes:
      distance: (expert's link states, learner's link states) -> embodiment distance, both at rest.
      target: (expert's link states, expert's pose) -> target.
      value: (target, learner's link states) -> distance with smoothed lengths.
      derivatives: (target, joint angles, store, smoothing) -> derivatives of the distance; the value up to a constant
        of the target. `store`, a `mimic.retargeting.optimizers.Store`, and `smoothing` [chain lengths] may be omitted.
      is_smoothed: whether the smoothing has an effect.
      is_elementwise: whether `derivatives` also takes arrays of poses for each joint, which broadcast with arrays of
        targets; see `of_batch`.
    """

    distance: Callable[[LinkStates, LinkStates], Array]
    target: Callable[..., Target]
    value: Callable[[Target, LinkStates], Array]
    derivatives: Callable[..., Derivatives]
    is_smoothed: bool = False
    is_elementwise: bool = False

    def of_batch(self, targets: Target) -> Callable[..., Derivatives]:
        """`derivatives` for joint angles [lanes, poses] each.

        Args:
          targets: one for each pose, along the last axis of each array.
        """
        if self.is_elementwise:
            return functools.partial(self.derivatives, targets)

        def derivatives(qpos: Scalars, store: Store = call, smoothing: Scalar = SMOOTHING) -> Derivatives:
            def at(target: Target, qpos: Scalars) -> Derivatives:
                return self.derivatives(target, qpos, store, smoothing)

            return jax.vmap(jax.vmap(at, (None, 0)), (-1, -1), -1)(targets, tuple(qpos))

        return derivatives


def pose_objective(learner: Embodiment, metric: Metric) -> PoseObjective:
    """The objective: in closed form for a static metric, see `_static`; else by automatic differentiation."""
    return _static(learner, metric) if metric.is_static else _differentiated(learner, metric)


def _differentiated(learner: Embodiment, metric: Metric) -> PoseObjective:
    def derivatives(target: LinkStates, qpos: Scalars, store: Store = call, smoothing: Any = None) -> Derivatives:
        def gradient_and_value(qpos: Array) -> tuple[Array, tuple[Array, Array]]:
            value, gradient = jax.value_and_grad(lambda q: metric(target, link_states(learner, q)))(qpos)
            return gradient, (value, gradient)

        hessian, (value, gradient) = jax.jacfwd(gradient_and_value, has_aux=True)(jnp.stack(qpos))
        return Derivatives(value, tuple(gradient), tuple(map(tuple, hessian)))

    return PoseObjective(metric, lambda states, _=None: states, metric, derivatives)


class StaticTarget(NamedTuple):
    """Target of a static metric: pulls on the learner's directions and positions (`mimic.retargeting.closed_form`).

    Attributes:
      unit, strength: [links, 3], [links] of the pulls on directions.
      points, weights: [pairs, 3], [pairs] of the pulls on positions.
    """

    unit: Array
    strength: Array
    points: Array
    weights: Array


def _static(learner: Embodiment, metric: Metric) -> PoseObjective:
    """Constant W and weights, cosines and the mean: sums of W_ij (pi/2) (1 - e_i . e^_j) and W_ij |p_i - p^_j|.

    For the directions the expert reduces to one pull for each link of the learner, t_j = sum_i W_ij e_i.
    """
    correspondence, weights = metric.correspondence, cast(DistanceWeights, metric.weights)
    directions, positions = (_pair_weights(correspondence, w) for w in (weights.rotation, weights.translation))
    pairs = _weighted_pairs(correspondence, weights.translation)
    arm = in_chain_lengths(learner)

    def target(states: LinkStates, _: Any = None) -> StaticTarget:
        assert states.direction is not None
        dtype = states.direction.dtype
        # Elementwise, so that nothing is rounded to TF32.
        pull = np.pi / 2 * jnp.sum(directions[:, :, None] * states.direction[:, None, :], axis=0)
        strength = spatial.safe_sqrt(jnp.sum(pull * pull, axis=-1))
        unit = pull / jnp.maximum(strength, jnp.finfo(pull.dtype).tiny)[:, None]
        weight = jnp.asarray(positions[pairs[:, 0], pairs[:, 1]], dtype)
        return StaticTarget(unit.astype(dtype), strength.astype(dtype), states.position[pairs[:, 0]], weight)

    def value(target: StaticTarget, states: LinkStates) -> Array:
        assert states.direction is not None
        aligned = jnp.vdot(target.strength[:, None] * target.unit, states.direction)
        difference = states.position[pairs[:, 1]] - target.points
        square = jnp.sum(difference * difference, axis=-1)
        return jnp.sum(target.weights * smoothed_length(square, SMOOTHING)) + np.pi / 2 * directions.sum() - aligned

    def kinematics(qpos: Scalars) -> tuple[list[Vector], list[Vector], list[tuple[Vector, Vector]]]:
        frames = joint_frames(arm, qpos, None)
        vectors = [(link.direction, link.position) for link in link_vectors(arm, frames)]
        return joint_axes(arm, frames), [frame.anchor for frame in frames[1:]], vectors

    def derivatives(
        target: StaticTarget, qpos: Scalars, store: Store = call, smoothing: Scalar = SMOOTHING
    ) -> Derivatives:
        axes, anchors, vectors = store(kinematics, tuple(qpos))
        links = [Body(joint, *vector) for joint, vector in zip(arm.link_joint, vectors, strict=True)]
        pulls = [_pull(target, j, pairs[:, 1] == j) for j in range(learner.num_links)]
        return static_derivatives(axes, anchors, links, pulls, smoothing)

    return PoseObjective(metric, target, value, derivatives, is_smoothed=bool(len(pairs)), is_elementwise=True)


def _pair_weights(correspondence: Any, weight: Any) -> Any:
    """W o weight, divided by the number of pairs: [expert, learner]; by NumPy where both are constants."""
    is_constant = not any(isinstance(x, Tracer) for x in (correspondence, weight))
    numpy = np if is_constant else jnp
    matrix = numpy.asarray(correspondence)
    return numpy.broadcast_to(numpy.asarray(weight), matrix.shape) * matrix / matrix.size


def _weighted_pairs(correspondence: Any, weight: Any) -> Int[np.ndarray, "pairs 2"]:
    """Pairs of links with a weight on positions; all pairs where W is traced."""
    has_weight = np.full(np.shape(correspondence), True)
    if not isinstance(correspondence, Tracer):
        has_weight &= np.asarray(correspondence) != 0
    if not isinstance(weight, Tracer):
        has_weight &= np.asarray(weight) != 0
    return np.argwhere(has_weight)


def _pull(target: StaticTarget, link: int, is_on_link: Bool[np.ndarray, " pairs"]) -> Pull:
    """Pull on one link as scalars."""
    indices = np.flatnonzero(is_on_link)
    points = [spatial.vector(target.points[i]) for i in indices]
    return Pull(spatial.vector(target.unit[link]), target.strength[link], points, [target.weights[i] for i in indices])
