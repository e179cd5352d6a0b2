"""Forward dynamics of a serial arm, on scalar components: what MJX computes, as one program without small arrays.

The composite rigid body algorithm gives the mass matrix, the recursive Newton-Euler algorithm the forces of the motion
(Featherstone, "Rigid Body Dynamics Algorithms", 2008, chapters 6 and 5), in frames that sit on the joints with their z
along the axis. No gravity, contacts or constraints.
"""

import dataclasses
from collections.abc import Sequence

import mujoco
import numpy as np

from mimic.spatial import (
    IDENTITY,
    ZERO,
    Rotation,
    Scalar,
    Vector,
    add,
    add_outer,
    axis_rotation,
    compose,
    cross,
    dot,
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
_ROUNDING = 1e-12  # what rotations to and fro leave of a zero


@dataclasses.dataclass(frozen=True)
class Inertia:
    """What a rigid body weighs about the origin of its frame.

    Attributes:
      mass: [kg].
      moment: mass times centre of mass [kg m].
      tensor: rows of the inertia tensor about the origin [kg m^2].
    """

    mass: Scalar
    moment: Vector
    tensor: Rotation


@dataclasses.dataclass(frozen=True)
class Segment:
    """A joint and the body that it moves, as numbers.

    Attributes:
      placement: maps this joint's frame into the one before, at `reference`.
      offset: where this joint is in the frame before [m].
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
    frame, origin = np.eye(3), np.zeros(3)
    result = []
    for joint in range(model.njnt):
        previous_frame, previous_origin = frame, origin
        frame, origin = _frame(data.xaxis[joint], previous_frame), data.xanchor[joint]
        body = int(model.jnt_bodyid[joint])
        carries = last_joint[body] == joint  # of several joints in one body, the last one moves it
        result.append(
            Segment(
                placement=rotation(_rounded(previous_frame.T @ frame)),
                offset=vector(_rounded(previous_frame.T @ (origin - previous_origin))),
                reference=float(model.qpos0[joint]),
                inertia=_inertia(model, data, body, frame, origin) if carries else Inertia(0.0, ZERO, _NONE),
                armature=float(model.dof_armature[joint]),
                damping=float(model.dof_damping[joint]),
            )
        )
    return tuple(result)


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
    for i, segment in enumerate(arm):
        matrix[i] = [times(mass, entry) for entry in matrix[i]]
        matrix[i][i] = plus(matrix[i][i], segment.armature)
        forces[i] = torque[i] - times(mass, forces[i]) - times(damping, segment.damping) * qvel[i]
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
    """Maps of each joint's frame into the one before."""
    return [
        compose(segment.placement, axis_rotation(_Z, plus(angle, -segment.reference)))
        for segment, angle in zip(arm, qpos, strict=True)
    ]


def mass_matrix(arm: Sequence[Segment], turns: Sequence[Rotation]) -> list[list[Scalar]]:
    """Lower triangle of the joint-space inertia, without armature.

    Args:
      arm: from `segments`.
      turns: maps each joint's frame into the one before.
    """
    matrix: list[list[Scalar]] = [[0.0] * (i + 1) for i in range(len(arm))]
    composite = Inertia(0.0, ZERO, _NONE)
    for i in reversed(range(len(arm))):
        if i + 1 < len(arm):
            composite = _moved(composite, turns[i + 1], arm[i + 1].offset)
        composite = _joined(composite, arm[i].inertia)
        # Force and moment for a unit acceleration about this joint, as the joints below feel them.
        force, moment = cross(_Z, composite.moment), tuple(row[2] for row in composite.tensor)
        matrix[i][i] = moment[2]
        for j in reversed(range(i)):
            force, moment = rotate(turns[j + 1], force), rotate(turns[j + 1], moment)
            moment = add(moment, cross(arm[j + 1].offset, force))
            matrix[i][j] = moment[2]
    return matrix


def bias_forces(arm: Sequence[Segment], turns: Sequence[Rotation], qvel: Sequence[Scalar]) -> list[Scalar]:
    """Joint torques [N m] that keep the velocities as they are: Coriolis and centrifugal forces.

    Args:
      arm: from `segments`.
      turns: maps each joint's frame into the one before.
      qvel: joint velocities [rad/s].
    """
    omega, alpha, linear = ZERO, ZERO, ZERO  # angular velocity and acceleration, linear acceleration of the origin
    wrenches: list[tuple[Vector, Vector]] = []
    for segment, turn, speed in zip(arm, turns, qvel, strict=True):
        back = transpose(turn)
        linear = add(linear, add(cross(alpha, segment.offset), cross(omega, cross(omega, segment.offset))))
        spin = scale(speed, _Z)
        carried = rotate(back, omega)
        omega, alpha, linear = (
            add(carried, spin),
            add(rotate(back, alpha), cross(carried, spin)),
            rotate(back, linear),
        )
        inertia = segment.inertia
        momentum = rotate(inertia.tensor, omega)
        force = add(
            scale(inertia.mass, linear), add(cross(alpha, inertia.moment), cross(omega, cross(omega, inertia.moment)))
        )
        moment = add(rotate(inertia.tensor, alpha), add(cross(omega, momentum), cross(inertia.moment, linear)))
        wrenches.append((force, moment))
    torques: list[Scalar] = [0.0] * len(arm)
    force, moment = ZERO, ZERO
    for i in reversed(range(len(arm))):
        force, moment = add(force, wrenches[i][0]), add(moment, wrenches[i][1])
        torques[i] = moment[2]
        force, moment = rotate(turns[i], force), rotate(turns[i], moment)
        moment = add(moment, cross(arm[i].offset, force))
    return torques


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


def _moved(inertia: Inertia, turn: Rotation, offset: Vector) -> Inertia:
    """The same body about the origin of the frame that `turn` and `offset` map into."""
    moment = rotate(turn, inertia.moment)
    tensor = compose(compose(turn, inertia.tensor), transpose(turn))
    tensor = add_outer(add_outer(tensor, scale(-1.0, offset), moment), scale(-1.0, moment), offset)
    tensor = add_outer(tensor, scale(times(-1.0, inertia.mass), offset), offset)
    trace = plus(times(2.0, dot(offset, moment)), times(inertia.mass, dot(offset, offset)))
    return Inertia(
        mass=inertia.mass,
        moment=add(moment, scale(inertia.mass, offset)),
        tensor=_sum(tensor, tuple(scale(trace, unit) for unit in IDENTITY)),  # pyright: ignore[reportArgumentType]
    )


def _joined(a: Inertia, b: Inertia) -> Inertia:
    return Inertia(plus(a.mass, b.mass), add(a.moment, b.moment), _sum(a.tensor, b.tensor))


def _sum(a: Rotation, b: Rotation) -> Rotation:
    return add(a[0], b[0]), add(a[1], b[1]), add(a[2], b[2])


def _frame(axis: np.ndarray, previous: np.ndarray) -> np.ndarray:
    """Axes of a frame with z along a joint; x along an axis of the frame before if one is normal to z."""
    normal = previous[:, np.argmin(np.abs(previous.T @ axis))]
    x = normal - (normal @ axis) * axis
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(axis, x), axis], axis=1)


def _inertia(model: mujoco.MjModel, data: mujoco.MjData, body: int, frame: np.ndarray, origin: np.ndarray) -> Inertia:
    mass = float(model.body_mass[body])
    centre = frame.T @ (data.xipos[body] - origin)
    principal = frame.T @ data.ximat[body].reshape(3, 3)
    tensor = principal @ np.diag(model.body_inertia[body]) @ principal.T
    tensor += mass * (centre @ centre * np.eye(3) - np.outer(centre, centre))
    return Inertia(mass, vector(mass * centre), rotation(tensor))


def _rounded(values: np.ndarray) -> np.ndarray:
    """Exact zeros and ones where they are meant: what is known to be zero is not computed."""
    near = np.round(values)
    return np.where(np.abs(values - near) < _ROUNDING, near, values)
