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

from mimic.arms.embodiment import Embodiment
from mimic.metric import spatial
from mimic.metric.distance import DistanceWeights, Metric
from mimic.metric.kinematics import LinkStates, joint_axes, joint_frames, link_states, link_vectors
from mimic.retargeting.closed_form import ROUGH_SMOOTHING, SMOOTHING, Body, Pull, smoothed_length, static_derivatives
from mimic.retargeting.optimizers import Derivatives, Scalars

Target = Any  # what of the expert's pose counts: a pytree


@dataclasses.dataclass(frozen=True)
class PoseObjective:
    """What pose imitation minimises.

    Attributes:
      distance: embodiment distance of the expert's and the learner's link states, both at rest.
      target: of the expert's link states.
      value: of the target and the learner's link states: the distance, up to a constant of the target.
      derivatives: of the target and the learner's joint angles: of the distance, its value up to a constant too.
      rough_derivatives: the same of a smoother function, with minima nearby: what a descent begins with.
    """

    distance: Callable[[LinkStates, LinkStates], Array]
    target: Callable[[LinkStates], Target]
    value: Callable[[Target, LinkStates], Array]
    derivatives: Callable[[Target, Scalars], Derivatives]
    rough_derivatives: Callable[[Target, Scalars], Derivatives]


def pose_objective(learner: Embodiment, metric: Metric) -> PoseObjective:
    """In closed form for a static metric, see `_static`; any other is differentiated automatically."""
    return _static(learner, metric) if metric.is_static else _differentiated(learner, metric)


def _differentiated(learner: Embodiment, metric: Metric) -> PoseObjective:
    def derivatives(target: LinkStates, qpos: Scalars) -> Derivatives:
        def gradient_and_value(qpos: Array) -> tuple[Array, tuple[Array, Array]]:
            value, gradient = jax.value_and_grad(lambda q: metric(target, link_states(learner, q)))(qpos)
            return gradient, (value, gradient)

        hessian, (value, gradient) = jax.jacfwd(gradient_and_value, has_aux=True)(jnp.stack(qpos))
        return Derivatives(value, tuple(gradient), tuple(map(tuple, hessian)))

    return PoseObjective(metric, lambda states: states, metric, derivatives, derivatives)


class StaticTarget(NamedTuple):
    """What of the expert counts for the static measure: one pull on each direction of the learner, and positions.

    Attributes:
      unit, strength: [links, 3], [links] of the pull on the learner's directions, see `mimic.retargeting.closed_form`.
      points, weights: [pairs, 3], [pairs] of the pulls on its positions.
      pulls: the same on each link, as scalar components.
    """

    unit: Array
    strength: Array
    points: Array
    weights: Array
    pulls: tuple[Pull, ...]


def _static(learner: Embodiment, metric: Metric) -> PoseObjective:
    """Constant W and weights, cosines and the mean: sums of W_ij (pi/2) (1 - e_i . e^_j) and W_ij |p_i - p^_j|.

    Of the directions all that counts of the expert is one pull for each link of the learner, t_j = sum_i W_ij e_i.
    """
    correspondence, weights = metric.correspondence, cast(DistanceWeights, metric.weights)
    directions, positions = (_pair_weights(correspondence, w) for w in (weights.rotation, weights.translation))
    pairs = _counting_pairs(correspondence, weights.translation)
    arm = _of_chain_length_one(learner)

    def target(states: LinkStates) -> StaticTarget:
        assert states.direction is not None
        dtype = states.direction.dtype
        # Elementwise: TF32 never touches it.
        pull = np.pi / 2 * jnp.sum(directions[:, :, None] * states.direction[:, None, :], axis=0)
        strength = spatial.safe_sqrt(jnp.sum(pull * pull, axis=-1))
        unit = pull / jnp.maximum(strength, jnp.finfo(pull.dtype).tiny)[:, None]
        weight = jnp.asarray(positions[pairs[:, 0], pairs[:, 1]], dtype)
        unit, strength, points = unit.astype(dtype), strength.astype(dtype), states.position[pairs[:, 0]]
        pulls = tuple(_pull(unit[j], strength[j], points, weight, pairs[:, 1] == j) for j in range(learner.num_links))
        return StaticTarget(unit, strength, points, weight, pulls)

    def value(target: StaticTarget, states: LinkStates) -> Array:
        assert states.direction is not None
        aligned = jnp.vdot(target.strength[:, None] * target.unit, states.direction)
        apart = states.position[pairs[:, 1]] - target.points
        return jnp.sum(target.weights * smoothed_length(jnp.sum(apart * apart, axis=-1), SMOOTHING)) - aligned

    def derivatives(smoothing: float, target: StaticTarget, qpos: Scalars) -> Derivatives:
        frames = joint_frames(arm, qpos, None)
        moved = zip(arm.link_joint, link_vectors(arm, frames), strict=True)
        links = [Body(joint, link.direction, link.position) for joint, link in moved]
        anchors = [frame.anchor for frame in frames[1:]]
        return static_derivatives(joint_axes(arm, frames), anchors, links, target.pulls, smoothing)

    rough, fine = (functools.partial(derivatives, smoothing) for smoothing in (ROUGH_SMOOTHING, SMOOTHING))
    return PoseObjective(metric, target, value, fine, rough if len(pairs) else fine)


def _pair_weights(correspondence: Any, weight: Any) -> Any:
    """W o weight, divided by the number of pairs: [expert, learner]; by NumPy where both are known."""
    known = not any(isinstance(x, Tracer) for x in (correspondence, weight))
    numpy = np if known else jnp
    matrix = numpy.asarray(correspondence)
    return numpy.broadcast_to(numpy.asarray(weight), matrix.shape) * matrix / matrix.size


def _counting_pairs(correspondence: Any, weight: Any) -> Int[np.ndarray, "pairs 2"]:
    """Pairs of links whose positions count; all of them where W is known only when the program runs."""
    counts = np.full(np.shape(correspondence), True)
    if not isinstance(correspondence, Tracer):
        counts &= np.asarray(correspondence) != 0
    if not isinstance(weight, Tracer):
        counts &= np.asarray(weight) != 0
    return np.argwhere(counts)


def _pull(unit: Array, strength: Array, points: Array, weights: Array, own: Bool[np.ndarray, " pairs"]) -> Pull:
    """On one link, as scalars: taken out of their arrays once, not in each step of a descent."""
    mine = np.flatnonzero(own)
    return Pull(spatial.vector(unit), strength, [spatial.vector(points[i]) for i in mine], [weights[i] for i in mine])


def _of_chain_length_one(arm: Embodiment) -> Embodiment:
    """The arm with its lengths in chain lengths."""
    unit = 1 / arm.chain_length
    return dataclasses.replace(arm, joint_anchor=unit * arm.joint_anchor, link_position=unit * arm.link_position)
