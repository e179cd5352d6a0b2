"""The distance of two arms' motions under a static metric, and its gradient in closed form, on scalar components.

A static metric has a constant correspondence, constant weights, the smooth rotational measure and the mean. The
distance is then a sum over pairs of links and parts, sum_k f_k |x_k - y_k| (translation, velocities) + sum_k f_k (pi/4)
|e_k - e^_k|^2 (rotation). Its gradients with respect to the links' states are mapped to the joints as forces are by the
transposed Jacobian: in one sweep from tip to base, whatever the number of joints.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from mimic.arms.embodiment import Embodiment
from mimic.base import spatial
from mimic.base.spatial import ZERO, Scalar, Vector, add, cross, dot, plus, scale, subtract, times
from mimic.metric.distance import PARTS
from mimic.metric.kinematics import (
    JointFrame,
    LinkVectors,
    hand_vectors,
    joint_frames,
    link_vectors,
    row_joints,
)

_ROTATION = PARTS.index("rotation")
_REST = LinkVectors(ZERO, ZERO, ZERO, ZERO)


class Adjoints(NamedTuple):
    """Sums over the links distal to a joint: gradients of the distance with respect to their states, and moments."""

    force: Vector  # gradients with respect to positions
    push: Vector  # gradients with respect to linear velocities
    spin: Vector  # gradients with respect to angular velocities
    moment: Vector  # states x gradients, of all four parts
    swing: Vector  # positions x gradients with respect to linear velocities


NO_ADJOINTS = Adjoints(ZERO, ZERO, ZERO, ZERO, ZERO)


def distance_and_gradient(
    expert: Embodiment,
    learner: Embodiment,
    factors: Float[np.ndarray, "parts rows learner_rows"],
    arguments: Sequence[int],
    *motion: Sequence[Scalar],
) -> list[list[Scalar]]:
    """The distance, and its gradients with respect to some of the arguments.

    Args:
      expert: in units of its chain length.
      learner: likewise.
      factors: see `mimic.metric.distance.Metric.factors`; a factor 0 costs nothing.
      arguments: indices into `motion`.
      *motion: qpos [rad] and qvel [rad/s] of the expert, then of the learner.

    Returns:
      [distance], then the gradient with respect to each of `arguments`.
    """
    arms = expert, learner
    frames = [joint_frames(arm, *motion[2 * side : 2 * side + 2]) for side, arm in enumerate(arms)]
    links = [link_vectors(arm, arm_frames) for arm, arm_frames in zip(arms, frames, strict=True)]
    if factors.shape[1] > expert.num_links:  # a row for each axis of a hand too
        links = [of_arm + hand_vectors(*arm) for of_arm, *arm in zip(links, arms, frames, strict=True)]  # type: ignore[arg-type]
    value, state_gradients = _compare(factors, *links)
    gradients: list[list[Scalar]] = []
    for side, arm in enumerate(arms):
        is_needed = any(index // 2 == side for index in arguments)
        gradients.extend(_by_joints(arm, frames[side], links[side], state_gradients[side]) if is_needed else ([], []))
    return [[value], *(gradients[k] for k in arguments)]


def _compare(
    factors: Float[np.ndarray, "parts rows learner_rows"], expert: list[LinkVectors], learner: list[LinkVectors]
) -> tuple[Scalar, list[list[LinkVectors]]]:
    """Distance of the links, and its gradients with respect to the states of the expert's and the learner's links."""
    value: Scalar = 0.0
    gradients = [[list(_REST) for _ in links] for links in (expert, learner)]
    for part, i, j in np.argwhere(factors).tolist():
        term, gradient = compare_part(part, float(factors[part, i, j]), expert[i], learner[j])
        value = plus(value, term)
        gradients[0][i][part] = subtract(gradients[0][i][part], gradient)
        gradients[1][j][part] = add(gradients[1][j][part], gradient)
    return value, [[LinkVectors(*vectors) for vectors in side] for side in gradients]


def compare_part(part: int, factor: Scalar, expert: LinkVectors, learner: LinkVectors) -> tuple[Scalar, Vector]:
    """A part of the distance of two links times a factor, and its gradient with respect to the learner's state.

    The gradient with respect to the expert's state is the negative.

    Args:
      part: index into `PARTS`.
      factor: of this part of the pair's distance.
      expert: state of the expert's link, in units of its chain length.
      learner: state of the learner's link, likewise.
    """
    difference = subtract(learner[part], expert[part])
    square = dot(difference, difference)
    if part == _ROTATION:
        return times(times(0.25 * math.pi, factor), square), scale(times(0.5 * math.pi, factor), difference)
    inverse = _inverse_root(square)
    return times(times(factor, square), inverse), scale(times(factor, inverse), difference)


def _inverse_root(square: Scalar) -> Scalar:
    """1 / sqrt(square) for the square of a length of order 1, limited to 1 / (machine epsilon).

    A length and its gradient are then 0 at a match. A compiler may compute a difference twice with different rounding;
    the gradient of a length that is only rounding error stays of order 1.
    """
    if isinstance(square, float):
        return 1 / math.sqrt(square) if square else 0.0
    return jax.lax.rsqrt(jnp.maximum(square, jnp.finfo(square.dtype).eps ** 2))


def _by_joints(
    arm: Embodiment, frames: Sequence[JointFrame], links: Sequence[LinkVectors], gradients: Sequence[LinkVectors]
) -> tuple[list[Scalar], list[Scalar]]:
    """The gradients with respect to qpos and qvel."""
    by_qpos, by_qvel = [], []
    of_children: dict[int, Adjoints] = {}
    for joint in reversed(range(arm.num_joints)):
        distal = of_children.get(joint, NO_ADJOINTS)
        for link in (link for link, mover in enumerate(row_joints(arm)[: len(links)]) if mover == joint):
            distal = with_link(distal, links[link], gradients[link])
        frame = frames[joint + 1]
        axis = spatial.rotate(frame.rotation, spatial.vector(arm.joint_axis[joint]))
        by_angle, by_speed = by_joint(frame, axis, distal)
        by_qpos.append(by_angle)
        by_qvel.append(by_speed)
        parent = arm.joint_parent[joint]
        of_children[parent] = _summed(of_children[parent], distal) if parent in of_children else distal
    return by_qpos[::-1], by_qvel[::-1]


def _summed(a: Adjoints, b: Adjoints) -> Adjoints:
    return Adjoints(*map(add, a, b))


def with_link(distal: Adjoints, link: LinkVectors, gradient: LinkVectors) -> Adjoints:
    """The sums with one more link.

    Args:
      distal: sums over the links distal to it.
      link: its state.
      gradient: of the distance with respect to its state.
    """
    moment = distal.moment
    for state, by_state in zip(link, gradient, strict=True):
        moment = add(moment, cross(state, by_state))
    return Adjoints(
        force=add(distal.force, gradient.position),
        push=add(distal.push, gradient.linear_velocity),
        spin=add(distal.spin, gradient.angular_velocity),
        moment=moment,
        swing=add(distal.swing, cross(link.position, gradient.linear_velocity)),
    )


def by_joint(frame: JointFrame, axis: Vector, distal: Adjoints) -> tuple[Scalar, Scalar]:
    """Derivatives of the distance with respect to a joint's angle and velocity.

    The joint has the axis a and the anchor c, which moves at u; its child body rotates at w. For a distal link at
    r = p - c, whose body rotates at w_l,

        dp/dq = a x r    de/dq = a x e    dw_l/dq = a x (w_l - w)    dv/dq = a x (v - u) + (w x a) x r
                                          dw_l/dqdot = a             dv/dqdot = a x r

    so that only sums over all distal links are needed.

    Args:
      frame: of the joint's child body.
      axis: of the joint, in the base frame.
      distal: sums over the links distal to the joint.
    """
    about_anchor = subtract(distal.swing, cross(frame.anchor, distal.push))
    torque = subtract(distal.moment, cross(frame.anchor, distal.force))
    torque = subtract(torque, cross(frame.linear_velocity, distal.push))
    torque = add(torque, cross(frame.angular_velocity, subtract(ZERO, add(distal.spin, about_anchor))))
    return dot(axis, torque), dot(axis, add(distal.spin, about_anchor))
