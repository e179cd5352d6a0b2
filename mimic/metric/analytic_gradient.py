"""The usual embodiment distance of two arms' motions, and its gradient in closed form, on scalar components.

Usual: a given correspondence and constant weights, the smooth rotational measure, the mean. The distance is then a sum
over pairs of links and parts, sum_k f_k |x_k - y_k| (translation, velocities) + sum_k f_k (pi/4) |e_k - e^_k|^2
(rotation). Its slopes with respect to the links' states are carried to the joints as forces are by the transposed
Jacobian: one sweep from the tip to the base, whatever the number of joints.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from mimic.arms.embodiment import Embodiment
from mimic.metric import spatial
from mimic.metric.distance import PARTS
from mimic.metric.kinematics import JointFrame, LinkVectors, joint_frames, link_vectors
from mimic.metric.spatial import ZERO, Scalar, Vector, add, cross, dot, plus, scale, subtract, times

_ROTATION = PARTS.index("rotation")
_REST = LinkVectors(ZERO, ZERO, ZERO, ZERO)


class Adjoints(NamedTuple):
    """Sums over the links behind a joint: of the distance's slopes with respect to their states, and of moments."""

    force: Vector  # by positions
    push: Vector  # by linear velocities
    spin: Vector  # by angular velocities
    moment: Vector  # states x slopes, of all four
    swing: Vector  # positions x slopes by linear velocities


NO_ADJOINTS = Adjoints(ZERO, ZERO, ZERO, ZERO, ZERO)


def distance_and_gradient(
    expert: Embodiment,
    learner: Embodiment,
    factors: Float[np.ndarray, "parts expert learner"],
    wanted: Sequence[int],
    *motion: Sequence[Scalar],
) -> list[list[Scalar]]:
    """The distance, and its gradient by some of the arguments.

    Args:
      expert: in units of its chain length.
      learner: likewise.
      factors: what each part of each pair's distance counts for; one that is 0 costs nothing.
      wanted: indices into `motion`.
      *motion: qpos [rad] and qvel [rad/s] of the expert, then of the learner.

    Returns:
      [distance], then a gradient for each that is wanted.
    """
    arms = expert, learner
    frames = [joint_frames(arm, *motion[2 * side : 2 * side + 2]) for side, arm in enumerate(arms)]
    links = [link_vectors(arm, own) for arm, own in zip(arms, frames, strict=True)]
    value, slopes = _compare(factors, *links)
    gradients: list[list[Scalar]] = []
    for side, arm in enumerate(arms):
        is_wanted = any(index // 2 == side for index in wanted)
        gradients.extend(_by_joints(arm, frames[side], links[side], slopes[side]) if is_wanted else ([], []))
    return [[value], *(gradients[k] for k in wanted)]


def _compare(
    factors: Float[np.ndarray, "parts expert learner"], expert: list[LinkVectors], learner: list[LinkVectors]
) -> tuple[Scalar, list[list[LinkVectors]]]:
    """The distance of links, and its slopes with respect to the states of the expert's and of the learner's links."""
    value: Scalar = 0.0
    slopes = [[list(_REST) for _ in links] for links in (expert, learner)]
    for part, i, j in np.argwhere(factors).tolist():
        term, slope = compare_part(part, float(factors[part, i, j]), expert[i], learner[j])
        value = plus(value, term)
        slopes[0][i][part] = subtract(slopes[0][i][part], slope)
        slopes[1][j][part] = add(slopes[1][j][part], slope)
    return value, [[LinkVectors(*slope) for slope in side] for side in slopes]


def compare_part(part: int, factor: Scalar, expert: LinkVectors, learner: LinkVectors) -> tuple[Scalar, Vector]:
    """A part of the distance of two links times a factor, and its slope with respect to the learner's state.

    The slope with respect to the expert's is the negative of it.

    Args:
      part: index into `PARTS`.
      factor: what the part of this pair's distance counts for.
      expert: one of its links, in units of its chain length.
      learner: likewise.
    """
    apart = subtract(learner[part], expert[part])
    square = dot(apart, apart)
    if part == _ROTATION:
        return times(times(0.25 * math.pi, factor), square), scale(times(0.5 * math.pi, factor), apart)
    inverse = _inverse_root(square)
    return times(times(factor, square), inverse), scale(times(factor, inverse), apart)


def _inverse_root(square: Scalar) -> Scalar:
    """1 / sqrt of the square of a length, in units of about 1; but no more than 1 / rounding.

    A length and its gradient are then 0 at a match. A compiler may compute a difference twice, rounded otherwise the
    second time: the gradient of a length of nothing but rounding is still of the order of 1.
    """
    if isinstance(square, float):
        return 1 / math.sqrt(square) if square else 0.0
    return jax.lax.rsqrt(jnp.maximum(square, jnp.finfo(square.dtype).eps ** 2))


def _by_joints(
    arm: Embodiment, frames: Sequence[JointFrame], links: Sequence[LinkVectors], slopes: Sequence[LinkVectors]
) -> tuple[list[Scalar], list[Scalar]]:
    """The gradient by qpos and by qvel."""
    behind = NO_ADJOINTS
    by_qpos, by_qvel = [], []
    for joint in reversed(range(arm.num_joints)):
        for link in (link for link, own in enumerate(arm.link_joint) if own == joint):
            behind = with_link(behind, links[link], slopes[link])
        frame = frames[joint + 1]
        axis = spatial.rotate(frame.rotation, spatial.vector(arm.joint_axis[joint]))
        by_angle, by_speed = by_joint(frame, axis, behind)
        by_qpos.append(by_angle)
        by_qvel.append(by_speed)
    return by_qpos[::-1], by_qvel[::-1]


def with_link(behind: Adjoints, link: LinkVectors, slope: LinkVectors) -> Adjoints:
    """The sums with one more link."""
    moment = behind.moment
    for state, by_state in zip(link, slope, strict=True):
        moment = add(moment, cross(state, by_state))
    return Adjoints(
        force=add(behind.force, slope.position),
        push=add(behind.push, slope.linear_velocity),
        spin=add(behind.spin, slope.angular_velocity),
        moment=moment,
        swing=add(behind.swing, cross(link.position, slope.linear_velocity)),
    )


def by_joint(frame: JointFrame, axis: Vector, behind: Adjoints) -> tuple[Scalar, Scalar]:
    """The slopes by a joint's angle and by its velocity.

    With the joint's axis a, its anchor c that moves at u, and the angular velocity w of the body behind it, for a link
    behind it at r = p - c, whose body turns at w_l

        dp/dq = a x r    de/dq = a x e    dw_l/dq = a x (w_l - w)    dv/dq = a x (v - u) + (w x a) x r
                                          dw_l/dqdot = a             dv/dqdot = a x r

    so that only sums over all links behind the joint are needed.

    Args:
      frame: of the body behind the joint.
      axis: the joint's, in the base frame.
      behind: of the links.
    """
    about_anchor = subtract(behind.swing, cross(frame.anchor, behind.push))
    turning = subtract(behind.moment, cross(frame.anchor, behind.force))
    turning = subtract(turning, cross(frame.linear_velocity, behind.push))
    turning = add(turning, cross(frame.angular_velocity, subtract(ZERO, add(behind.spin, about_anchor))))
    return dot(axis, turning), dot(axis, add(behind.spin, about_anchor))
