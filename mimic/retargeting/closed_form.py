"""First and second derivatives of the static distance with respect to the learner's joint angles, in closed form.

The expert pulls each link of the learner: its direction e towards a unit vector t with strength c, and its position p
towards points p_i with weights w_i. Up to a constant of the expert, the distance is the sum over the links of

    c (1 - e . t) + sum_i w_i h(|p - p_i|)        with a smoothed length, h(d) = sqrt(d^2 + s^2) - s.

A length has a kink at 0, where Newton's method would divide by it; a sum of lengths often has its minimum there, at
links that match exactly. The smoothed length is 0 with derivative 0 at a match, and its error is at most s.

The computation is on scalar components (see `mimic.metric.spatial`). Rotating joint k moves all distal links: with its
axis a and a point c on it, a link's position by J = a x (p - c) = m + a x p, m = c x a. Sums over the distal links are
accumulated from tip to base, as for a composite rigid body: the force g = grad h, the moments M of force and pull, and
the stiffness of position.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp

from mimic.metric import spatial
from mimic.metric.spatial import Rotation, Scalar, Vector
from mimic.retargeting.optimizers import Derivatives

# s [chain lengths]. Newton steps overshoot a kink that is many s away, so a descent begins with the rough smoothing.
# Panda 7 to 4, weights (2, 1), 16 steps: 93 % of 256 poses converge with 1e-3 alone, 98 % with both; 1e-2 alone leaves
# more than 1e-4 of distance on 55 % of them, both on 3 %; with 1e-4 alone 89 % converge.
ROUGH_SMOOTHING, SMOOTHING = 1e-2, 1e-3

Symmetric = tuple[Scalar, ...]  # xx, xy, xz, yy, yz, zz of a symmetric 3x3 matrix
_NONE: Symmetric = (0.0,) * 6
_ZEROS: Rotation = (spatial.ZERO, spatial.ZERO, spatial.ZERO)


class Pull(NamedTuple):
    """Pull of the expert on one link.

    Attributes:
      unit: t, target of its direction.
      strength: c, at least 0.
      points: p_i, targets of its position [chain lengths].
      weights: w_i.
    """

    unit: Vector
    strength: Scalar
    points: Sequence[Vector]
    weights: Sequence[Scalar]


class Body(NamedTuple):
    """A link: the joint that moves it (-1: none), its direction, and its position [chain lengths]."""

    joint: int
    direction: Vector
    position: Vector


class _Load(NamedTuple):
    """Sums over the links distal to a joint, about the origin of the base.

    Attributes:
      value: of the distance.
      force: its gradient with respect to a translation.
      moment: sum of p g^T - c e t^T. Its antisymmetric part is the gradient with respect to a rotation.
      linear, coupling, angular: second derivative K, B, C of the position terms with respect to a twist (a, m):
        force K m + B a, torque C a + B^T m.
    """

    value: Any = 0.0
    force: Vector = spatial.ZERO
    moment: Rotation = _ZEROS
    linear: Symmetric = _NONE
    coupling: Rotation = _ZEROS
    angular: Symmetric = _NONE


def smoothed_length(square: Scalar, smoothing: Scalar) -> Scalar:
    """Smoothed length h [chain lengths] from the square of the length, without cancellation at 0."""
    return square / (jnp.sqrt(square + smoothing**2) + smoothing)


def static_derivatives(
    axes: Sequence[Vector],
    anchors: Sequence[Vector],
    links: Sequence[Body],
    pulls: Sequence[Pull],
    smoothing: Scalar,
) -> Derivatives:
    """Derivatives of the static distance, whose value is up to a constant of the pulls.

    With M taken about a point on axis l, and the twist's torque and force of the stiffness,

        d/dq_l       = a_l . (M_zy - M_yz, M_xz - M_zx, M_yx - M_xy), the sum of (p - c) x g and -c e x t,
        d^2/dq_k dq_l = a_k . (torque_l + M a_l - tr(M) a_l) + m_k . force_l         for k <= l.

    Args:
      axes: unit axis of each joint, base to tip.
      anchors: a point on each axis [chain lengths].
      links: links of the learner.
      pulls: pull on each link.
      smoothing: s [chain lengths].
    """
    moments = [spatial.cross(anchor, axis) for anchor, axis in zip(anchors, axes, strict=True)]
    load, gradient, rows = _Load(), [], []
    for joint in reversed(range(len(axes))):
        for link, pull in zip(links, pulls, strict=True):
            if link.joint == joint:
                load = _add_position(_add_direction(load, link.direction, pull), link.position, pull, smoothing)
        axis, moment = axes[joint], moments[joint]
        local = spatial.add_outer(load.moment, spatial.scale(-1.0, anchors[joint]), load.force)
        gradient.append(spatial.dot(axis, _twice_antisymmetric(local)))
        trace = spatial.plus(spatial.plus(local[0][0], local[1][1]), local[2][2])
        force = spatial.add(spatial.rotate(_rows(load.linear), moment), spatial.rotate(load.coupling, axis))
        torque = spatial.rotate(spatial.transpose(load.coupling), moment)
        torque = spatial.add(torque, spatial.rotate(_rows(load.angular), axis))
        torque = spatial.add(torque, spatial.subtract(spatial.rotate(local, axis), spatial.scale(trace, axis)))
        row = [(spatial.dot(axes[k], torque), spatial.dot(moments[k], force)) for k in range(joint + 1)]
        rows.append([spatial.plus(*parts) for parts in row])
    return Derivatives(load.value, tuple(gradient[::-1]), rows[::-1])


def _add_direction(load: _Load, direction: Vector, pull: Pull) -> _Load:
    difference = spatial.subtract(direction, pull.unit)  # |e - t|^2 / 2 = 1 - e . t, exactly 0 at a match
    value = 0.5 * pull.strength * spatial.dot(difference, difference)
    moment = spatial.add_outer(load.moment, spatial.scale(-pull.strength, direction), pull.unit)
    return load._replace(value=spatial.plus(load.value, value), moment=moment)


def _add_position(load: _Load, position: Vector, pull: Pull, smoothing: Scalar) -> _Load:
    if not pull.points or all(isinstance(x, float) for x in position):  # such a position cannot move
        return load
    value, force, stiffness = load.value, spatial.ZERO, _NONE
    for point, weight in zip(pull.points, pull.weights, strict=True):
        difference = spatial.subtract(position, point)
        square = spatial.dot(difference, difference)
        inverse = 1 / jnp.sqrt(square + smoothing**2)
        tension = weight * inverse
        value = spatial.plus(value, weight * smoothed_length(square, smoothing))
        force = spatial.add(force, spatial.scale(tension, difference))
        stiffness = tuple(map(spatial.plus, stiffness, _projection(tension, spatial.scale(inverse, difference))))
    x, y, z = _rows(stiffness)
    coupling = spatial.cross(position, x), spatial.cross(position, y), spatial.cross(position, z)
    columns = [spatial.cross(position, column) for column in spatial.transpose(coupling)]
    angular = (columns[0][0], columns[1][0], columns[2][0], columns[1][1], columns[2][1], columns[2][2])
    return _Load(
        value=value,
        force=spatial.add(load.force, force),
        moment=spatial.add_outer(load.moment, position, force),
        linear=tuple(map(spatial.plus, load.linear, stiffness)),
        coupling=_sum(load.coupling, coupling),
        angular=tuple(map(spatial.plus, load.angular, angular)),
    )


def _projection(factor: Scalar, unit: Vector) -> Symmetric:
    """The matrix factor (I - u u^T)."""
    x, y, z = unit
    u, v, w = (spatial.times(-factor, component) for component in unit)
    return factor + u * x, u * y, u * z, factor + v * y, v * z, factor + w * z


def _sum(a: Rotation, b: Rotation) -> Rotation:
    return spatial.add(a[0], b[0]), spatial.add(a[1], b[1]), spatial.add(a[2], b[2])


def _rows(matrix: Symmetric) -> Rotation:
    xx, xy, xz, yy, yz, zz = matrix
    return (xx, xy, xz), (xy, yy, yz), (xz, yz, zz)


def _twice_antisymmetric(matrix: Rotation) -> Vector:
    """The sum of r x g, computed from the sum of r g^T."""
    (_, xy, xz), (yx, _, yz), (zx, zy, _) = matrix
    return spatial.minus(yz, zy), spatial.minus(zx, xz), spatial.minus(xy, yx)
