"""The numbers of an arm that its dynamics need: constants of a MuJoCo model, or a vector of an arm as data."""

from typing import Any, NamedTuple

import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float

from mimic.arms.arrays import MAX_JOINTS, ArmArrays, joint_frames, moments_in_frames, moments_of_joints, placements
from mimic.arms.embodiment import snap_to_units
from mimic.base.spatial import Scalar

PLANE = tuple[Scalar, Scalar]  # cosine and sine
NUMBERS = 15  # of a joint in a vector


class JointNumbers(NamedTuple):
    """The numbers of a joint that its dynamics need; see `ArmArrays`.

    Attributes:
      branch: cosine and sine of an angle about the parent's axis, before the twist: that of a joint that is not the
        first child of its parent. Only trees have such joints.
      parent: index of the parent joint, -1 for a joint at the base.
    """

    twist: tuple[Scalar, Scalar]
    offset: tuple[Scalar, Scalar]
    reference: Scalar
    first: tuple[Scalar, Scalar]
    second: tuple[Scalar, Scalar, Scalar, Scalar, Scalar]
    armature: Scalar
    damping: Scalar
    is_free: Scalar
    branch: PLANE = (1.0, 0.0)
    parent: int = -1


def joint_numbers(arm: ArmArrays) -> Float[Array, " numbers"]:
    """The numbers of all joints as one vector, for `unpacked`."""
    # The diagonal entry of a locked joint has no effect, but forward dynamics divide by it: 1 keeps it away from 0.
    armature = arm.armature + (1 - arm.is_free)
    columns = [arm.twist, arm.offset, arm.reference[:, None], arm.first_moment, arm.second_moment]
    columns += [armature[:, None], arm.damping[:, None], arm.is_free[:, None]]
    return jnp.concatenate(columns, axis=1).ravel()


def unpacked(numbers: Any) -> list[JointNumbers]:
    """The joints of a serial arm, from the vector of `joint_numbers`."""
    return [joint_of([numbers[NUMBERS * i + k] for k in range(NUMBERS)], i - 1) for i in range(MAX_JOINTS)]


def joint_of(numbers: Any, parent: int = -1) -> JointNumbers:
    """The numbers of one joint, from its part of the vector of `joint_numbers`."""
    x = numbers
    first, second = (x[5], x[6]), (x[7], x[8], x[9], x[10], x[11])
    return JointNumbers((x[0], x[1]), (x[2], x[3]), x[4], first, second, x[12], x[13], x[14], parent=parent)


def joints_of_model(model: mujoco.MjModel) -> tuple[JointNumbers, ...]:
    """The joints of a chain or tree as constants, each after its parent.

    Args:
      model: from `simulation_model`: revolute joints only.
    """
    assert model.nq == model.njnt and list(model.jnt_bodyid) == sorted(model.jnt_bodyid)
    data = mujoco.MjData(model)
    data.qpos[:] = 0.0
    mujoco.mj_kinematics(model, data)
    parents = _joint_parents(model)
    rotations, origins = joint_frames(np.array(data.xaxis), np.array(data.xanchor), parents=parents)
    placement = placements(rotations, origins, parents)
    moments = moments_of_joints(moments_in_frames(model, rotations, origins), rotations, origins, parents)
    columns = [*map(snap_to_units, placement[:2]), placement[2], *moments, model.dof_armature, model.dof_damping]
    constants = zip(*(column.tolist() for column in (*columns, snap_to_units(placement[3]))), parents, strict=True)
    return tuple(
        JointNumbers(
            tuple(twist), tuple(offset), reference, tuple(first), tuple(second), armature, damping, 1.0, tuple(branch),
            parent,
        )
        for twist, offset, reference, first, second, armature, damping, branch, parent in constants
    )  # fmt: skip


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
    """What a model has that changes its motion and that our dynamics lack; empty where they are exact."""
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
