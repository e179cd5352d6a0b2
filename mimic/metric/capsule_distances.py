"""Distances of the capsules around an arm's links, from each other and over poses."""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from mimic.arms.capsules import Capsules
from mimic.arms.embodiment import Embodiment
from mimic.base import spatial
from mimic.base.compilation import by_value
from mimic.control import clearance
from mimic.control.clearance import ClearanceConstants
from mimic.metric.kinematics import joint_frames

_SMOOTHING = 1e-4  # m, of the distance of crossing segments, whose second derivative is infinite without
_RANDOM_POSES, _CHANGE = 1000, 1e-3  # m, of a distance that joints change


def capsule_axes(arm: Embodiment, capsules: Capsules, qpos: Float[Array, " joints"]) -> tuple[Array, Array]:
    """Ends [capsules, 3] of the capsules' axes in a pose [m]."""
    frames = joint_frames(arm, qpos, None)
    anchors = np.concatenate([np.zeros((1, 3)), np.asarray(arm.joint_anchor)])

    def moved(points: np.ndarray) -> Array:
        rows = []
        for point, joint in zip(points, capsules.joint, strict=True):
            frame, offset = frames[joint + 1], spatial.vector(point - anchors[joint + 1])
            rows.append(spatial.add(frame.anchor, spatial.rotate(frame.rotation, offset)))
        return spatial.stack(rows, qpos.dtype)

    return moved(np.asarray(capsules.start)), moved(np.asarray(capsules.end))


def pair_distances(capsules: Capsules, start: Array, end: Array) -> Float[Array, " pairs"]:
    """Distance of each of the capsules' pairs [m], negative where they intersect; smoothed where axes cross."""
    i, j = np.array(capsules.pairs).T
    radii = jnp.asarray(capsules.radius[i] + capsules.radius[j], start.dtype)
    return clearance.segment_distances(start[i], end[i], start[j], end[j], jnp, _SMOOTHING) - radii


def changing_pairs(arm: Embodiment, capsules: Capsules) -> Bool[np.ndarray, " pairs"]:
    """Whether the joints change the distance of each pair; two capsules of a Panda's wrist are always 2.0 cm apart."""
    qpos = np.random.default_rng(0).uniform(-np.pi, np.pi, (_RANDOM_POSES, arm.num_joints))
    constants = clearance_constants(arm, capsules, pairs=capsules.pairs)
    axes = clearance.capsule_axes(qpos, constants)  # by NumPy, which has nothing to compile
    return np.ptp(clearance.pair_distances(*axes, constants), axis=0) > _CHANGE


@by_value
def colliding_pairs(arm: Embodiment, capsules: Capsules) -> list[tuple[int, int]]:
    """The capsules' pairs whose distance the joints change."""
    changes = changing_pairs(arm, capsules)
    return [pair for pair, is_changing in zip(capsules.pairs, changes, strict=True) if is_changing]


def clearance_constants(
    arm: Embodiment,
    capsules: Capsules,
    floor_height: float = 0.0,
    pairs: Sequence[tuple[int, int]] | None = None,
) -> ClearanceConstants:
    """The constants of an arm's clearance.

    It is the minimum distance of the capsules' pairs that joints change, and of the capsules from the floor, except
    those on the base and on the joints at the base.

    Args:
      arm: the embodiment.
      capsules: from `fit_capsules`, of the same arm.
      floor_height: height of the floor in the base frame [m].
      pairs: of capsules, in place of those that joints change.
    """
    pairs = colliding_pairs(arm, capsules) if pairs is None else pairs
    lengths = arm.joint_axis, arm.joint_anchor, capsules.start, capsules.end, capsules.radius, floor_height
    axis, anchor, start, end, radius, floor = (np.asarray(x, np.float32) for x in lengths)
    return ClearanceConstants(
        parent=np.array(arm.joint_parent),
        axis=axis,
        anchor=anchor,
        joint=np.array(capsules.joint),
        start=start,
        end=end,
        radius=radius,
        pairs=np.array(pairs, int).reshape(-1, 2),
        above=np.flatnonzero(~np.array(capsules.near_base)),
        floor_height=floor,
    )


def intrusion(distance: Float[Array, " pairs"], clearance: float) -> Float[Array, ""]:
    """Sum of the squared fractions of the clearance that distances lack, see `Costs.self_collision`."""
    return jnp.sum(jnp.maximum(0, 1 - distance / clearance) ** 2)
