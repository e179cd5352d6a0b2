"""Unit and axes of captured points, found from the body where a file does not state them."""

import dataclasses
import itertools

import numpy as np

from mimic.motions.mocap.names import parts_of
from mimic.motions.mocap.points import ArmPoints, PointMotion, median_length

UNITS = {"m": 1.0, "dm": 0.1, "cm": 0.01, "mm": 0.001, "inch": 0.0254, "foot": 0.3048, "cmu": 0.0254 / 0.45}
UPS = ("x", "y", "z", "-x", "-y", "-z")
# Shoulder to wrist of adults. Of two units, only dm and cmu have numbers in common there: 7.1 to 7.5.
_ARM_LENGTH = 0.4, 0.75  # m
STATED_ARM_LENGTH = 0.3, 0.9  # m, also of children: where a file states the unit
# Of what speaks for an axis as up.
_WEIGHTS = {"usual": 1.5, "stated": 3.0, "body": 2.0, "unlikely": 1.0, "floor": 2.0, "rest": 1.0}
_LIKELY = ("y", "z", "-y")  # axes that point up; -y in the frame of a camera
_LEANING = 0.8  # cosine of the angle between a body and an axis, below which it is along none
_HIGH = {"head": ("head",), "neck": ("neck",), "shoulders": ("shoulder",), "arms": ("upper_arm",)}
_LOW = {"feet": ("foot",), "toes": ("toe",), "hips": ("hip",), "knees": ("knee",)}
_FLOOR = -0.04, 0.1, 0.04  # of the body's size: height of its lowest point at least and at most, and mean height
_BACKWARDS = -0.5  # cosine of the angle between the toes and where the shoulders face


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
    """Median length from shoulder to elbow to wrist, in the motion's unit; NaN where it was never seen."""
    return sum(segments(motion, arm))


def segments(motion: PointMotion, arm: ArmPoints) -> tuple[float, float]:
    """Median lengths of upper arm and forearm, in the motion's unit; NaN where they were never seen."""
    shoulder, elbow, wrist = (mean_point(motion, names) for names in (arm.shoulder, arm.elbow, arm.wrist))
    return median_length(elbow - shoulder), median_length(wrist - elbow)


def mean_point(motion: PointMotion, names: tuple[str, ...]) -> np.ndarray:
    """Mean position of some points [time, 3]."""
    if len(names) == 1:
        return motion.point(names[0])
    return np.mean([motion.point(name) for name in names], axis=0)


def find_up(motion: PointMotion, usual: str, stated: str = "", rest: np.ndarray | None = None) -> tuple[str, str]:
    """The axis that points up, and how it was found.

    What speaks for an axis is weighed: the body stands along it, its lowest points are at 0, the skeleton at rest
    stands along it, the file states it, and it is usual. A person may lie, lean or stand on the hands: a body along an
    axis that is hardly ever up, or far from all axes, counts less.

    Args:
      motion: the points, in the file's axes.
      usual: axis of such files.
      stated: axis that the file states; "" for none.
      rest: positions of the points of a skeleton at rest [points, 3].
    """
    votes: dict[str, float] = dict.fromkeys(UPS, 0.0)
    votes[usual] += _WEIGHTS["usual"]
    body, how, is_along = _body_axis(motion)
    is_likely = is_along and body in _LIKELY and body != f"-{usual}"
    evidence = {"stated": stated, "floor": _floor_axis(motion, (body, stated, usual)) if "feet" in how else ""}
    evidence["body" if is_likely else "unlikely"] = body
    if rest is not None:
        evidence["rest"] = _body_axis(dataclasses.replace(motion, positions=rest[None]))[0]
    for kind, axis in evidence.items():
        if axis:
            votes[axis] += _WEIGHTS[kind]
    up = max(votes, key=votes.__getitem__)
    if up == body:
        guess = "" if is_likely or stated == up else ": a guess, capture.up= sets it"
        return up, (how if not stated or stated == up else f"{how}, though the file states {stated}") + guess
    reason = {stated: "as the file states", usual: "as usual for such files"}.get(up, "from the floor")
    if body:
        return up, f"{reason}, though the body is along {body}: a guess, capture.up= sets it"
    return up, reason if up == stated else f"{reason}: a guess without head and feet, capture.up= sets it"


def looks_mirrored(motion: PointMotion, facing: dict[str, tuple[str, ...]]) -> bool:
    """Whether the toes of a standing body, z up, point backwards; see `find_facing`."""
    toes, feet = (_mean_of(motion, (part,)) for part in ("toe", "foot"))
    if not facing or toes is None or feet is None or _body_axis(motion)[0] != "z":
        return False
    left = mean_point(motion, facing["left"]) - mean_point(motion, facing["right"])
    forward = np.stack([left[:, 1], -left[:, 0]], axis=1)  # left x up
    along = np.sum(forward * (toes - feet)[:, :2], axis=1)
    length = np.linalg.norm(forward, axis=1) * np.linalg.norm(toes - feet, axis=1)
    cosine = along[length > 0] / length[length > 0]
    return len(cosine) > 0 and bool(np.median(cosine) < _BACKWARDS)


def _body_axis(motion: PointMotion) -> tuple[str, str, bool]:
    """The axis along the body, between which parts, and whether these lie along it; "" where too little was seen."""
    for (high, high_parts), (low, low_parts) in itertools.product(_HIGH.items(), _LOW.items()):
        top, bottom = _mean_of(motion, high_parts), _mean_of(motion, low_parts)
        if top is None or bottom is None:
            continue
        body = (top - bottom)[np.isfinite(top - bottom).all(axis=1)]
        length = np.linalg.norm(body, axis=1, keepdims=True)
        if len(body) and np.all(length > 0):
            mean = (body / length).mean(axis=0)
            axis = int(np.argmax(np.abs(mean)))
            name, is_along = f"{'-' if mean[axis] < 0 else ''}{'xyz'[axis]}", abs(mean[axis]) > _LEANING
            return name, f"from the {low} to the {high}", bool(is_along)
    return "", "", False


def _mean_of(motion: PointMotion, parts: tuple[str, ...]) -> np.ndarray | None:
    """Mean position over time of the points of some parts that were seen at some time; None for none."""
    indices = [i for i, part in enumerate(parts_of(motion.names)) if part and part.part in parts]
    indices = [i for i in indices if np.isfinite(motion.positions[:, i]).any()]
    return motion.positions[:, indices].mean(axis=1) if indices else None


def _floor_axis(motion: PointMotion, likely: tuple[str, ...]) -> str:
    """The axis along which the whole body is just above 0; of several a likely one, or "", as where there is none."""
    indices = [i for i, part in enumerate(parts_of(motion.names)) if part]
    points = motion.positions[:, indices]
    points = points[np.isfinite(points).all(axis=2).sum(axis=1) > 0.5 * len(indices)] if indices else points[:0]
    if not len(points):
        return ""
    size = float(np.median(np.linalg.norm(np.nanmax(points, axis=1) - np.nanmin(points, axis=1), axis=1)))
    minimum, maximum, mean = (size * height for height in _FLOOR)
    found = []
    for up in UPS:
        height = z_up(points, up)[..., 2]
        lowest, middle = np.median(np.nanmin(height, axis=1)), np.median(np.nanmean(height, axis=1))
        if minimum <= lowest <= maximum and middle >= mean:
            found.append(up)
    chosen = [axis for axis in likely if axis in found] or (found if len(found) == 1 else [])
    return chosen[0] if chosen else ""


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
