"""Link frames, twists and link states of an arm: an embodiment, or an arm as data.

Joint angles and velocities may have batch axes before that of the joints. These broadcast; `jax.vmap` gives the same.
"""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from mimic.arms.arrays import ArmArrays
from mimic.arms.embodiment import LONG, Embodiment
from mimic.base import spatial
from mimic.base.batches import floats, over_batch
from mimic.base.spatial import Rotation, Vector
from mimic.metric.hand import HandStates


@struct.dataclass
class Frames:
    """Link frames T_0i in the base frame.

    Attributes:
      position: [n, 3] origins [m].
      rotation: [n, 3, 3], whose first column is the link's direction.
    """

    position: Float[Array, "links 3"]
    rotation: Float[Array, "links 3 3"]


@struct.dataclass
class LinkStates:
    """Positions, directions and velocities of the links, which the metric compares; each [n, 3] in the base frame.

    Attributes:
      position: origins of the link frames; in chain lengths where normalized, else [m].
      direction: unit x-axes of the link frames; None for candidate points.
      linear_velocity: of the origins; in chain lengths per second where normalized, else [m/s].
      angular_velocity: spatial angular velocity [rad/s]; None for candidate points.
      hand: states of the hands; None for candidate points, and for an arm without a known hand.
    """

    position: Float[Array, "links 3"]
    direction: Float[Array, "links 3"] | None
    linear_velocity: Float[Array, "links 3"]
    angular_velocity: Float[Array, "links 3"] | None
    hand: HandStates | None = None


class JointFrame(NamedTuple):
    """State of a joint's child body: its rotation from the zero pose, the joint's anchor, and their velocities.

    That of an arm as data is the rotation of the joint's frame, see mimic/arms/arrays.py.
    """

    rotation: Rotation
    anchor: Vector
    angular_velocity: Vector
    linear_velocity: Vector


class LinkVectors(NamedTuple):
    """The state of one link as scalar components; the fields are those of `LinkStates`."""

    position: Vector
    direction: Vector
    linear_velocity: Vector
    angular_velocity: Vector


BASE = JointFrame(spatial.IDENTITY, spatial.ZERO, spatial.ZERO, spatial.ZERO)


def forward_kinematics(arm: Embodiment, qpos: Float[ArrayLike, "*batch joints"]) -> Frames:
    """Link frames (paper, eq. 5).

    Args:
      arm: the embodiment.
      qpos: joint angles [rad].

    Returns:
      Frames with the batch axes of `qpos`, if any, before their own.

    Raises:
      ValueError: `qpos` is not [..., joints].
    """
    return over_batch(functools.partial(_frames, arm), joint_values(arm, qpos, "qpos"), axes=1)


def _frames(arm: Embodiment, qpos: Float[Array, " joints"]) -> Frames:
    frames = joint_frames(arm, qpos, None)
    positions, rotations = [], []
    for link, joint in enumerate(arm.link_joint):
        frame = frames[joint + 1]
        positions.append(spatial.add(frame.anchor, spatial.rotate(frame.rotation, _zero_offset(arm, link, joint))))
        rotations.append(spatial.compose(frame.rotation, spatial.rotation(arm.link_rotation[link])))
    return Frames(
        position=spatial.stack(positions, qpos.dtype),
        rotation=spatial.stack([sum(rotation, ()) for rotation in rotations], qpos.dtype).reshape(-1, 3, 3),
    )


def hand_frames(arm: Embodiment, qpos: Float[ArrayLike, "*batch joints"]) -> Frames:
    """Frames of the hands, one for each chain: origins [hands, 3] in metres and rotations [hands, 3, 3].

    The z-axis is the approach, and the gripper opens along the x-axis.

    Args:
      arm: the embodiment.
      qpos: joint angles [rad].

    Returns:
      Frames with the batch axes of `qpos`, if any, before their own; without a hand where none is known.

    Raises:
      ValueError: `qpos` is not [..., joints].
    """

    def frames(qpos: Float[Array, " joints"]) -> Frames:
        vectors = hand_vectors(arm, joint_frames(arm, qpos, None))
        position = spatial.stack([vector.position for vector in vectors[::3]], qpos.dtype).reshape(-1, 3)
        axes = spatial.stack([vector.direction for vector in vectors], qpos.dtype).reshape(-1, 3, 3)
        return Frames(position, jnp.swapaxes(axes, 1, 2))

    return over_batch(frames, joint_values(arm, qpos, "qpos"), axes=1)


def link_states(
    arm: Embodiment | ArmArrays,
    qpos: Float[ArrayLike, "*#batch joints"],
    qvel: Float[ArrayLike, "*#batch joints"] | None = None,
    *,
    normalized: bool = True,
) -> LinkStates:
    """Positions, directions and velocities of the links (paper, eqs. 8-10).

    Args:
      arm: the embodiment, or an arm as data, whose empty slots of links are at the base.
      qpos: joint angles [rad].
      qvel: joint velocities [rad/s]; zero where None.
      normalized: divide positions and linear velocities by the chain length.

    Returns:
      States with the batch axes of `qpos` and `qvel`, if any, before their own.

    Raises:
      ValueError: `qpos` or `qvel` is not [..., joints].
    """
    motion = [joint_values(arm, qpos, "qpos")]
    if qvel is not None:
        motion.append(joint_values(arm, qvel, "qvel"))
    return over_batch(functools.partial(_link_states, arm, normalized), *motion, axes=1)


def _link_states(
    arm: Embodiment | ArmArrays,
    normalized: bool,
    qpos: Float[Array, " joints"],
    qvel: Float[Array, " joints"] | None = None,
) -> LinkStates:
    if isinstance(arm, ArmArrays):
        return states_in_frames(arm, frame_table(arm, qpos, qvel), normalized=normalized)
    if arm.num_joints > LONG:
        arm = jax.tree.map(lambda leaf: jnp.asarray(leaf, qpos.dtype), arm)
        return _states_of_long_arm(arm, qpos, jnp.zeros_like(qpos) if qvel is None else qvel, normalized)
    return _stacked(arm, qpos, qvel, lambda vectors: spatial.stack(vectors, qpos.dtype), normalized=normalized)


@functools.partial(jax.jit, static_argnames="normalized")
def _states_of_long_arm(arm: Embodiment, qpos: Array, qvel: Array, normalized: bool) -> LinkStates:
    """`link_states` of many joints, whose code does not grow with their number; all numbers have one dtype."""
    frames = (_frames_of_chain if arm.is_serial else _frames_of_tree)(arm, qpos, qvel)
    anchors = jnp.concatenate([jnp.zeros((1, 3), qpos.dtype), arm.joint_anchor])  # the base's first
    frame_index = np.asarray(row_joints(arm)) + 1
    positions = jnp.concatenate([arm.link_position, jnp.repeat(arm.hand_position, 3, axis=0)])
    directions = jnp.concatenate([arm.link_rotation[:, :, 0], jnp.swapaxes(arm.hand_rotation, 1, 2).reshape(-1, 3)])
    of_rows = jax.tree.map(lambda leaf: leaf[frame_index], frames)
    unit = 1 / arm.chain_length if normalized else 1.0
    return _states_of_rows(of_rows, positions - anchors[frame_index], directions, unit, arm.num_links)


def _states_of_rows(of_rows: JointFrame, offsets: Any, directions: Any, unit: Any, links: int) -> LinkStates:
    """States of links and axes of hands by array operations; see `link_state`.

    Args:
      of_rows: frame of the body of each link, and of the body of each axis of a hand, arrays [rows].
      offsets: [rows, 3] of the origins, in the frames' axes.
      directions: [rows, 3] in the frames' axes.
      unit: factor on lengths.
      links: number of links.
    """
    vectors = link_state(of_rows, *(spatial.vector(jnp.asarray(x).T) for x in (offsets, directions)))
    rows = LinkVectors(*(jnp.stack(x, axis=-1) for x in _in_units(unit, vectors)))  # type: ignore[arg-type]
    hand: Any = LinkVectors(*(x[links:] for x in rows))  # type: ignore[index]
    return LinkStates(*(x[:links] for x in rows), _hand_states(hand))  # type: ignore[index]


def _hand_states(axes: LinkVectors) -> HandStates | None:
    """The hands, from the states [3 hands, 3] of their axes, as lists or arrays; None where there are none."""
    if not len(axes.position):
        return None
    position, angular_velocity = axes.position[::3], axes.angular_velocity[::3]
    return HandStates(position, axes.direction, angular_velocity)  # type: ignore[arg-type]


FrameTable = Float[Array, "frames 18"]  # rows of frames of the base and of each joint: the numbers of a `JointFrame`


def frame_table(
    arm: ArmArrays, qpos: Float[Array, " joints"], qvel: Float[Array, " joints"] | None = None
) -> FrameTable:
    """Frames of the base and of each joint of an arm as data, one sample; batch with `jax.vmap`.

    Args:
      arm: the arm.
      qpos: joint angles [rad].
      qvel: joint velocities [rad/s]; zero where None.
    """
    frames = joint_frames(arm.astype(qpos.dtype), qpos, qvel)
    return spatial.stack([jax.tree.leaves(frame) for frame in frames], qpos.dtype)


def axes_and_origins(frames: FrameTable) -> tuple[Float[Array, "joints 3"], Float[Array, "joints 3"]]:
    """Axes and origins [m] of the joints of an arm as data, in the base frame."""
    return frames[1:, 2:9:3], frames[1:, 9:12]


def states_in_frames(arm: ArmArrays, frames: FrameTable, *, normalized: bool = True) -> LinkStates:
    """Link states of an arm as data, from `frame_table`."""
    arm = arm.astype(frames.dtype)
    joint, position, direction = arm.rows
    of_rows = jax.tree.unflatten(jax.tree.structure(BASE), list(frames[joint + 1].T))
    unit = 1 / arm.chain_length if normalized else 1.0
    return _states_of_rows(of_rows, position, direction, unit, len(arm.link_length))


def _frames_of_chain(arm: Embodiment, qpos: Array, qvel: Array) -> JointFrame:
    """Frames of the base and of each joint's child body [joints + 1], by a loop over the joints of a chain.

    2.6 times as fast as `_frames_of_tree`, with derivatives too (40 joints, 256 poses, two cores).
    """
    base = jax.tree.map(lambda number: jnp.asarray(number, qpos.dtype), BASE)

    def next_frame(parent: JointFrame, joint: Any) -> tuple[JointFrame, JointFrame]:
        offset, axis, angle, speed = joint
        frame = child_frame(parent, spatial.vector(offset), spatial.vector(axis), angle, speed)
        return frame, frame

    anchors = jnp.concatenate([jnp.zeros((1, 3), qpos.dtype), arm.joint_anchor])  # the base's first
    _, frames = jax.lax.scan(next_frame, base, (jnp.diff(anchors, axis=0), arm.joint_axis, qpos, qvel))
    return jax.tree.map(lambda first, rest: jnp.concatenate([first[None], rest]), base, frames)


def _frames_of_tree(arm: Embodiment, qpos: Array, qvel: Array) -> JointFrame:
    """As `_frames_of_chain`, by a loop that looks up the frame of each joint's parent."""
    frames = jax.tree.map(lambda number: jnp.full(arm.num_joints + 1, number, qpos.dtype), BASE)
    anchors = jnp.concatenate([jnp.zeros((1, 3), qpos.dtype), arm.joint_anchor])
    parent_rows = np.array(arm.joint_parent) + 1
    offsets, rows = arm.joint_anchor - anchors[parent_rows], np.arange(arm.num_joints) + 1

    def next_frame(frames: JointFrame, joint: Any) -> tuple[JointFrame, None]:
        row, parent_row, offset, axis, angle, speed = joint
        parent = jax.tree.map(lambda leaf: leaf[parent_row], frames)
        frame = child_frame(parent, spatial.vector(offset), spatial.vector(axis), angle, speed)
        return jax.tree.map(lambda leaf, value: leaf.at[row].set(value), frames, frame), None

    return jax.lax.scan(next_frame, frames, (rows, parent_rows, offsets, arm.joint_axis, qpos, qvel))[0]


def resting_link_states(arm: Embodiment | ArmArrays, qpos: Float[Array, "joints poses"]) -> LinkStates:
    """Normalized link states at rest of a batch of poses along the last axis.

    The same as `jax.vmap(link_states)`, which takes two to four times as long to compile and to run on a CPU.

    Args:
      arm: the embodiment.
      qpos: joint angles [rad].

    Returns:
      Arrays [links, 3, poses].
    """
    if isinstance(arm, ArmArrays) or arm.num_joints > LONG:
        return jax.vmap(functools.partial(link_states, arm), -1, -1)(qpos)
    return _stacked(arm, [*qpos], None, lambda vectors: spatial.stack_batches(vectors, qpos[0]))


def link_state_table(
    arm: Embodiment,
    qpos: Float[np.ndarray, "*batch joints"],
    qvel: Float[np.ndarray, "*batch joints"],
    dtype: Any = np.float32,
) -> LinkStates:
    """Link states of whole trajectories by NumPy, without compilation, for tables that are computed once.

    Args:
      arm: the embodiment.
      qpos: joint angles [rad].
      qvel: joint velocities [rad/s].
      dtype: of the result.

    Returns:
      Arrays [*batch, links, 3], computed in double precision.
    """
    shape = np.shape(qpos)[:-1]
    angles, speeds = (np.asarray(x, float).reshape(-1, arm.num_joints).T for x in (qpos, qvel))

    def table(column: Sequence[Vector]) -> Any:
        rows = [np.stack(np.broadcast_arrays(*row, angles[0])[:3], axis=-1) for row in column]
        return np.stack(rows, axis=1).reshape(*shape, len(rows), 3).astype(dtype)

    with np.errstate(invalid="ignore", over="ignore"):  # of an unstable rollout
        return _stacked(arm, [*angles], [*speeds], table)


def _stacked(
    arm: Embodiment, qpos: Any, qvel: Any, stack: Callable[[Sequence[Vector]], Array], *, normalized: bool = True
) -> LinkStates:
    """Link states of scalar components, as arrays that `stack` makes from the vectors of all links."""
    unit = 1 / spatial.scalar(arm.chain_length) if normalized else 1.0
    frames = joint_frames(arm, qpos, qvel)
    links, axes = (
        LinkVectors(*zip(*(_in_units(unit, row) for row in rows), strict=True)) if rows else None
        for rows in (link_vectors(arm, frames), hand_vectors(arm, frames))
    )
    assert links is not None
    hand = None if axes is None else jax.tree.map(stack, _hand_states(axes), is_leaf=lambda x: isinstance(x, tuple))
    return LinkStates(*map(stack, links), hand=hand)  # pyright: ignore[reportArgumentType]


def _in_units(unit: spatial.Scalar, link: LinkVectors) -> LinkVectors:
    """The state with its lengths multiplied by a factor."""
    position, velocity = (spatial.scale(unit, x) for x in (link.position, link.linear_velocity))
    return link._replace(position=position, linear_velocity=velocity)


def candidate_points(states: LinkStates) -> LinkStates:
    """Link states reduced to positions and linear velocities (paper, eq. 11)."""
    return dataclasses.replace(states, direction=None, angular_velocity=None, hand=None)


def body_twists(
    arm: Embodiment, qpos: Float[ArrayLike, "*#batch joints"], qvel: Float[ArrayLike, "*#batch joints"]
) -> Float[Array, "*batch links 6"]:
    """Body twists [omega, v] of the link frames, V = T^-1 dT/dt (paper, eq. 7).

    Units: omega [rad/s] and v [m/s], both in the link's own frame.

    Args:
      arm: the embodiment.
      qpos: joint angles [rad].
      qvel: joint velocities [rad/s].

    Raises:
      ValueError: `qpos` or `qvel` is not [..., joints].
    """
    rotations, states = forward_kinematics(arm, qpos).rotation, link_states(arm, qpos, qvel, normalized=False)
    assert states.angular_velocity is not None
    twists = [jnp.sum(rotations * x[..., None], axis=-2) for x in (states.angular_velocity, states.linear_velocity)]
    return jnp.concatenate(twists, axis=-1)


def joint_axes(arm: Embodiment, frames: Sequence[JointFrame]) -> list[Vector]:
    """Unit axes of the joints in the base frame.

    Args:
      arm: the embodiment.
      frames: from `joint_frames`.
    """
    return [
        spatial.rotate(frame.rotation, spatial.vector(axis))
        for frame, axis in zip(frames[1:], arm.joint_axis, strict=True)
    ]


def joint_frames(
    arm: Embodiment | ArmArrays, qpos: Sequence[spatial.Scalar] | Array, qvel: Sequence[spatial.Scalar] | Array | None
) -> list[JointFrame]:
    """Frames of the base and of each joint's child body, in the base frame and the arm's own unit of length.

    Args:
      arm: the embodiment.
      qpos: angle of each joint [rad].
      qvel: velocity of each joint [rad/s]; zero where None.
    """
    if isinstance(arm, ArmArrays):
        return _frames_of_arrays(arm, qpos, qvel)
    frames, anchors = [BASE], [spatial.ZERO]  # anchors in the zero pose
    for joint, parent in enumerate(arm.joint_parent):
        axis, anchor = spatial.vector(arm.joint_axis[joint]), spatial.vector(arm.joint_anchor[joint])
        speed, offset = 0.0 if qvel is None else qvel[joint], spatial.subtract(anchor, anchors[parent + 1])
        frames.append(child_frame(frames[parent + 1], offset, axis, qpos[joint], speed))
        anchors.append(anchor)
    return frames


def _frames_of_arrays(
    arm: ArmArrays, qpos: Sequence[spatial.Scalar] | Array, qvel: Sequence[spatial.Scalar] | Array | None
) -> list[JointFrame]:
    """`joint_frames` of the transforms that mimic/arms/arrays.py describes."""
    base = JointFrame(spatial.rotation(arm.base_rotation), spatial.vector(arm.base_position), *BASE[2:])
    frames = [base]
    for joint in range(arm.num_joints):
        twist, offset = ((1.0, 0.0), spatial.ZERO) if joint == 0 else (arm.twist[joint], (*arm.offset[joint], 0.0))
        angle, speed = qpos[joint] + arm.reference[joint], 0.0 if qvel is None else qvel[joint]
        parent = frames[-1]._replace(rotation=_about_x(frames[-1].rotation, twist[0], twist[1]))
        frames.append(child_frame(parent, offset, (0.0, 0.0, 1.0), angle, speed))
    return [BASE, *frames[1:]]


def _about_x(rotation: Rotation, cosine: spatial.Scalar, sine: spatial.Scalar) -> Rotation:
    """A frame after a rotation about its x-axis."""
    x, y, z = spatial.transpose(rotation)
    turned_y = spatial.add(spatial.scale(cosine, y), spatial.scale(sine, z))
    turned_z = spatial.subtract(spatial.scale(cosine, z), spatial.scale(sine, y))
    return spatial.transpose((x, turned_y, turned_z))


def child_frame(
    parent: JointFrame, offset: Vector, axis: Vector, angle: spatial.Scalar, speed: spatial.Scalar
) -> JointFrame:
    """Frame of a joint's child body.

    Args:
      parent: frame of the parent body.
      offset: from the parent joint's anchor to the joint's anchor, in the zero pose.
      axis: of the joint, in the zero pose.
      angle: of the joint [rad].
      speed: of the joint [rad/s].
    """
    offset = spatial.rotate(parent.rotation, offset)
    joint_velocity = spatial.scale(speed, spatial.rotate(parent.rotation, axis))
    return JointFrame(
        rotation=spatial.compose(parent.rotation, spatial.axis_rotation(axis, angle)),
        anchor=spatial.add(parent.anchor, offset),
        angular_velocity=spatial.add(parent.angular_velocity, joint_velocity),
        linear_velocity=spatial.add(parent.linear_velocity, spatial.cross(parent.angular_velocity, offset)),
    )


def link_vectors(arm: Embodiment, frames: Sequence[JointFrame]) -> list[LinkVectors]:
    """States of the links as scalar components.

    Args:
      arm: the embodiment.
      frames: from `joint_frames`.
    """
    directions = [spatial.vector(rotation[:, 0]) for rotation in arm.link_rotation]
    return [
        link_state(frames[joint + 1], _zero_offset(arm, link, joint), directions[link])
        for link, joint in enumerate(arm.link_joint)
    ]


def hand_vectors(arm: Embodiment, frames: Sequence[JointFrame]) -> list[LinkVectors]:
    """States of the hands as scalar components: of the x-, y- and z-axis of each, as a link's with its direction.

    Args:
      arm: the embodiment.
      frames: from `joint_frames`.
    """
    vectors = []
    for position, rotation, joint in zip(arm.hand_position, arm.hand_rotation, arm.hand_joint, strict=True):
        offset = spatial.subtract(spatial.vector(position), _anchor(arm, joint))
        vectors += [link_state(frames[joint + 1], offset, spatial.vector(axis)) for axis in rotation.T]
    return vectors


def row_joints(arm: Embodiment) -> tuple[int, ...]:
    """Index of the last joint that moves each link, and each axis of a hand after them; -1 for none."""
    return (*arm.link_joint, *(joint for joint in arm.hand_joint for _ in range(3)))


def link_state(frame: JointFrame, offset: Vector, direction: Vector) -> LinkVectors:
    """State of one link.

    Args:
      frame: of the body of the link.
      offset: from the joint's anchor to the link's origin, in the zero pose.
      direction: of the link, in the zero pose.
    """
    offset = spatial.rotate(frame.rotation, offset)
    return LinkVectors(
        position=spatial.add(frame.anchor, offset),
        direction=spatial.rotate(frame.rotation, direction),
        linear_velocity=spatial.add(frame.linear_velocity, spatial.cross(frame.angular_velocity, offset)),
        angular_velocity=frame.angular_velocity,
    )


def _zero_offset(arm: Embodiment, link: int, joint: int) -> Vector:
    """Vector from the anchor of the joint that moves a link to the link's origin, in the zero pose."""
    return spatial.subtract(spatial.vector(arm.link_position[link]), _anchor(arm, joint))


def _anchor(arm: Embodiment, joint: int) -> Vector:
    """Anchor of a joint in the zero pose; the origin for none."""
    return spatial.vector(arm.joint_anchor[joint]) if joint >= 0 else spatial.ZERO


def joint_values(arm: Embodiment | ArmArrays, values: ArrayLike, name: str) -> Array:
    """The values as a floating-point array, checked to be [..., joints].

    Args:
      arm: the embodiment.
      values: of its joints.
      name: of the argument, for the error.

    Raises:
      ValueError: another shape, or no real numbers.
    """
    values = jnp.asarray(floats(values, name))
    if values.ndim == 0 or values.shape[-1] != arm.num_joints:
        raise ValueError(f"{name}: expected shape [..., {arm.num_joints}] for {arm.name}, got {values.shape}")
    return values
