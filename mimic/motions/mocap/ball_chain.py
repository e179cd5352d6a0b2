"""Captured links as an arm or a tree: three revolute joints for each link, so that each link turns freely.

The joints are a way to write the motion down, not those of the body: they let a captured motion take every place of an
expert's, such as demonstrations, files and views. Link states do not depend on them.
"""

import math

import numpy as np
from jaxtyping import Float

from mimic.arms.model_tree import quaternion
from mimic.arms.mujoco_chain import UNKNOWN_HAND
from mimic.motions.mocap.link_motion import CUTOFF, LinkMotion, motion_states

AXES = ("z", "y", "x")  # of a link's joints in turn, in its zero frame, whose x-axis points along the link
_RADIUS = 0.04  # of the capsules, of the length of the chain
_COLOUR = "0.80 0.62 0.50 1"


def ball_chain_xml(motion: LinkMotion, zero: Float[np.ndarray, "links 3 3"]) -> str:
    """An MJCF model of the links, with a capsule and a site for each of them.

    Args:
      motion: the links.
      zero: frames of the links in the zero pose; see `zero_frames`.
    """
    lengths, radius, base_points = motion.link_lengths, _RADIUS * motion.chain_length, motion.base_points

    def body(link: int) -> str:
        name, length, parent = motion.names[link], lengths[link], motion.parents[link]
        place = f"{lengths[parent]:.9g} 0 0" if parent >= 0 else _text(base_points[link])
        turn = _text(quaternion((zero[parent] if parent >= 0 else np.eye(3)).T @ zero[link]))
        tip = f"0 0 0 {length:.9g} 0 0"
        joints = "".join(f'<joint name="{name}_{axis}" axis="{_text(np.eye(3)["xyz".index(axis)])}"/>' for axis in AXES)
        mass = 1000 * np.pi * radius**2 * length  # of water
        inertia = mass * np.array([radius**2 / 2, length**2 / 12, length**2 / 12])
        shapes = (
            f'<body name="{name}" pos="{place}" quat="{turn}">{joints}'
            f'<inertial pos="{length / 2:.9g} 0 0" mass="{mass:.6g}" diaginertia="{_text(inertia)}"/>'
            f'<site name="link_{name}" type="capsule" fromto="{tip}" size="0.01"/>'
            f'<geom type="capsule" fromto="{tip}" size="{radius:.4g}" rgba="{_COLOUR}" contype="0" conaffinity="0"/>\n'
        )
        return f"{shapes}{''.join(map(body, motion.children(link)))}</body>\n"

    return (
        f'<mujoco model="{motion.name}">\n<compiler angle="radian"/>\n<option gravity="0 0 0"/>\n'
        f'<custom><text name="{UNKNOWN_HAND}" data="no marker shows how the hand is rolled"/></custom>\n<worldbody>\n'
        f"{''.join(map(body, motion.children(-1)))}</worldbody>\n</mujoco>\n"
    )


def zero_frames(motion: LinkMotion) -> Float[np.ndarray, "links 3 3"]:
    """Frames of the links in the zero pose: their mean directions in the frame of the parent.

    A joint's angles are singular 90 deg from there.
    """
    frames = _no_roll_frames(np.asarray(motion_states(motion, cutoff=np.inf).direction))
    zero: list[np.ndarray] = []
    for link, parent in enumerate(motion.parents):
        before = frames[:, parent] if parent >= 0 else np.tile(np.eye(3), (len(frames), 1, 1))
        relative = np.einsum("tji,tj->ti", before, frames[:, link, :, 0]).mean(axis=0)
        direction = relative / np.linalg.norm(relative) if np.linalg.norm(relative) > 1e-3 else np.eye(3)[0]
        zero.append((zero[parent] if parent >= 0 else np.eye(3)) @ _frame_along(direction))
    return np.stack(zero)


def ball_chain_motion(
    motion: LinkMotion, zero: Float[np.ndarray, "links 3 3"], *, cutoff: float = CUTOFF
) -> tuple[Float[np.ndarray, "time joints"], Float[np.ndarray, "time joints"]]:
    """Angles and velocities of the joints of `ball_chain_xml`, whose link states are those of `motion_states`.

    Directions and angular velocities are the same; positions and linear velocities as far as links keep their length.

    Args:
      motion: the links.
      zero: frames of the links in the zero pose.
      cutoff: see `motion_states`.

    Returns:
      qpos [rad] and qvel [rad/s], three for each link.
    """
    states = motion_states(motion, cutoff=cutoff)
    frames, velocities = _no_roll_frames(np.asarray(states.direction)), np.asarray(states.angular_velocity)
    at_base = np.tile(np.eye(3), (len(frames), 1, 1)), np.eye(3), np.zeros((len(frames), 3))
    qpos, qvel = [], []
    for link, index in enumerate(motion.parents):
        of_parent = frames[:, index], zero[index], velocities[:, index]
        parent, parent_zero, parent_velocity = of_parent if index >= 0 else at_base
        offset = parent_zero.T @ zero[link]  # of the zero frame in its parent's
        base = parent @ offset
        angles = _zyx_angles(np.swapaxes(base, 1, 2) @ frames[:, link])
        relative = np.einsum("tji,tj->ti", base, velocities[:, link] - parent_velocity)
        qpos.append(angles)
        qvel.append(np.linalg.solve(_joint_axes(angles), relative[:, :, None])[:, :, 0])
    return np.concatenate(qpos, axis=1), np.concatenate(qvel, axis=1)


def ball_chain_pose(
    directions: Float[np.ndarray, "links 3"], zero: Float[np.ndarray, "links 3 3"]
) -> Float[np.ndarray, " joints"]:
    """Angles of the joints of `ball_chain_xml` [rad] in which the links point in these directions.

    Each link is turned from its zero pose without a rotation about itself, so that the angles depend on nothing else.

    Args:
      directions: of the links, of length 1.
      zero: frames of the links in the zero pose.
    """
    parent, parent_zero, angles = np.eye(3), np.eye(3), []
    for direction, own_zero in zip(directions, zero, strict=True):
        base = parent @ parent_zero.T @ own_zero
        x, y, z = base.T @ direction
        yaw, pitch = math.atan2(y, x), math.asin(min(max(-z, -1.0), 1.0))
        angles.append((yaw, pitch, 0.0))
        parent, parent_zero = base @ _yaw_pitch(yaw, pitch), own_zero
    return np.array(angles).reshape(-1)


def _yaw_pitch(yaw: float, pitch: float) -> np.ndarray:
    """Rotation about z, then the new y."""
    cy, sy, cp, sp = math.cos(yaw), math.sin(yaw), math.cos(pitch), math.sin(pitch)
    return np.array([[cy * cp, -sy, cy * sp], [sy * cp, cy, sy * sp], [-sp, 0.0, cp]])


def _no_roll_frames(directions: np.ndarray) -> np.ndarray:
    """Frames [time, links, 3, 3] with the directions as x-axes, which never turn about these."""
    frames = np.empty((*directions.shape, 3))
    frames[0] = [_frame_along(direction) for direction in directions[0]]
    for time in range(1, len(directions)):
        frames[time] = _smallest_rotations(directions[time - 1], directions[time]) @ frames[time - 1]
    frames[..., 0] = directions
    # Removes the rounding of thousands of products.
    frames[..., 2] = _unit(np.cross(frames[..., 0], frames[..., 1]))
    frames[..., 1] = np.cross(frames[..., 2], frames[..., 0])
    return frames


def _smallest_rotations(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Rotations [n, 3, 3] that map directions onto others, which are not opposite."""
    axis, cosine = np.cross(first, second), np.sum(first * second, axis=-1)
    skew = np.cross(np.eye(3), axis[:, None, :])
    return np.eye(3) + skew + skew @ skew / (1 + cosine)[:, None, None]


def _frame_along(direction: np.ndarray) -> np.ndarray:
    """A frame whose x-axis is a direction, with a horizontal y-axis where there is one."""
    side = np.cross([0.0, 0.0, 1.0], direction)
    if np.linalg.norm(side) < 1e-6:
        side = np.array([0.0, 1.0, 0.0])
    side = _unit(side)
    return np.stack([direction, side, np.cross(direction, side)], axis=1)


def _zyx_angles(rotation: np.ndarray) -> np.ndarray:
    """Angles [n, 3] of rotations about z, then the new y, then the new x; without jumps of a full turn."""
    pitch = np.arcsin(np.clip(-rotation[:, 2, 0], -1, 1))
    yaw = np.arctan2(rotation[:, 1, 0], rotation[:, 0, 0])
    roll = np.arctan2(rotation[:, 2, 1], rotation[:, 2, 2])
    return np.unwrap(np.stack([yaw, pitch, roll], axis=1), axis=0)


def _joint_axes(angles: np.ndarray) -> np.ndarray:
    """Axes of the three joints as columns [n, 3, 3], in the frame before the first one."""
    yaw, pitch = angles[:, 0], angles[:, 1]
    zero, one = np.zeros_like(yaw), np.ones_like(yaw)
    columns = (
        (zero, zero, one),
        (-np.sin(yaw), np.cos(yaw), zero),
        (np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), -np.sin(pitch)),
    )
    return np.stack([np.stack(column, axis=1) for column in columns], axis=2)


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def _text(values: np.ndarray) -> str:
    return " ".join(f"{value:.12g}" for value in values)
