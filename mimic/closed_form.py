"""First and second derivatives of the static distance by the learner's joint angles, in closed form.

Each link of the learner is pulled by the expert: its direction e towards a unit vector t with strength c, its position p
towards points p_i with weights w_i. Up to a constant of the expert, the distance is the sum over the links of

    c (1 - e . t) + sum_i w_i s(|p - p_i|)        with a smoothed length, s(d) = sqrt(d^2 + SMOOTHING^2) - SMOOTHING.

A length has a kink at 0, where Newton's method would divide by it, and a sum of lengths often has its minimum there, at
links that match exactly. Smoothed, it is 0 with derivative 0 at a match, and nowhere off by more than SMOOTHING.

All is done on scalar components (see `mimic.spatial`). Rotating joint k moves all distal links: with its axis a and a
point c on it, a link's position by J = a x (p - c) = m + a x p, m = c x a. Sums over the distal links are accumulated
from tip to base, as for a composite rigid body: the force g = grad s, the moments M of force and pull, and the
stiffness of position.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp

from mimic import spatial
from mimic.descent import Derivatives
from mimic.spatial import Rotation, Scalar, Vector

ROUGH = 1e-2
SMOOTHING = 1e-3  # of the distance of two positions [chain lengths]

Symmetric = tuple[Scalar, ...]  # xx, xy, xz, yy, yz, zz of a symmetric 3x3 matrix
_NONE: Symmetric = (0.0,) * 6


class Pull(NamedTuple):
    """What pulls on one link.

    Attributes:
      unit: t, where its direction is pulled to.
      strength: c, 0 or more.
      points: p_i, where its position is pulled to [chain lengths].
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
    """Of the links distal to a joint, about the base's origin.

    Attributes:
      value: of the distance.
      force: its gradient by a translation.
      moment: sum of p g^T - c e t^T. Its antisymmetric part is the gradient by a rotation.
      linear, coupling, angular: second derivative K, B, C by the positions' part of a twist (a, m):
        force K m + B a, torque C a + B^T m.
    """

    value: Scalar = 0.0
    force: Vector = spatial.ZERO
    moment: Rotation = (spatial.ZERO,) * 3
    linear: Symmetric = _NONE
    coupling: Rotation = (spatial.ZERO,) * 3
    angular: Symmetric = _NONE


def smoothed_length(square: Scalar, smoothing: float = SMOOTHING) -> Scalar:
    """A length as the distance counts it, of its square [chain lengths^2]."""
    return square / (jnp.sqrt(square + smoothing**2) + smoothing)


def static_derivatives(
    axes: Sequence[Vector], anchors: Sequence[Vector], links: Sequence[Body], pulls: Sequence[Pull],
    smoothing: float = SMOOTHING,
) -> Derivatives:
    """Derivatives of the static distance; its value up to a constant of the pulls.

    With M taken about a point on axis l, and the twist's torque and force of the stiffness,

        d/dq_l       = a_l . (M_zy - M_yz, M_xz - M_zx, M_yx - M_xy), the sum of (p - c) x g and -c e x t,
        d^2/dq_k dq_l = a_k . (torque_l + M a_l - tr(M) a_l) + m_k . force_l         for k <= l.

    Args:
      axes: unit axis of each joint, base to tip.
      anchors: a point on each axis [chain lengths].
      links: of the learner.
      pulls: on each link.
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
    apart = spatial.subtract(direction, pull.unit)  # |e - t|^2 / 2 = 1 - e . t, to the last digit at a match
    value = 0.5 * pull.strength * spatial.dot(apart, apart)
    moment = spatial.add_outer(load.moment, spatial.scale(-pull.strength, direction), pull.unit)
    return load._replace(value=spatial.plus(load.value, value), moment=moment)


def _add_position(load: _Load, position: Vector, pull: Pull, smoothing: float) -> _Load:
    if all(isinstance(x, float) for x in position):  # on the axis of all joints that could move it
        return load
    value, force, stiffness = load.value, spatial.ZERO, _NONE
    for point, weight in zip(pull.points, pull.weights, strict=True):
        apart = spatial.subtract(position, point)
        square = spatial.dot(apart, apart)
        inverse = 1 / jnp.sqrt(square + smoothing**2)
        tension = weight * inverse
        value = spatial.plus(value, weight * smoothed_length(square, smoothing))
        force = spatial.add(force, spatial.scale(tension, apart))
        # tension (I - u u^T), u = apart * inverse
        unit = spatial.scale(inverse, apart)
        stiffness = tuple(map(spatial.plus, stiffness, _projection(tension, unit)))
    if not pull.points:
        return load
    coupling = tuple(spatial.cross(position, row) for row in _rows(stiffness))
    columns = [spatial.cross(position, column) for column in spatial.transpose(coupling)]
    angular = (columns[0][0], columns[1][0], columns[2][0], columns[1][1], columns[2][1], columns[2][2])
    return _Load(
        value=value,
        force=spatial.add(load.force, force),
        moment=spatial.add_outer(load.moment, position, force),
        linear=tuple(map(spatial.plus, load.linear, stiffness)),
        coupling=tuple(map(spatial.add, load.coupling, coupling)),
        angular=tuple(map(spatial.plus, load.angular, angular)),
    )


def _projection(factor: Scalar, unit: Vector) -> Symmetric:
    """factor (I - u u^T)."""
    x, y, z = unit
    u, v, w = (spatial.times(-factor, component) for component in unit)
    return factor + u * x, u * y, u * z, factor + v * y, v * z, factor + w * z


def _rows(matrix: Symmetric) -> Rotation:
    xx, xy, xz, yy, yz, zz = matrix
    return (xx, xy, xz), (xy, yy, yz), (xz, yz, zz)


def _twice_antisymmetric(matrix: Rotation) -> Vector:
    """The sum of r x g, of the sum of r g^T."""
    (_, xy, xz), (yx, _, yz), (zx, zy, _) = matrix
    return spatial.minus(yz, zy), spatial.minus(zx, xz), spatial.minus(xy, yx)
