"""Limits of the joint angles of poses."""

from typing import Any

import numpy as np
from jaxtyping import Bool

from mimic.arms.embodiment import Embodiment


def pose_limits(arm: Embodiment, dtype: Any) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper joint limits [rad]; infinite for `continuous_joints`."""
    lower, upper = np.asarray(arm.joint_range).T
    continuous = continuous_joints(arm)
    return np.where(continuous, -np.inf, lower).astype(dtype), np.where(continuous, np.inf, upper).astype(dtype)


def continuous_joints(arm: Embodiment) -> Bool[np.ndarray, " joints"]:
    """Which joints can rotate by a full revolution: their range is 2 pi or more."""
    lower, upper = np.asarray(arm.joint_range).T
    return upper - lower >= 2 * np.pi - 1e-4  # models round pi in their text
