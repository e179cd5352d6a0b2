"""Forward dynamics of a serial arm, on scalar components: what MJX computes, as one program without small arrays.

The composite rigid body algorithm gives the mass matrix, the recursive Newton-Euler algorithm the forces of the motion
(Featherstone, "Rigid Body Dynamics Algorithms", 2008, chapters 6 and 5), in frames that sit on the joints with their z
along the axis. No gravity, contacts or constraints.

The time that a GPU's compiler takes grows with the square of the number of operations. So a body's mass is here as its
sums of m r and m r r^T, which take fewer operations than a centre and an inertia tensor.
"""

import dataclasses
from collections.abc import Callable, Sequence

import mujoco
import numpy as np

from mimic.arms.embodiment import snap_to_units
from mimic.metric.spatial import (
    IDENTITY,
    ZERO,
    Rotation,
    Scalar,
    Vector,
    add,
    axis_rotation,
    compose,
    cross,
    dot,
    minus,
    plus,
    rotate,
    rotation,
    scale,
    times,
    transpose,
    vector,
)

_Z: Vector = (0.0, 0.0, 1.0)
_NONE: Rotation = (ZERO, ZERO, ZERO)


@dataclasses.dataclass(frozen=True)
class Inertia:
    """How the mass of a rigid body lies about the origin of a joint's frame.

    Mass on the axis of a joint moves alike whether it belongs to the body that the joint moves or to the one before. It
    is counted to the one before, and that goes on to the base: no body has a total mass, nor z and zz of its own.

    Attributes:
      first: sum of m r over the points of the body [kg m].
      second: rows of the sum of m r r^T, symmetric [kg m^2].
    """

    first: Vector
    second: Rotation


@dataclasses.dataclass(frozen=True)
class Segment:
    """A joint and the body that it moves, as numbers.

    Attributes:
      placement: maps this joint's frame into the one before, at `reference`.
      offset: the point of this joint's axis nearest to the origin before, its own origin, in the frame before [m].
      reference: joint angle at which that holds [rad].
      inertia: of the body.
      armature: [kg m^2].
      damping: [N m s/rad].
    """

    placement: Rotation
    offset: Vector
    reference: float
    inertia: Inertia
    armature: float
    damping: float


def segments(model: mujoco.MjModel) -> tuple[Segment, ...]:
    """The joints of an arm, base to tip.

    Args:
      model: from `simulation_model`: one serial chain of hinges.
    """
    data = mujoco.MjData(model)
    data.qpos[:] = model.qpos0
    mujoco.mj_kinematics(model, data)
    assert model.nq == model.njnt and list(model.jnt_bodyid) == sorted(model.jnt_bodyid)
    last_joint = {int(body): joint for joint, body in enumerate(model.jnt_bodyid)}
    frame, origin = _frame(data.xaxis[0], np.eye(3)), data.xanchor[0]
    poses, masses = [], []
    for joint, (axis, anchor) in enumerate(zip(data.xaxis, data.xanchor, strict=True)):
        previous_frame, previous_origin = frame, origin
        frame, origin = _frame(axis, previous_frame), anchor + axis @ (previous_origin - anchor) * axis
        pose = np.eye(4)
        pose[:3, :3] = snap_to_units(previous_frame.T @ frame)
        pose[:3, 3] = snap_to_units(previous_frame.T @ (origin - previous_origin))
        body = int(model.jnt_bodyid[joint])
        carries = last_joint[body] == joint  # of several joints in one body, the last one moves it
        poses.append(pose)
        masses.append(_mass(model, data, body, frame, origin) if carries else np.zeros((4, 4)))
    for joint in reversed(range(model.njnt)):  # see `Inertia`
        on_axis = np.zeros((4, 4))
        on_axis[2:, 2:] = masses[joint][2:, 2:]
        masses[joint] -= on_axis
        if joint:
            masses[joint - 1] += poses[joint] @ on_axis @ poses[joint].T
    return tuple(
        Segment(
            placement=rotation(pose[:3, :3]),
            offset=vector(pose[:3, 3]),
            reference=float(model.qpos0[joint]),
            inertia=Inertia(vector(mass[:3, 3]), rotation(mass[:3, :3])),
            armature=float(model.dof_armature[joint]),
            damping=float(model.dof_damping[joint]),
        )
        for joint, (pose, mass) in enumerate(zip(poses, masses, strict=True))
    )


def acceleration(
    arm: Sequence[Segment],
    qpos: Sequence[Scalar],
    qvel: Sequence[Scalar],
    torque: Sequence[Scalar],
    mass: Scalar = 1.0,
    damping: Scalar = 1.0,
) -> list[Scalar]:
    """Joint accelerations [rad/s^2] under a torque.

    Args:
      arm: from `segments`.
      qpos: joint angles [rad].
      qvel: joint velocities [rad/s].
      torque: [N m].
      mass: factor of all bodies' masses and inertias.
      damping: factor of all joints' damping.
    """
    turns = _turns(arm, qpos)
    matrix = mass_matrix(arm, turns)
    forces = bias_forces(arm, turns, qvel)
    lightness = 1.0 / mass  # all else divided by the mass is cheaper than the matrix times it
    for i, segment in enumerate(arm):
        matrix[i][i] = plus(matrix[i][i], times(segment.armature, lightness))
        forces[i] = times(torque[i] - times(damping, segment.damping) * qvel[i], lightness) - forces[i]
    return _solve(matrix, forces)


def inverse(
    arm: Sequence[Segment], qpos: Sequence[Scalar], qvel: Sequence[Scalar], qacc: Sequence[Scalar]
) -> list[Scalar]:
    """Joint torques [N m] that give the accelerations [rad/s^2]; for the rest see `acceleration`."""
    turns = _turns(arm, qpos)
    matrix = mass_matrix(arm, turns)
    torque = bias_forces(arm, turns, qvel)
    for i, segment in enumerate(arm):
        torque[i] = torque[i] + segment.armature * qacc[i] + segment.damping * qvel[i]
        for j in range(len(arm)):
            torque[i] = torque[i] + times(matrix[max(i, j)][min(i, j)], qacc[j])
    return torque


def _turns(arm: Sequence[Segment], qpos: Sequence[Scalar]) -> list[Rotation]:
    """Maps of each joint's frame into the one before; none of the first angle, on which nothing depends."""
    return [IDENTITY] + [
        compose(segment.placement, axis_rotation(_Z, plus(angle, -segment.reference)))
        for segment, angle in zip(arm[1:], qpos[1:], strict=True)
    ]


def mass_matrix(arm: Sequence[Segment], turns: Sequence[Rotation]) -> list[list[Scalar]]:
    """Lower triangle of the joint-space inertia, without armature.

    Args:
      arm: from `segments`.
      turns: maps each joint's frame into the one before.
    """
    matrix: list[list[Scalar]] = [[0.0] * (i + 1) for i in range(len(arm))]
    composite = Inertia(ZERO, _NONE)
    for i in reversed(range(len(arm))):
        composite = _joined(composite, arm[i].inertia)
        matrix[i][i] = plus(composite.second[0][0], composite.second[1][1])
        if i == 0:
            break
        trace = plus(matrix[i][i], composite.second[2][2])
        composite = _turned(composite, turns[i])
        # Force and moment for a unit acceleration about this joint, as the joints below feel them.
        axis, offset = transpose(arm[i].placement)[2], arm[i].offset
        force = cross(axis, composite.first)
        moment = add(scale(trace, axis), rotate(composite.second, scale(-1.0, axis)))
        moment = add(moment, cross(offset, force))
        matrix[i][i - 1] = moment[2]
        for j in reversed(range(1, i)):
            force, moment = _passed_on(arm[: j + 1], turns[j], force, moment)
            matrix[i][j - 1] = moment[2]
        composite = _shifted(composite, offset)
    return matrix


def bias_forces(arm: Sequence[Segment], turns: Sequence[Rotation], qvel: Sequence[Scalar]) -> list[Scalar]:
    """Joint torques [N m] that keep the velocities as they are: Coriolis and centrifugal forces.

    Args:
      arm: from `segments`.
      turns: maps each joint's frame into the one before.
      qvel: joint velocities [rad/s].
    """
    omega, alpha, linear = ZERO, ZERO, ZERO  # angular velocity and acceleration, linear acceleration of the origin
    field = _NONE  # a point r of the body accelerates by linear + field r
    wrenches: list[tuple[Vector, Vector]] = []
    for segment, turn, speed in zip(arm, turns, qvel, strict=True):
        back = transpose(turn)
        linear = rotate(back, add(linear, rotate(field, segment.offset)))
        spin, carried = scale(speed, _Z), rotate(back, omega)
        omega, alpha = add(carried, spin), add(rotate(back, alpha), cross(carried, spin))
        field = _acceleration_field(omega, alpha)
        first, second = segment.inertia.first, segment.inertia.second
        moment = add(_moment(field, second), cross(first, linear))
        wrenches.append((rotate(field, first), moment))
    torques: list[Scalar] = [0.0] * len(arm)
    force, moment = ZERO, ZERO
    for i in reversed(range(len(arm))):
        force, moment = add(force, wrenches[i][0]), add(moment, wrenches[i][1])
        torques[i] = moment[2]
        force, moment = _passed_on(arm[: i + 1], turns[i], force, moment)
    return torques


def _passed_on(arm: Sequence[Segment], turn: Rotation, force: Vector, moment: Vector) -> tuple[Vector, Vector]:
    """What acts in the frame of the last joint, in the frame before; without the force where no joint feels it."""
    force, moment = rotate(turn, force), rotate(turn, moment)
    moment = add(moment, cross(arm[-1].offset, force))
    return force if any(any(segment.offset) for segment in arm[:-1]) else ZERO, moment


def _acceleration_field(omega: Vector, alpha: Vector) -> Rotation:
    """The matrix of alpha x r + omega x (omega x r)."""
    x, y, z = omega
    xx, yy, zz = times(x, x), times(y, y), times(z, z)
    xy, yz, zx = times(x, y), times(y, z), times(z, x)
    less_xx, less_yy = times(-1.0, xx), times(-1.0, yy)
    return (
        (minus(less_yy, zz), minus(xy, alpha[2]), plus(zx, alpha[1])),
        (plus(xy, alpha[2]), minus(less_xx, zz), minus(yz, alpha[0])),
        (minus(zx, alpha[1]), plus(yz, alpha[0]), minus(less_xx, yy)),
    )


def _moment(field: Rotation, second: Rotation) -> Vector:
    """The sum of m r x (field r)."""

    def minor(i: int, j: int) -> Scalar:
        return minus(dot(field[j], second[i]), dot(field[i], second[j]))

    return minor(1, 2), minor(2, 0), minor(0, 1)


def _solve(matrix: list[list[Scalar]], values: list[Scalar]) -> list[Scalar]:
    """X of M x = b by L D L^T; only the lower triangle of M is read."""
    size = len(values)
    lower: list[list[Scalar]] = [[0.0] * size for _ in range(size)]
    inverse: list[Scalar] = []
    for i in range(size):
        scaled = []  # row i of L D
        for j in range(i):
            entry = matrix[i][j]
            for k in range(j):
                entry = entry - times(scaled[k], lower[j][k])
            scaled.append(entry)
            lower[i][j] = times(entry, inverse[j])
        pivot = matrix[i][i]
        for j in range(i):
            pivot = pivot - times(scaled[j], lower[i][j])
        inverse.append(1.0 / pivot)
    found = list(values)
    for i in range(size):
        for j in range(i):
            found[i] = found[i] - times(lower[i][j], found[j])
    found = [times(x, y) for x, y in zip(found, inverse, strict=True)]
    for i in reversed(range(size)):
        for j in range(i + 1, size):
            found[i] = found[i] - times(lower[j][i], found[j])
    return found


def _joined(a: Inertia, b: Inertia) -> Inertia:
    return Inertia(add(a.first, b.first), _symmetric(lambda i, j: plus(a.second[i][j], b.second[i][j])))


def _turned(inertia: Inertia, turn: Rotation) -> Inertia:
    """The same mass along the axes that `turn` maps into."""
    half = compose(turn, inertia.second)
    return Inertia(rotate(turn, inertia.first), _symmetric(lambda i, j: dot(half[i], turn[j])))


def _shifted(inertia: Inertia, offset: Vector) -> Inertia:
    """The same mass about the origin of the frame before."""
    first, second = inertia.first, inertia.second

    def entry(i: int, j: int) -> Scalar:
        if i == j:
            return plus(second[i][i], times(2.0 * offset[i], first[i]))
        return plus(second[i][j], plus(times(offset[i], first[j]), times(offset[j], first[i])))

    return Inertia(first, _symmetric(entry))


def _symmetric(entry: Callable[[int, int], Scalar]) -> Rotation:
    """Rows of a symmetric matrix, from its entries on and above the diagonal."""
    xx, xy, xz, yy, yz, zz = entry(0, 0), entry(0, 1), entry(0, 2), entry(1, 1), entry(1, 2), entry(2, 2)
    return (xx, xy, xz), (xy, yy, yz), (xz, yz, zz)


def _frame(axis: np.ndarray, previous: np.ndarray) -> np.ndarray:
    """Axes of a frame with z along a joint; x along an axis of the frame before if one is normal to z."""
    normal = previous[:, np.argmin(np.abs(previous.T @ axis))]
    x = normal - (normal @ axis) * axis
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(axis, x), axis], axis=1)


def _mass(model: mujoco.MjModel, data: mujoco.MjData, body: int, frame: np.ndarray, origin: np.ndarray) -> np.ndarray:
    """The sum of m p p^T over a body's points p = (x, y, z, 1) in a frame: second and first moments, and the mass."""
    inertia = model.body_inertia[body]
    result = np.zeros((4, 4))
    axes = frame.T @ data.ximat[body].reshape(3, 3)
    result[:3, :3] = axes @ np.diag(inertia.sum() / 2 - inertia) @ axes.T
    centre = np.append(frame.T @ (data.xipos[body] - origin), 1.0)
    return result + model.body_mass[body] * np.outer(centre, centre)
