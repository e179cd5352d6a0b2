"""Limits of the joint angles of poses."""

from typing import Any

import numpy as np
from jaxtyping import Bool

from mimic.arms.arrays import ArmArrays
from mimic.arms.embodiment import Embodiment
from mimic.base.spatial import array_library


def pose_limits(arm: Embodiment | ArmArrays, dtype: Any) -> tuple[Any, Any]:
    """Lower and upper joint limits [rad]; infinite for `continuous_joints`, both at home where a mask locks a joint."""
    if isinstance(arm, ArmArrays):
        lower, upper = arm.angle_limits
        return lower.astype(dtype), upper.astype(dtype)
    lower, upper = np.asarray(arm.joint_range).T
    continuous = continuous_joints(arm)
    return np.where(continuous, -np.inf, lower).astype(dtype), np.where(continuous, np.inf, upper).astype(dtype)


def continuous_joints(arm: Embodiment | ArmArrays) -> Bool[Any, " joints"]:
    """Which joints can rotate by a full revolution: their range is 2 pi or more."""
    if isinstance(arm, ArmArrays):
        return array_library(arm.home).isinf(arm.angle_limits[0])
    lower, upper = np.asarray(arm.joint_range).T
    return upper - lower >= 2 * np.pi - 1e-4  # models round pi in their text


def motion_limits(arm: Embodiment) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper joint limits of motions [rad], infinite where the range is a full revolution and no more.

    That is how models without limits are read. A joint with a wider range winds up.
    """
    lower, upper = np.asarray(arm.joint_range, float).T
    endless = continuous_joints(arm) & (upper - lower < 2 * np.pi + 1e-4)
    return np.where(endless, -np.inf, lower), np.where(endless, np.inf, upper)
