"""The embodiment distance as a function of the learner's pose, with its first two derivatives."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from mimic import spatial
from mimic.descent import Derivatives, Scalars
from mimic.distance import Correspondence, DistanceWeights, Reduction, RotationMeasure, Weights, embodiment_distance
from mimic.embodiment import Embodiment
from mimic.kinematics import LinkStates, axes_and_directions, link_states

Target = Any  # what of the expert's pose counts: a pytree


@dataclasses.dataclass(frozen=True)
class PoseObjective:
    """What pose imitation minimises.

    Attributes:
      distance: embodiment distance of the expert's and the learner's link states, both at rest.
      target: of the expert's link states.
      value: of the target and the learner's link states: the distance, up to a constant of the target.
      derivatives: of the target and the learner's joint angles: of the distance, its value up to a constant too.
    """

    distance: Callable[[LinkStates, LinkStates], Array]
    target: Callable[[LinkStates], Target]
    value: Callable[[Target, LinkStates], Array]
    derivatives: Callable[[Target, Scalars], Derivatives]


def pose_objective(
    learner: Embodiment,
    correspondence: Correspondence,
    weights: Weights,
    rotation: RotationMeasure,
    reduction: Reduction,
) -> PoseObjective:
    """In closed form for the static rotational measure; any other is differentiated automatically."""

    def distance(expert_states: LinkStates, learner_states: LinkStates) -> Array:
        return embodiment_distance(
            expert_states, learner_states, correspondence, weights, rotation=rotation, reduction=reduction
        )

    static = not callable(correspondence) and isinstance(weights, DistanceWeights)
    if static and rotation == "cosine" and reduction == "mean" and _is_zero(weights.translation):
        return _directional(learner, jnp.asarray(correspondence) * weights.rotation, distance)
    return _differentiated(learner, distance)


def _is_zero(weight: Any) -> bool:
    return not isinstance(weight, Tracer) and not np.any(np.asarray(weight))


def _differentiated(learner: Embodiment, distance: Callable[[LinkStates, LinkStates], Array]) -> PoseObjective:
    def derivatives(target: LinkStates, qpos: Scalars) -> Derivatives:
        def gradient_and_value(qpos: Array) -> tuple[Array, tuple[Array, Array]]:
            value, gradient = jax.value_and_grad(lambda q: distance(target, link_states(learner, q)))(qpos)
            return gradient, (value, gradient)

        hessian, (value, gradient) = jax.jacfwd(gradient_and_value, has_aux=True)(jnp.stack(qpos))
        return Derivatives(value, tuple(gradient), tuple(map(tuple, hessian)))

    return PoseObjective(distance, lambda states: states, distance, derivatives)


def _directional(
    learner: Embodiment,
    matrix: Float[Array, "expert learner"],
    distance: Callable[[LinkStates, LinkStates], Array],
) -> PoseObjective:
    """The static rotational measure, the mean of W_ij (pi/2) (1 - e_i . e^_j).

    All that counts of the expert is one pull for each link of the learner, t_j = sum_i W_ij e_i: up to a constant, the
    distance is c sum_j |t_j| (1 - e^_j . t_j / |t_j|), c = pi / (2 n n^). Turning joint k moves all links behind it
    about its axis a_k, so with M_k = c sum_{j >= k} e^_j t_j^T

        d/dq_k         = -c a_k . sum_{j >= k} e^_j x t_j
        d^2/dq_k dq_l  = -a_k . (M_l a_l - tr(M_l) a_l)                for k <= l.
    """
    factor = np.pi / 2 / matrix.size

    def target(states: LinkStates) -> tuple[Array, Array]:
        assert states.direction is not None
        # Elementwise: TF32 never touches it.
        pull = factor * jnp.sum(matrix[:, :, None] * states.direction[:, None, :], axis=0)
        strength = spatial.safe_sqrt(jnp.sum(pull * pull, axis=-1))
        unit = pull / jnp.maximum(strength, jnp.finfo(pull.dtype).tiny)[:, None]
        return unit.astype(states.direction.dtype), strength.astype(states.direction.dtype)

    def value(target: tuple[Array, Array], states: LinkStates) -> Array:
        assert states.direction is not None
        unit, strength = target
        return -jnp.vdot(strength[:, None] * unit, states.direction)

    def derivatives(target: tuple[Array, Array], qpos: Scalars) -> Derivatives:
        axes, directions = axes_and_directions(learner, qpos)
        return _directional_derivatives(learner.link_joint, axes, directions, *target)

    return PoseObjective(distance, target, value, derivatives)


def _directional_derivatives(
    link_joint: tuple[int, ...],
    axes: list[spatial.Vector],
    directions: list[spatial.Vector],
    unit: Float[Array, "links 3"],
    strength: Float[Array, " links"],
) -> Derivatives:
    # Sums over the links behind a joint.
    value, turning = 0.0, spatial.ZERO
    outer: spatial.Rotation = (spatial.ZERO, spatial.ZERO, spatial.ZERO)
    gradient, moments = [], []
    for joint in reversed(range(len(axes))):
        for link in (link for link, own in enumerate(link_joint) if own == joint):
            direction, goal = directions[link], spatial.vector(unit[link])
            apart = spatial.subtract(direction, goal)  # |e - t|^2 / 2 = 1 - e . t, to the last digit at a match
            value = spatial.plus(value, 0.5 * strength[link] * spatial.dot(apart, apart))
            pull = spatial.scale(strength[link], goal)
            turning = spatial.add(turning, spatial.cross(direction, pull))
            outer = spatial.add_outer(outer, direction, pull)
        axis = axes[joint]
        trace = spatial.plus(spatial.plus(outer[0][0], outer[1][1]), outer[2][2])
        gradient.append(-spatial.dot(axis, turning))
        moments.append(spatial.subtract(spatial.rotate(outer, axis), spatial.scale(trace, axis)))
    gradient, moments = gradient[::-1], moments[::-1]
    hessian = [[-spatial.dot(axes[k], moments[i]) for k in range(i + 1)] for i in range(len(axes))]
    return Derivatives(value, tuple(gradient), hessian)
