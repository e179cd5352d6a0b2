"""Dynamics of a chain or tree of joints on scalar components: the equations of MJX without arrays, for a fused kernel.

The composite rigid body algorithm computes the mass matrix, the recursive Newton-Euler algorithm the Coriolis and
centrifugal forces (Featherstone, "Rigid Body Dynamics Algorithms", 2008, chapters 6 and 5). Frames are at the joints,
with z along the joint's axis. There are no gravity, contacts or constraints.

The compile time on a GPU grows with the square of the number of operations. So the mass distribution of a body is given
by the sums of m r and m r r^T, which need fewer operations than a centre of mass and an inertia tensor.
"""

import dataclasses
from collections.abc import Callable, Sequence

import mujoco
import numpy as np

from mimic.arms.embodiment import snap_to_units
from mimic.arms.simulation_model import pseudo_inertia
from mimic.base.spatial import (
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
    """First and second moments of mass of a rigid body about the origin of its joint's frame.

    Mass on the axis of a joint moves in the same way as part of the body that the joint moves or of its parent. It is
    counted as part of the parent, for all joints up to the base. So a body has no total mass, and its moments z and zz
    are zero.

    Attributes:
      first: sum of m r over the points of the body [kg m].
      second: rows of the sum of m r r^T, symmetric [kg m^2].
    """

    first: Vector
    second: Rotation


@dataclasses.dataclass(frozen=True)
class Segment:
    """Parameters of a joint and of the body that it moves. The parent frame is that of the parent joint.

    Attributes:
      parent: index of the parent joint, -1 for a joint at the base.
      placement: maps this joint's frame into the parent frame, at the angle `reference`.
      offset: origin of this joint's frame in the parent frame [m]: the point on its axis nearest to the parent's
        origin.
      reference: joint angle of `placement` [rad].
      inertia: moments of mass of the body.
      armature: rotor inertia [kg m^2].
      damping: viscous damping [N m s/rad].
    """

    parent: int
    placement: Rotation
    offset: Vector
    reference: float
    inertia: Inertia
    armature: float
    damping: float


def segments(model: mujoco.MjModel) -> tuple[Segment, ...]:
    """The segments of an arm, each after its parent.

    Args:
      model: from `simulation_model`: revolute joints in a chain or a tree.
    """
    data = mujoco.MjData(model)
    data.qpos[:] = model.qpos0
    mujoco.mj_kinematics(model, data)
    assert model.nq == model.njnt and list(model.jnt_bodyid) == sorted(model.jnt_bodyid)
    last_joint = {int(body): joint for joint, body in enumerate(model.jnt_bodyid)}
    poses, masses, frames = [], [], []
    parents = _joint_parents(model)
    for joint, (axis, anchor) in enumerate(zip(data.xaxis, data.xanchor, strict=True)):
        # A joint at the base has itself as its parent frame.
        at_base = _frame(axis, np.eye(3)), anchor
        previous_frame, previous_origin = frames[parents[joint]] if parents[joint] >= 0 else at_base
        frame, origin = _frame(axis, previous_frame), anchor + axis @ (previous_origin - anchor) * axis
        frames.append((frame, origin))
        pose = np.eye(4)
        pose[:3, :3] = snap_to_units(previous_frame.T @ frame)
        pose[:3, 3] = snap_to_units(previous_frame.T @ (origin - previous_origin))
        body = int(model.jnt_bodyid[joint])
        has_body = last_joint[body] == joint  # if a body has several joints, the others move no mass of their own
        poses.append(pose)
        masses.append(pseudo_inertia(model, data, body, frame, origin) if has_body else np.zeros((4, 4)))
    for joint in reversed(range(model.njnt)):  # see `Inertia`
        on_axis = np.zeros((4, 4))
        on_axis[2:, 2:] = masses[joint][2:, 2:]
        masses[joint] -= on_axis
        if parents[joint] >= 0:
            masses[parents[joint]] += poses[joint] @ on_axis @ poses[joint].T
    return tuple(
        Segment(
            parent=parents[joint],
            placement=rotation(pose[:3, :3]),
            offset=vector(pose[:3, 3]),
            reference=float(model.qpos0[joint]),
            inertia=Inertia(vector(mass[:3, 3]), rotation(mass[:3, :3])),
            armature=float(model.dof_armature[joint]),
            damping=float(model.dof_damping[joint]),
        )
        for joint, (pose, mass) in enumerate(zip(poses, masses, strict=True))
    )


def _joint_parents(model: mujoco.MjModel) -> list[int]:
    """Index of each joint's parent, -1 for a joint at the base."""
    last = dict.fromkeys(range(model.nbody), -1)  # joint of each body so far, or of its parent
    parents = []
    for body in range(1, model.nbody):
        last[body] = last[int(model.body_parentid[body])]
        for joint in range(model.body_jntadr[body], model.body_jntadr[body] + model.body_jntnum[body]):
            parents.append(last[body])
            last[body] = joint
    return parents


def uncovered_elements(model: mujoco.MjModel) -> list[str]:
    """What a model has that changes its motion and that these dynamics lack; empty where they are exact."""
    no_gravity = model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_GRAVITY
    elements = {
        "joints that are not revolute": np.any(model.jnt_type != mujoco.mjtJoint.mjJNT_HINGE),
        "bodies that no joint moves": bool(np.any(model.body_jntnum[1:] == 0)),
        "gravity": not no_gravity and np.any(model.opt.gravity),
        "contacts": model.ngeom > 0,
        "constraints": model.neq > 0,
        "tendons": model.ntendon > 0,
        "actuators": model.nu > 0,
        "springs": np.any(model.jnt_stiffness),
        "nonlinear damping": np.any(getattr(model, "dof_dampingpoly", 0)),  # only of newer MuJoCo
        "dry friction": np.any(model.dof_frictionloss),
        "joint limits": np.any(model.jnt_limited),
        "a fluid": model.opt.density or model.opt.viscosity,
        "another integrator": model.opt.integrator != mujoco.mjtIntegrator.mjINT_RK4,
    }
    return [name for name, is_there in elements.items() if is_there]


def acceleration(
    arm: Sequence[Segment],
    qpos: Sequence[Scalar],
    qvel: Sequence[Scalar],
    torque: Sequence[Scalar],
    mass: Scalar = 1.0,
    damping: Scalar = 1.0,
) -> list[Scalar]:
    """Forward dynamics: joint accelerations [rad/s^2] under joint torques.

    Args:
      arm: from `segments`.
      qpos: joint angles [rad].
      qvel: joint velocities [rad/s].
      torque: joint torques [N m].
      mass: factor on the masses and inertias of all bodies.
      damping: factor on the damping of all joints.
    """
    rotations = _rotations(arm, qpos)
    matrix = mass_matrix(arm, rotations)
    forces = bias_forces(arm, rotations, qvel)
    inverse_mass = 1.0 / mass  # dividing the other terms by the factor is cheaper than multiplying the matrix by it
    for i, segment in enumerate(arm):
        matrix[i][i] = plus(matrix[i][i], times(segment.armature, inverse_mass))
        forces[i] = times(torque[i] - times(damping, segment.damping) * qvel[i], inverse_mass) - forces[i]
    return solve(matrix, forces)


def inverse(
    arm: Sequence[Segment], qpos: Sequence[Scalar], qvel: Sequence[Scalar], qacc: Sequence[Scalar]
) -> list[Scalar]:
    """Inverse dynamics: joint torques [N m] for joint accelerations [rad/s^2]; see `acceleration` for the arguments."""
    rotations = _rotations(arm, qpos)
    matrix = mass_matrix(arm, rotations)
    torque = bias_forces(arm, rotations, qvel)
    for i, segment in enumerate(arm):
        torque[i] = torque[i] + segment.armature * qacc[i] + segment.damping * qvel[i]
        for j in range(len(arm)):
            torque[i] = torque[i] + times(matrix[max(i, j)][min(i, j)], qacc[j])
    return torque


def _rotations(arm: Sequence[Segment], qpos: Sequence[Scalar]) -> list[Rotation]:
    """Rotation of each joint's frame into its parent frame; the identity at the base, where angles have no effect."""
    return [
        IDENTITY
        if segment.parent < 0
        else compose(segment.placement, axis_rotation(_Z, plus(angle, -segment.reference)))
        for segment, angle in zip(arm, qpos, strict=True)
    ]


def mass_matrix(arm: Sequence[Segment], rotations: Sequence[Rotation]) -> list[list[Scalar]]:
    """Lower triangle of the joint-space inertia, without armature.

    Args:
      arm: from `segments`.
      rotations: rotation of each joint's frame into its parent frame.
    """
    matrix: list[list[Scalar]] = [[0.0] * (i + 1) for i in range(len(arm))]
    composites = [Inertia(ZERO, _NONE) for _ in arm]  # of the bodies distal to each joint
    for i in reversed(range(len(arm))):
        composite, parent = _summed(composites[i], arm[i].inertia), arm[i].parent
        matrix[i][i] = plus(composite.second[0][0], composite.second[1][1])
        if parent < 0:
            continue
        trace = plus(matrix[i][i], composite.second[2][2])
        composite = _rotated(composite, rotations[i])
        # Force and moment of a unit acceleration about this joint, in the frames of the proximal joints.
        axis, offset = transpose(arm[i].placement)[2], arm[i].offset
        force = cross(axis, composite.first)
        moment = add(scale(trace, axis), rotate(composite.second, scale(-1.0, axis)))
        moment = add(moment, cross(offset, force))
        matrix[i][parent] = moment[2]
        while arm[parent].parent >= 0:
            force, moment = _passed_on(arm, parent, rotations[parent], force, moment)
            parent = arm[parent].parent
            matrix[i][parent] = moment[2]
        parent, shifted = arm[i].parent, _shifted(composite, offset)
        composites[parent] = _summed(composites[parent], shifted)
    return matrix


def bias_forces(arm: Sequence[Segment], rotations: Sequence[Rotation], qvel: Sequence[Scalar]) -> list[Scalar]:
    """Joint torques [N m] for zero joint acceleration: Coriolis and centrifugal forces.

    Args:
      arm: from `segments`.
      rotations: rotation of each joint's frame into its parent frame.
      qvel: joint velocities [rad/s].
    """
    # Angular velocity and acceleration of each body, linear acceleration of its origin, and a field: the acceleration
    # of its point r is linear + field r.
    motions: list[tuple[Vector, Vector, Vector, Rotation]] = []
    wrenches: list[tuple[Vector, Vector]] = []
    for segment, parent_rotation, speed in zip(arm, rotations, qvel, strict=True):
        omega, alpha, linear, field = motions[segment.parent] if segment.parent >= 0 else (ZERO, ZERO, ZERO, _NONE)
        to_child = transpose(parent_rotation)
        linear = rotate(to_child, add(linear, rotate(field, segment.offset)))
        spin, carried = scale(speed, _Z), rotate(to_child, omega)
        omega, alpha = add(carried, spin), add(rotate(to_child, alpha), cross(carried, spin))
        field = acceleration_field(omega, alpha)
        motions.append((omega, alpha, linear, field))
        first, second = segment.inertia.first, segment.inertia.second
        moment = add(moment_of_field(field, second), cross(first, linear))
        wrenches.append((rotate(field, first), moment))
    torques: list[Scalar] = [0.0] * len(arm)
    of_children = [(ZERO, ZERO) for _ in arm]
    for i in reversed(range(len(arm))):
        force, moment = add(of_children[i][0], wrenches[i][0]), add(of_children[i][1], wrenches[i][1])
        torques[i], parent = moment[2], arm[i].parent
        if parent >= 0:
            force, moment = _passed_on(arm, i, rotations[i], force, moment)
            of_children[parent] = add(of_children[parent][0], force), add(of_children[parent][1], moment)
    return torques


def _passed_on(
    arm: Sequence[Segment], joint: int, parent_rotation: Rotation, force: Vector, moment: Vector
) -> tuple[Vector, Vector]:
    """Transforms a wrench from a joint's frame to its parent; the force is dropped where it has no effect."""
    force, moment = rotate(parent_rotation, force), rotate(parent_rotation, moment)
    moment = add(moment, cross(arm[joint].offset, force))
    parent = arm[joint].parent
    while parent >= 0 and not any(arm[parent].offset):
        parent = arm[parent].parent
    return force if parent >= 0 else ZERO, moment


def acceleration_field(omega: Vector, alpha: Vector) -> Rotation:
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


def moment_of_field(field: Rotation, second: Rotation) -> Vector:
    """The sum of m r x (field r)."""

    def minor(i: int, j: int) -> Scalar:
        return minus(dot(field[j], second[i]), dot(field[i], second[j]))

    return minor(1, 2), minor(2, 0), minor(0, 1)


def solve(
    matrix: Sequence[Sequence[Scalar]], values: Sequence[Scalar], is_free: Sequence[Scalar] | None = None
) -> list[Scalar]:
    """X of M x = b by L D L^T; only the lower triangle of M is read.

    Args:
      matrix: M, symmetric and positive definite.
      values: b.
      is_free: 1 for the rows and columns of a smaller system, 0 for those to leave out; x is 0 there. All where None.
    """
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
        inverse.append(1.0 / pivot if is_free is None else is_free[i] / pivot)  # 0 removes a row and its column
    solution = list(values)
    for i in range(size):
        for j in range(i):
            solution[i] = solution[i] - times(lower[i][j], solution[j])
    solution = [times(x, y) for x, y in zip(solution, inverse, strict=True)]
    for i in reversed(range(size)):
        for j in range(i + 1, size):
            solution[i] = solution[i] - times(lower[j][i], solution[j])
    return solution


def _summed(a: Inertia, b: Inertia) -> Inertia:
    return Inertia(add(a.first, b.first), _symmetric(lambda i, j: plus(a.second[i][j], b.second[i][j])))


def _rotated(inertia: Inertia, parent_rotation: Rotation) -> Inertia:
    """The moments along the axes that the rotation maps into."""
    half = compose(parent_rotation, inertia.second)
    return Inertia(rotate(parent_rotation, inertia.first), _symmetric(lambda i, j: dot(half[i], parent_rotation[j])))


def _shifted(inertia: Inertia, offset: Vector) -> Inertia:
    """The moments about the origin of the parent frame."""
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
    """Axes of a frame with z along a joint; x is along an axis of the parent frame if one is normal to z."""
    normal = previous[:, np.argmin(np.abs(previous.T @ axis))]
    x = normal - (normal @ axis) * axis
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(axis, x), axis], axis=1)
