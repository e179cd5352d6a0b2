"""First and second derivatives of the static distance with respect to the learner's joint angles, in closed form.

The expert pulls each link of the learner: its direction e towards unit vectors t_i with strengths c_i, and its position
p towards points p_i with weights w_i. Up to a constant of the expert, the distance is the sum over the links of

    sum_i c_i f(e . t_i) + sum_i w_i h(|p - p_i|)        with a smoothed length, h(d) = sqrt(d^2 + s^2) - s.

f is 1 - e . t for the cosine, or a smoothed angle, f(x) = arccos(x cos a) - a: near a match it is h of the angle with
s = a, and it is also smooth where both are opposite. It has a derivative of c_i f' e x t_i with
respect to a rotation, and c_i f'' (e x t_i)(e x t_i)^T in the second one.

A length has a kink at 0, where Newton's method would divide by it; a sum of lengths often has its minimum there, at
links that match exactly. The smoothed length is 0 with derivative 0 at a match, and its error is at most s.

The computation is on scalar components (see `mimic.base.spatial`). Rotating joint k moves all distal links: with its
axis a and a point c on it, a link's position by J = a x (p - c) = m + a x p, m = c x a. Sums over the distal links are
accumulated from the tips to the base, as for a composite rigid body: the force g = grad h, the moments M of force and
pull, and the stiffness of position.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from mimic.base import spatial
from mimic.base.spatial import Rotation, Scalar, Vector
from mimic.metric.distance import RotationMeasure
from mimic.retargeting.optimizers import Derivatives


class Smoothing(NamedTuple):
    """Smoothing of the distance.

    Attributes:
      length: s [chain lengths].
      angle: a [rad]; of no effect on the cosine.
    """

    length: Scalar
    angle: Scalar


# Newton steps overshoot a kink that is many s away, so a descent begins with the rough smoothing.
# Panda 7 to 4, weights (2, 1), 16 steps: 93 % of 256 poses converge with 1e-3 alone, 98 % with both; 1e-2 alone leaves
# more than 1e-4 of distance on 55 % of them, both on 3 %; with 1e-4 alone 89 % converge.
ROUGH_SMOOTHING, SMOOTHING = Smoothing(1e-2, 0.1), Smoothing(1e-3, 0.01)

Symmetric = tuple[Scalar, ...]  # xx, xy, xz, yy, yz, zz of a symmetric 3x3 matrix
_NONE: Symmetric = (0.0,) * 6
_ZEROS: Rotation = (spatial.ZERO, spatial.ZERO, spatial.ZERO)


class Pull(NamedTuple):
    """Pull of the expert on one link.

    Attributes:
      units: t_i, targets of its direction; one for the cosine, since the sum of cosines is that of one target.
      strengths: c_i.
      points: p_i, targets of its position [chain lengths].
      weights: w_i.
    """

    units: Sequence[Vector]
    strengths: Sequence[Scalar]
    points: Sequence[Vector]
    weights: Sequence[Scalar]


class Body(NamedTuple):
    """A link: the joint that moves it (-1: none), its direction, and its position [chain lengths]."""

    joint: int
    direction: Vector
    position: Vector


class Load(NamedTuple):
    """Sums over the links distal to a joint, about the origin of the base.

    Attributes:
      value: of the distance.
      force: its gradient with respect to a translation.
      moment: sum of p g^T + c f' e t^T. Its antisymmetric part is the gradient with respect to a rotation.
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
    parents: Sequence[int],
    smoothing: Smoothing,
    *,
    rotation: RotationMeasure = "cosine",
) -> Derivatives:
    """Derivatives of the static distance, whose value is up to a constant of the pulls.

    With M taken about a point on axis l, and the twist's torque and force of the stiffness,

        d/dq_l       = a_l . (M_zy - M_yz, M_xz - M_zx, M_yx - M_xy), the sum of (p - c) x g and c f' e x t,
        d^2/dq_k dq_l = a_k . (torque_l + M a_l - tr(M) a_l) + m_k . force_l         for l and its ancestors k, else 0.

    Args:
      axes: unit axis of each joint, base to tip.
      anchors: a point on each axis [chain lengths].
      links: links of the learner.
      pulls: pull on each link.
      parents: index of each joint's parent, -1 for a joint at the base.
      smoothing: s and a.
      rotation: measure of directions.
    """
    loads: dict[int, Load] = {}  # of the links distal to each joint; that of the base is unused
    for joint in reversed(range(len(axes))):
        load = loads.get(joint, Load())
        for link, pull in zip(links, pulls, strict=True):
            if link.joint == joint:
                load = add_directions(load, link.direction, pull, rotation, smoothing.angle)
                load = add_position(load, link.position, pull, smoothing.length)
        loads[joint], parent = load, parents[joint]
        loads[parent] = total(loads[parent], load) if parent in loads else load
    return derivatives_of_loads(axes, anchors, [loads[joint] for joint in range(len(axes))], parents, loads[-1].value)


def derivatives_of_loads(
    axes: Sequence[Vector],
    anchors: Sequence[Vector],
    loads: Sequence["Load"],
    parents: Sequence[int],
    value: Scalar,
) -> Derivatives:
    """`static_derivatives` from the sums over the links distal to each joint, and the value of all of them."""
    moments = [spatial.cross(anchor, axis) for anchor, axis in zip(anchors, axes, strict=True)]
    gradient, rows = [], []
    for joint, (load, axis, moment) in enumerate(zip(loads, axes, moments, strict=True)):
        local = spatial.add_outer(load.moment, spatial.scale(-1.0, anchors[joint]), load.force)
        gradient.append(spatial.dot(axis, _twice_antisymmetric(local)))
        trace = spatial.plus(spatial.plus(local[0][0], local[1][1]), local[2][2])
        force = spatial.add(spatial.rotate(_rows(load.linear), moment), spatial.rotate(load.coupling, axis))
        torque = spatial.rotate(spatial.transpose(load.coupling), moment)
        torque = spatial.add(torque, spatial.rotate(_rows(load.angular), axis))
        torque = spatial.add(torque, spatial.subtract(spatial.rotate(local, axis), spatial.scale(trace, axis)))
        row: list[Scalar] = [0.0] * (joint + 1)
        for k in _with_ancestors(joint, parents):
            row[k] = spatial.plus(spatial.dot(axes[k], torque), spatial.dot(moments[k], force))
        rows.append(row)
    return Derivatives(value, tuple(gradient), rows)


def distal_loads(load: "Load", row_joint: Any, joints: int) -> list["Load"]:
    """Sums over the rows distal to each joint of a serial arm.

    Args:
      load: of each row, arrays [rows, *lanes].
      row_joint: [rows] index of the joint that moves the row, -1 for the base; may be traced.
      joints: number of the arm's joints.
    """
    leaves, structure = jax.tree.flatten(load)
    arrays = [index for index, leaf in enumerate(leaves) if not isinstance(leaf, float)]
    table = jnp.stack(jnp.broadcast_arrays(*(leaves[index] for index in arrays)), axis=1)
    is_distal = (jnp.arange(joints)[:, None] <= row_joint).astype(table.dtype)
    sums = jnp.tensordot(is_distal, table, 1, precision=jax.lax.Precision.HIGHEST)

    def of_joint(joint: int) -> "Load":
        values = list(leaves)
        for place, index in enumerate(arrays):
            values[index] = sums[joint, place]
        return jax.tree.unflatten(structure, values)

    return [of_joint(joint) for joint in range(joints)]


def _with_ancestors(joint: int, parents: Sequence[int]) -> list[int]:
    line = [joint]
    while parents[line[-1]] >= 0:
        line.append(parents[line[-1]])
    return line[::-1]


def total(a: Load, b: Load) -> Load:
    """The sum of two loads."""
    return Load(
        value=spatial.plus(a.value, b.value),
        force=spatial.add(a.force, b.force),
        moment=_sum(a.moment, b.moment),
        linear=tuple(map(spatial.plus, a.linear, b.linear)),
        coupling=_sum(a.coupling, b.coupling),
        angular=tuple(map(spatial.plus, a.angular, b.angular)),
    )


def add_directions(load: Load, direction: Vector, pull: Pull, rotation: RotationMeasure, smoothing: Scalar) -> Load:
    """The load with a pull on the direction of a link."""
    for unit, strength in zip(pull.units, pull.strengths, strict=True):
        if rotation == "cosine":
            difference = spatial.subtract(direction, unit)  # |e - t|^2 / 2 = 1 - e . t, exactly 0 at a match
            value, slope = 0.5 * strength * spatial.dot(difference, difference), -strength
        else:
            cross = spatial.cross(direction, unit)
            value, slope, curvature = (strength * x for x in _angle_derivatives(direction, unit, cross, smoothing))
            load = load._replace(angular=tuple(map(spatial.plus, load.angular, _outer(curvature, cross))))
        moment = spatial.add_outer(load.moment, spatial.scale(slope, direction), unit)
        load = load._replace(value=spatial.plus(load.value, value), moment=moment)
    return load


def smoothed_angle(cosine: Scalar, sine_square: Scalar, smoothing: Scalar) -> Scalar:
    """Smoothed angle f [rad] of two unit vectors, from e . t and |e x t|^2."""
    return jnp.arctan2(_smoothed_sine(sine_square, smoothing), jnp.cos(smoothing) * cosine) - smoothing


def _angle_derivatives(a: Vector, b: Vector, cross: Vector, smoothing: Scalar) -> tuple[Scalar, Scalar, Scalar]:
    """Smoothed angle of two unit vectors, and its first and second derivative with respect to their cosine."""
    cosine, square = spatial.dot(a, b), spatial.dot(cross, cross)
    slope = -jnp.cos(smoothing) / _smoothed_sine(square, smoothing)
    return smoothed_angle(cosine, square, smoothing), slope, cosine * slope**3


def _smoothed_sine(sine_square: Scalar, smoothing: Scalar) -> Scalar:
    """sqrt(1 - (e . t)^2 cos^2 a), without cancellation at 0."""
    return jnp.sqrt(jnp.sin(smoothing) ** 2 + jnp.cos(smoothing) ** 2 * sine_square)


def add_position(load: Load, position: Vector, pull: Pull, smoothing: Scalar) -> Load:
    """The load with a pull on the position of a link."""
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
    return Load(
        value=value,
        force=spatial.add(load.force, force),
        moment=spatial.add_outer(load.moment, position, force),
        linear=tuple(map(spatial.plus, load.linear, stiffness)),
        coupling=_sum(load.coupling, coupling),
        angular=tuple(map(spatial.plus, load.angular, angular)),
    )


def _projection(factor: Scalar, unit: Vector) -> Symmetric:
    """The matrix factor (I - u u^T)."""
    xx, xy, xz, yy, yz, zz = _outer(spatial.times(-1.0, factor), unit)
    return spatial.plus(factor, xx), xy, xz, spatial.plus(factor, yy), yz, spatial.plus(factor, zz)


def _outer(factor: Scalar, vector: Vector) -> Symmetric:
    """The matrix factor v v^T."""
    x, y, z = vector
    u, v, w = spatial.scale(factor, vector)
    times = spatial.times
    return times(u, x), times(u, y), times(u, z), times(v, y), times(v, z), times(w, z)


def _sum(a: Rotation, b: Rotation) -> Rotation:
    return spatial.add(a[0], b[0]), spatial.add(a[1], b[1]), spatial.add(a[2], b[2])


def _rows(matrix: Symmetric) -> Rotation:
    xx, xy, xz, yy, yz, zz = matrix
    return (xx, xy, xz), (xy, yy, yz), (xz, yz, zz)


def _twice_antisymmetric(matrix: Rotation) -> Vector:
    """The sum of r x g, computed from the sum of r g^T."""
    (_, xy, xz), (yx, _, yz), (zx, zy, _) = matrix
    return spatial.minus(yz, zy), spatial.minus(zx, xz), spatial.minus(xy, yx)
