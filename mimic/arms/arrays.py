"""An arm as arrays of fixed shape: one compiled function takes any arm, and each row of a batch may be another one.

The frame of a joint has z along the joint's axis, and its origin is the point on the axis nearest to the origin of the
frame before it. Its x-axis is normal to the next joint's axis. So the transform from a frame to the next one is

    T = Rx(twist) Trans(a, b, 0) Rz(qpos + reference),

which has as many numbers as Denavit and Hartenberg's. In contrast to theirs, they stay small if two axes are almost
parallel.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import mujoco
import numpy as np
from flax import struct
from jaxtyping import Float, Int

from mimic.arms.arm import Arm, ArmConfig, build_arm, finite_velocity_limit
from mimic.arms.embodiment import Embodiment, snap_to_units
from mimic.arms.simulation_model import pseudo_inertia
from mimic.base.spatial import array_library

MAX_JOINTS, MAX_LINKS = 8, 12
_PARALLEL = 1e-12  # rad: axes at a smaller angle are parallel, as `snap_to_units` rounds their sine to 0


@struct.dataclass
class ArmArrays:
    """A serial arm of up to 8 revolute joints and 12 links. Slots beyond its own joints and links are empty.

    An empty slot of a joint is locked and has no mass; an empty slot of a link has length 0. A joint is locked by its
    mask, `is_free`: it stays at its angle in `home`, and the shape of the arrays stays the same.

    Attributes:
      base_rotation: [3, 3] frame of the first joint at angle 0, in the base frame.
      base_position: [3] its origin [m].
      twist: [joints, 2] cosine and sine of the angle between a joint's axis and the axis before it.
      offset: [joints, 2] a and b above [m].
      reference: [joints] angle that is added to the joint's angle [rad].
      first_moment: [joints, 2] x and y of the sum of m r over the points of the joint's body [kg m], as in
        mimic/physics/dynamics.py: the mass on the axis is part of the parent body.
      second_moment: [joints, 5] xx, yy, xy, xz and yz of the sum of m r r^T [kg m^2].
      armature: [joints] rotor inertia [kg m^2].
      damping: [joints] viscous damping [N m s/rad].
      is_free: [joints] 1 for a joint that moves, 0 for one that is locked.
      home: [joints] pose at the start of an episode, and the angles of locked joints [rad].
      joint_range: [joints, 2] minimum and maximum angle [rad].
      velocity_limit: [joints] maximum speed [rad/s].
      torque_limit: [joints] maximum torque [N m].
      link_joint: [links] index of the joint that moves the link, -1 for a link fixed to the base.
      link_position: [links, 3] origin of the link in the frame of that joint, or in the base frame [m].
      link_direction: [links, 3] direction of the link in that frame.
      link_length: [links] length [m].
      hand_joint: index of the last joint that moves the hand, -1 for none. A hand that is not known is at the base.
      hand_position: [3] origin of the hand frame in the frame of that joint [m].
      hand_rotation: [3, 3] hand frame in the frame of that joint.
    """

    base_rotation: Float[Any, "3 3"]
    base_position: Float[Any, "3"]
    twist: Float[Any, "joints 2"]
    offset: Float[Any, "joints 2"]
    reference: Float[Any, " joints"]
    first_moment: Float[Any, "joints 2"]
    second_moment: Float[Any, "joints 5"]
    armature: Float[Any, " joints"]
    damping: Float[Any, " joints"]
    is_free: Float[Any, " joints"]
    home: Float[Any, " joints"]
    joint_range: Float[Any, "joints 2"]
    velocity_limit: Float[Any, " joints"]
    torque_limit: Float[Any, " joints"]
    link_joint: Int[Any, " links"]
    link_position: Float[Any, "links 3"]
    link_direction: Float[Any, "links 3"]
    link_length: Float[Any, " links"]
    hand_joint: Int[Any, ""]
    hand_position: Float[Any, "3"]
    hand_rotation: Float[Any, "3 3"]

    @property
    def rows(self) -> tuple[Any, Any, Any]:
        """Joint, position and direction of each link, and of the x-, y- and z-axis of the hand after them."""
        numpy = array_library(self.link_position)
        joint, position = (numpy.stack(3 * [x]) for x in (self.hand_joint, self.hand_position))
        return (
            numpy.concatenate([self.link_joint, joint]),
            numpy.concatenate([self.link_position, position]),
            numpy.concatenate([self.link_direction, self.hand_rotation.T]),
        )

    @property
    def name(self) -> str:
        """What errors call the arm."""
        return "an arm as data"

    @property
    def num_joints(self) -> int:
        """Number of its slots of joints."""
        return self.home.shape[-1]

    @property
    def chain_length(self) -> Any:
        """Sum of the link lengths [m]."""
        return self.link_length.sum(axis=-1)

    @property
    def angle_limits(self) -> tuple[Any, Any]:
        """Minimum and maximum angles [rad]: infinite for full revolutions, and both at home for locked joints."""
        numpy = array_library(self.home)
        lower, upper = self.joint_range[..., 0], self.joint_range[..., 1]
        is_continuous = upper - lower >= 2 * np.pi - 1e-4  # models round pi in their text
        limits = numpy.where(is_continuous, -np.inf, lower), numpy.where(is_continuous, np.inf, upper)
        return tuple(numpy.where(self.is_free > 0, limit, self.home) for limit in limits)  # pyright: ignore

    def in_chain_lengths(self) -> "ArmArrays":
        """The arm with the lengths of its kinematics in units of its chain length."""
        lengths = "base_position", "offset", "link_position", "link_length", "hand_position"
        unit = 1 / self.chain_length
        return dataclasses.replace(self, **{name: unit * getattr(self, name) for name in lengths})

    def astype(self, dtype: Any) -> "ArmArrays":
        """The arm with floating numbers of another type."""
        return jax.tree.map(lambda x: x.astype(dtype) if np.issubdtype(x.dtype, np.floating) else x, self)


def arm_arrays(
    arm: Arm,
    free: Sequence[bool] | np.ndarray | None = None,
    *,
    slots: tuple[int, int] = (MAX_JOINTS, MAX_LINKS),
) -> ArmArrays:
    """The arrays of an arm, in double precision.

    Args:
      arm: a serial arm; joints that its config locks have no slot.
      free: whether each joint moves; the others are locked at home. All move where None.
      slots: of joints and links. Arms with equal slots share compiled functions, which are faster with fewer. Physics
        and environments take the default.

    Raises:
      ValueError: a tree, or more joints or links than there are slots.
    """
    embodiment, model = arm.embodiment, arm.model
    joints, links = embodiment.num_joints, embodiment.num_links
    if not embodiment.is_serial:
        raise ValueError(f"{embodiment.name}: expected a serial arm, got a tree of {len(embodiment.chains)} chains")
    max_joints, max_links = slots
    if joints > max_joints or links > max_links:
        raise ValueError(
            f"{embodiment.name}: expected at most {max_joints} joints and {max_links} links, got {joints} and {links}"
        )
    masses, rotations, origins = body_moments(arm)
    twist, offset, reference, _ = placements(rotations, origins)
    first_moment, second_moment = moments_of_joints(masses, rotations, origins)
    is_free = np.ones(joints) if free is None else np.asarray(free, float)
    link_joint = np.array(embodiment.link_joint)
    axes_of_link = np.concatenate([np.eye(3)[None], rotations])[link_joint + 1]
    origin_of_link = np.concatenate([np.zeros((1, 3)), origins])[link_joint + 1]
    positions = np.einsum("lji,lj->li", axes_of_link, embodiment.link_position - origin_of_link)
    directions = np.einsum("lji,lj->li", axes_of_link, embodiment.link_rotation[:, :, 0])
    arrays = ArmArrays(
        base_rotation=snap_to_units(rotations[0]),
        base_position=snap_to_units(origins[0]),
        twist=_padded(snap_to_units(twist), max_joints),
        offset=_padded(snap_to_units(offset), max_joints),
        reference=_padded(reference, max_joints),
        first_moment=_padded(first_moment, max_joints),
        second_moment=_padded(second_moment, max_joints),
        armature=_padded(model.dof_armature, max_joints),
        damping=_padded(model.dof_damping, max_joints),
        is_free=_padded(is_free, max_joints),
        home=_padded(embodiment.home, max_joints),
        joint_range=_padded(embodiment.joint_range, max_joints),
        velocity_limit=_padded(finite_velocity_limit(embodiment), max_joints),
        torque_limit=_padded(embodiment.torque_limit, max_joints),
        link_joint=_padded(link_joint, max_links).astype(np.int32),
        link_position=_padded(snap_to_units(positions), max_links),
        link_direction=_padded(snap_to_units(directions), max_links),
        link_length=_padded(embodiment.link_lengths, max_links),
        **_hand_arrays(embodiment, rotations, origins),
    )
    return _with_empty_slots(arrays, joints, links)


def _hand_arrays(arm: Embodiment, rotations: np.ndarray, origins: np.ndarray) -> dict[str, Any]:
    """The fields of the hand of `ArmArrays`, from the frames of the joints."""
    if not arm.hand_joint:
        return {"hand_joint": np.asarray(-1, np.int32), "hand_position": np.zeros(3), "hand_rotation": np.eye(3)}
    joint = arm.hand_joint[0]
    rotation, origin = (rotations[joint], origins[joint]) if joint >= 0 else (np.eye(3), np.zeros(3))
    return {
        "hand_joint": np.asarray(joint, np.int32),
        "hand_position": snap_to_units((arm.hand_position[0] - origin) @ rotation),
        "hand_rotation": snap_to_units(rotation.T @ arm.hand_rotation[0]),
    }


def body_moments(
    arm: Arm,
) -> tuple[Float[np.ndarray, "joints 4 4"], Float[np.ndarray, "joints 3 3"], Float[np.ndarray, "joints 3"]]:
    """Moments of mass of each joint's body in its frame, see `pseudo_inertia`; and the frames, see `joint_frames`."""
    embodiment, to_world = arm.embodiment, arm.T_world_base
    rotations, origins = joint_frames(np.asarray(embodiment.joint_axis), np.asarray(embodiment.joint_anchor))
    in_world = to_world[:3, :3] @ rotations, origins @ to_world[:3, :3].T + to_world[:3, 3]
    return moments_in_frames(arm.model, *in_world), rotations, origins


def moments_in_frames(
    model: mujoco.MjModel, rotations: Float[np.ndarray, "joints 3 3"], origins: Float[np.ndarray, "joints 3"]
) -> Float[np.ndarray, "joints 4 4"]:
    """Moments of mass of each joint's body in a frame, see `pseudo_inertia`.

    Args:
      model: from `simulation_model`.
      rotations: of the frames in the world, at angles 0.
      origins: of the frames [m].
    """
    data = mujoco.MjData(model)
    data.qpos[:] = 0.0
    mujoco.mj_kinematics(model, data)
    last_joint = {int(body): joint for joint, body in enumerate(model.jnt_bodyid)}
    masses = np.zeros((len(rotations), 4, 4))
    for body, joint in last_joint.items():  # if a body has several joints, the others move no mass of their own
        masses[joint] = pseudo_inertia(model, data, body, rotations[joint], origins[joint])
    return masses


def moments_of_joints(
    masses: Float[Any, "joints 4 4"],
    rotations: Float[Any, "joints 3 3"],
    origins: Float[Any, "joints 3"],
    parents: Sequence[int] | None = None,
) -> tuple[Float[Any, "joints 2"], Float[Any, "joints 5"]]:
    """`first_moment` and `second_moment` of `ArmArrays`, which are linear in the moments of the bodies."""
    masses = without_mass_on_axes(masses, rotations, origins, parents)
    return masses[:, :2, 3], masses[:, (0, 1, 0, 0, 1), (0, 1, 1, 2, 2)]


def masked_arrays(config: ArmConfig, limits: str, links: str) -> tuple[ArmArrays, tuple[str, ...]]:
    """The arrays of an arm where joints that its config locks have slots, and the names of the joints in the slots.

    Args:
      config: of the arm.
      limits: see `EnvConfig`.
      links: see `MetricConfig`.

    Raises:
      ValueError: see `arm_arrays`.
    """
    whole = build_arm(dataclasses.replace(config, locked=None), limits, links)
    locked = build_arm(config, limits, links).locked if config.locked else {}
    names = whole.embodiment.joint_names
    arrays = arm_arrays(whole, free=[name not in locked for name in names])
    for i, name in enumerate(names):
        arrays.home[i] = locked.get(name, arrays.home[i])
    return arrays, names


def stack_arms(arms: Sequence[ArmArrays]) -> ArmArrays:
    """A batch of arms, along the first axis."""
    return jax.tree.map(lambda *x: np.stack(x), *arms)


def lock_joints(arm: ArmArrays, locked: Any) -> ArmArrays:
    """The arm with more joints locked at home.

    Args:
      arm: the arm.
      locked: [joints] 1 or True for the joints to lock.
    """
    return dataclasses.replace(arm, is_free=arm.is_free * (1 - locked))


def _padded(values: Any, size: int) -> np.ndarray:
    values = np.asarray(values, float)
    return np.concatenate([values, np.zeros((size - len(values), *values.shape[1:]))])


def _with_empty_slots(arrays: ArmArrays, joints: int, links: int) -> ArmArrays:
    """Fills the slots beyond an arm's own joints and links with numbers that are harmless."""
    arrays.twist[joints:] = 1.0, 0.0
    arrays.armature[joints:] = 1.0
    arrays.joint_range[joints:] = -np.pi, np.pi
    arrays.velocity_limit[joints:] = np.pi
    arrays.torque_limit[joints:] = 1.0
    arrays.link_joint[links:] = -1
    arrays.link_direction[links:] = 1.0, 0.0, 0.0
    return arrays


class Placements(NamedTuple):
    """Where each joint's frame is in that of its parent, see `ArmArrays`; that of a joint at the base is its own.

    Attributes:
      twist, offset, reference: of the joints.
      branch: [joints, 2] cosine and sine of the angle about the parent's axis from its x-axis, which is normal to the
        axis of its first child, to the normal to this joint's axis.
    """

    twist: Any
    offset: Any
    reference: Any
    branch: Any


def joint_frames(
    axes: Float[Any, "joints 3"],
    anchors: Float[Any, "joints 3"],
    min_angle: float = _PARALLEL,
    parents: Sequence[int] | None = None,
) -> tuple[Float[Any, "joints 3 3"], Float[Any, "joints 3"]]:
    """Rotations and origins of the joints' frames at angle 0; NumPy or JAX arrays.

    Args:
      axes: unit axes of the joints.
      anchors: a point on each axis.
      min_angle: axes at a smaller angle are parallel [rad].
      parents: index of each joint's parent, -1 at the base; those of a serial arm where None.
    """
    numpy, parents = array_library(axes), _parents(len(axes), parents)
    origins: list[Any] = []
    for axis, anchor, parent in zip(axes, anchors, parents, strict=True):
        origins.append(anchor if parent < 0 else anchor + numpy.sum(axis * (origins[parent] - anchor)) * axis)
    rotations = []
    for joint, axis in enumerate(axes):
        first_child = parents.index(joint) if joint in parents else None
        x = _normal_to_child(axes, origins, joint, first_child, min_angle)
        rotations.append(numpy.stack([x, numpy.cross(axis, x), axis], axis=1))
    return numpy.stack(rotations), numpy.stack(origins)


def _parents(count: int, parents: Sequence[int] | None) -> list[int]:
    return list(range(-1, count - 1) if parents is None else parents)


def _normal_to_child(axes: Any, origins: Any, joint: int, child: int | None, min_angle: float) -> Any:
    """A unit vector normal to a joint's axis, and to that of a child if it has one."""
    numpy, axis = array_library(axes), axes[joint]
    candidates = [] if child is None else [numpy.cross(axis, axes[child]), origins[child] - origins[joint]]
    candidates = numpy.stack([*candidates, *numpy.eye(3, dtype=axes.dtype)])
    normals = candidates - numpy.sum(candidates * axis, axis=1, keepdims=True) * axis
    lengths = numpy.sqrt(numpy.sum(normals * normals, axis=1))
    first = numpy.argmax(lengths > min_angle)
    normal = normals[first] / lengths[first]
    normal = normal - numpy.sum(normal * axis) * axis  # a short vector was not normal to rounding
    return normal / numpy.sqrt(numpy.sum(normal * normal))


def placements(
    rotations: Float[Any, "joints 3 3"], origins: Float[Any, "joints 3"], parents: Sequence[int] | None = None
) -> Placements:
    """The placements of frames from `joint_frames`."""
    numpy, parents = array_library(rotations), _parents(len(rotations), parents)
    no_rotation, axes = numpy.array([1.0, 0.0]), rotations[:, :, 2]
    columns: list[tuple[Any, ...]] = []
    for i, parent in enumerate(parents):
        if parent < 0:
            columns.append((no_rotation, numpy.zeros(2), numpy.zeros(()), no_rotation))
            continue
        x, y, z = (rotations[parent][:, k] for k in range(3))
        branch = no_rotation
        if parents.index(parent) != i:
            normal = _normal_to_child(axes, origins, parent, i, _PARALLEL)
            branch = numpy.stack([numpy.sum(x * normal), numpy.sum(y * normal)])
            x, y = normal, numpy.cross(z, normal)
        axis, step, next_x = axes[i], origins[i] - origins[parent], rotations[i][:, 0]
        cosine, sine = numpy.sum(z * axis), -numpy.sum(y * axis)
        twisted_y = cosine * y + sine * z
        offset = numpy.stack([numpy.sum(x * step), numpy.sum(twisted_y * step)])
        reference = numpy.arctan2(numpy.sum(twisted_y * next_x), numpy.sum(x * next_x))
        columns.append((numpy.stack([cosine, sine]), offset, reference, branch))
    return Placements(*(numpy.stack(column) for column in zip(*columns, strict=True)))


def without_mass_on_axes(
    masses: Float[Any, "joints 4 4"],
    rotations: Float[Any, "joints 3 3"],
    origins: Float[Any, "joints 3"],
    parents: Sequence[int] | None = None,
) -> Float[Any, "joints 4 4"]:
    """Moments of mass in the frames of the joints, where the mass on each axis is part of the parent.

    See mimic/physics/dynamics.py.
    """
    numpy, parents = array_library(masses), _parents(len(masses), parents)
    on_axis = np.zeros((4, 4))
    on_axis[2:, 2:] = 1.0
    result = list(masses)
    for i in reversed(range(len(masses))):
        mass, parent = result[i], parents[i]
        result[i] = mass * (1 - on_axis)
        if parent >= 0:
            step = rotations[parent].T @ (origins[i] - origins[parent])
            upper = numpy.concatenate([rotations[parent].T @ rotations[i], step[:, None]], axis=1)
            placement = numpy.concatenate([upper, numpy.array([[0.0, 0.0, 0.0, 1.0]])])
            result[parent] = result[parent] + placement @ (mass * on_axis) @ placement.T
    return numpy.stack(result)
