"""The hand in the metric: the state of an arm's hand frame, and the distance of two hands."""

import math
from typing import Any

import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float

from mimic.base import spatial
from mimic.base.ranges import weight_number


@struct.dataclass
class HandStates:
    """Poses and angular velocities of an arm's hands, in the base frame.

    Attributes:
      position: [hands, 3] origins; in chain lengths where normalized, else [m].
      axes: [3 hands, 3] unit x-, y- and z-axis of each hand in turn; z is the approach, and the gripper opens along x.
      angular_velocity: [hands, 3] in rad/s.
    """

    position: Float[Array, "hands 3"]
    axes: Float[Array, "axes 3"]
    angular_velocity: Float[Array, "hands 3"]


@struct.dataclass
class HandWeights:
    """Weights of the hand's rotation [1/rad], position [1/chain length] and angular velocity [s/rad] in the metric.

    Attributes:
      rotation, position, angular_velocity: numbers.
      pairs: indices of corresponding hands of expert and learner; their mean distance counts.
    """

    rotation: Any = weight_number(0.0)
    position: Any = weight_number(0.0)
    angular_velocity: Any = weight_number(0.0)
    pairs: tuple[tuple[int, int], ...] = struct.field(pytree_node=False, default=((0, 0),))

    @property
    def are_zero(self) -> bool:
        """Whether all are the constant 0, so that the metric has no hand."""
        weights = self.rotation, self.position, self.angular_velocity
        return all(isinstance(weight, int | float) and weight == 0 for weight in weights)


NO_HAND = HandWeights()
"""The weights of the paper, whose metric has no hand."""


def hand_distance(expert: HandStates | None, learner: HandStates | None, weights: HandWeights) -> Float[Array, ""]:
    """Weighted distance of hands: the mean over `weights.pairs`.

    The rotational part is the smooth (pi/2)(1 - cos theta), in [0, pi], of the angle theta between both frames: the
    measure of the paper's eq. 17 for full rotations.

    Args:
      expert: hands of the expert; normalized, to compare arms of different size.
      learner: hands of the learner.
      weights: of the parts.

    Raises:
      ValueError: an arm without a known hand, or a pair that the arms lack.
    """
    check_hands(expert, learner, weights)
    assert expert is not None and learner is not None
    total: Any = 0.0
    for i, j in weights.pairs:
        position, angular_velocity = (
            spatial.norm(spatial.subtract(spatial.vector(a[i]), spatial.vector(b[j])))
            for a, b in (
                (expert.position, learner.position),
                (expert.angular_velocity, learner.angular_velocity),
            )
        )
        # tr(R^T R_hat) = 1 + 2 cos theta, so that |R - R_hat|^2 = 4 (1 - cos theta): exactly 0 at a match.
        axes = expert.axes[3 * i : 3 * i + 3] - learner.axes[3 * j : 3 * j + 3]
        rotation = math.pi / 8 * jnp.sum(axes * axes)
        total = total + weights.rotation * rotation + weights.position * position
        total = total + weights.angular_velocity * angular_velocity
    return jnp.asarray(total / len(weights.pairs), expert.position.dtype)


def hand_factors(weights: HandWeights, hands: int, learner_hands: int) -> Float[Any, "4 axes learner_axes"]:
    """Factor of each part of the pair distance of two links, where each axis of a hand is a link with its direction.

    The rotational distance of two hands is half the sum of (pi/2)(1 - e . e_hat) over their axes; position and angular
    velocity count once, on the x-axes. The parts are those of `mimic.metric.distance.PARTS`.
    """
    rotation = np.zeros((3 * hands, 3 * learner_hands))
    first = rotation.copy()
    for i, j in weights.pairs:
        rotation[3 * i : 3 * i + 3, 3 * j : 3 * j + 3] += 0.5 * np.eye(3) / len(weights.pairs)
        first[3 * i, 3 * j] += 1 / len(weights.pairs)
    parts = weights.position * first, weights.rotation * rotation, 0.0 * first, weights.angular_velocity * first
    numpy = np if all(isinstance(part, np.ndarray) for part in parts) else jnp
    return numpy.stack(parts)


def check_hands(expert: HandStates | None, learner: HandStates | None, weights: HandWeights) -> None:
    """Raises a ValueError where an arm lacks a hand that `weights.pairs` names."""
    for index, (name, arm) in enumerate((("expert", expert), ("learner", learner))):
        hands = 0 if arm is None else len(arm.position)
        expected = 1 + max(pair[index] for pair in weights.pairs)
        if hands < expected:
            raise ValueError(f"hand_weights: expected {expected} hand(s) of the {name}, which has {hands}; else 0")
