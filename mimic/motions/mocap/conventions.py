"""Unit and axes of captured points, found from the body where a file does not state them."""

import numpy as np

from mimic.motions.mocap.arms import ArmPoints
from mimic.motions.mocap.points import PointMotion

UNITS = {"m": 1.0, "dm": 0.1, "cm": 0.01, "mm": 0.001, "inch": 0.0254, "foot": 0.3048, "cmu": 0.0254 / 0.45}
UPS = ("x", "y", "z", "-x", "-y", "-z")
# Shoulder to wrist of adults. Of two units, only dm and cmu have numbers in common there: 7.1 to 7.5.
_ARM_LENGTH = 0.4, 0.75  # m
STATED_ARM_LENGTH = 0.3, 0.9  # m, also of children: where a file states the unit
_HIGH, _LOW = ("head", "neck", "nose", "c7", "lfhd", "rfhd"), ("foot", "ankle", "toe", "heel", "lank", "rank")


def guessed_units(motion: PointMotion, arms: dict[str, ArmPoints]) -> list[str]:
    """The units in which the arms have an adult's length."""
    lengths = [arm_length(motion, arm) for arm in arms.values()]
    minimum, maximum = _ARM_LENGTH
    return [
        unit
        for unit, metres in UNITS.items()
        if lengths and all(minimum <= length * metres <= maximum for length in lengths)
    ]


def arm_length(motion: PointMotion, arm: ArmPoints) -> float:
    """Median length from shoulder to elbow to wrist, in the motion's unit."""
    shoulder, elbow, wrist = (mean_point(motion, names) for names in (arm.shoulder, arm.elbow, arm.wrist))
    upper, lower = np.linalg.norm(elbow - shoulder, axis=1), np.linalg.norm(wrist - elbow, axis=1)
    return float(np.nanmedian(upper + lower))


def mean_point(motion: PointMotion, names: tuple[str, ...]) -> np.ndarray:
    """Mean position of some points [time, 3]."""
    if len(names) == 1:
        return motion.point(names[0])
    return np.mean([motion.point(name) for name in names], axis=0)


def guessed_up(motion: PointMotion) -> str | None:
    """The axis from the feet to the head; None where the motion has no such points."""
    high, low = (
        [i for i, name in enumerate(motion.names) if any(word in name.lower() for word in words)]
        for words in (_HIGH, _LOW)
    )
    if not high or not low:
        return None
    body = np.nanmean(motion.positions[:, high], axis=(0, 1)) - np.nanmean(motion.positions[:, low], axis=(0, 1))
    axis = int(np.argmax(np.abs(body)))
    return f"{'-' if body[axis] < 0 else ''}{'xyz'[axis]}"


def z_up(positions: np.ndarray, up: str) -> np.ndarray:
    """Positions turned so that `up` is z; a right-handed frame stays right-handed.

    Args:
      positions: [..., 3].
      up: one of `UPS`.
    """
    axis, sign = "xyz".index(up[-1]), -1.0 if up.startswith("-") else 1.0
    if sign < 0:  # a half turn about the next axis
        following = (axis + 1) % 3
        positions = positions * np.array([1.0 if i == following else -1.0 for i in range(3)])
    return np.roll(positions, 2 - axis, axis=-1)  # cyclic: x y z -> y z x keeps the handedness
