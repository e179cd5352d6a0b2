"""Reads joint motions from npz files in LocoMuJoCo's format."""

import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mimic.base.npz import read_arrays
from mimic.motions.demonstrations import MAX_VALUE
from mimic.motions.formats.episodes import Motion, Recording
from mimic.motions.formats.names import select

_SIZES = {0: (7, 6), 2: (1, 1), 3: (1, 1)}  # columns of qpos and qvel by MuJoCo's joint type: free, slide, revolute
_HANDS = "eef_pos", "ee_pos", "tcp_pos", "hand_pos"  # arrays of positions of the hand
_NUMBERS = "biuf"  # kinds of NumPy's types
_FORMS = {  # of the arrays of an npz file: kinds of their types, and their numbers of dimensions
    "qpos": (_NUMBERS, (2,)), "qvel": (_NUMBERS, (2,)), "joint_names": ("U", (0, 1)), "frequency": (_NUMBERS, (0, 1)),
    "dt": (_NUMBERS, (0, 1)), "jnt_type": (_NUMBERS, (1,)), "split_points": (_NUMBERS, (0, 1)),
}  # fmt: skip


def read_archive(path: Path, joints: Sequence[str]) -> Recording:
    """The motions of joints, one for each part between split points.

    Raises:
      ValueError: no npz file, or one that lacks the joints or has arrays of a wrong form.
    """
    content = _npz_content(path)
    qpos, qvel = content["qpos"], content.get("qvel")
    present = list(map(str, np.atleast_1d(content["joint_names"])))
    selection = select(str(path), {"qpos": present}, joints, "", "array")
    angle_at, velocity_at = addresses(content.get("jnt_type"), present)
    for key, values, width in (("qpos", qpos, angle_at[-1]), ("qvel", qvel, velocity_at[-1])):
        if values is not None and values.shape != (len(qpos), width):
            expected = [len(qpos), int(width)]
            raise ValueError(
                f"source: {key} in {str(path)!r} must be {expected} for its joints, got {list(values.shape)}"
            )
    rate = content["dt"] if "dt" in content else content["frequency"]
    if rate.size != 1 or not 1 / MAX_VALUE <= float(rate.item()) <= MAX_VALUE:
        raise ValueError(
            f"source: frequency or dt in {str(path)!r} must be in [{1 / MAX_VALUE}, {MAX_VALUE}], got {rate}"
        )
    step = float(rate.item()) if "dt" in content else 1 / float(rate.item())
    indices, gripper_at = ([present.index(name) for name in names] for names in (selection.joints, selection.gripper))
    columns, notes = np.asarray(qpos, float), list(selection.notes)
    hand = _hand(content, len(qpos), notes)
    motion = Motion(
        step * np.arange(len(qpos)),
        columns[:, angle_at[indices]],
        None if qvel is None else np.asarray(qvel, float)[:, velocity_at[indices]],
        columns[:, angle_at[gripper_at]] if gripper_at else None,
        hand,
    )
    points = np.atleast_1d(content.get("split_points", (0, len(qpos))))
    bounds = [int(point) if np.isfinite(point) else -1 for point in points[: len(qpos) + 2]]
    if len(bounds) < 2 or bounds[0] != 0 or bounds[-1] != len(qpos) or np.any(np.diff(bounds) <= 0):
        raise ValueError(
            f"source: split_points in {str(path)!r} must increase from 0 to {len(qpos)}, the samples, got {bounds[:8]}"
        )
    motions = {
        f"motion {number}": motion.take(slice(start, end))
        for number, (start, end) in enumerate(itertools.pairwise(bounds))
    }
    return Recording(motions, notes=tuple(notes), **selection.facts)


def _hand(content: dict[str, Any], samples: int, notes: list[str]) -> np.ndarray | None:
    """Positions [samples, 3] of the hand; None without them. A note says which arrays are none of a single hand."""
    for key in filter(content.__contains__, _HANDS):
        array = content[key]
        if array.dtype.kind in _NUMBERS and array.shape in ((samples, 3), (samples, 7)):  # or poses
            return np.asarray(array, float)[:, :3]
        notes.append(f"{key}: expected numbers [{samples}, 3], got {array.dtype} {list(array.shape)}: not used")
    return None


def _npz_content(path: Path) -> dict[str, Any]:
    try:
        content: dict[str, Any] = dict(
            read_arrays(path, (*_FORMS, *_HANDS))
        )  # not pickled ones, as LocoMuJoCo's metadata
    except ValueError as error:
        raise ValueError(f"source: {str(path)!r} cannot be read as an npz file of motions: {error}") from error
    lacking = [key for key in ("qpos", "joint_names") if key not in content]
    if not {"frequency", "dt"} & set(content):
        lacking.append("frequency")
    if lacking:
        raise ValueError(
            f"source: {str(path)!r} lacks {', '.join(lacking)}; expected qpos, joint_names, frequency or dt, and "
            "optionally qvel, jnt_type, split_points"
        )
    for key, (kinds, dimensions) in _FORMS.items():
        if (array := content.get(key)) is None:
            continue
        if array.dtype.kind not in kinds or array.ndim not in dimensions:
            raise ValueError(
                f"source: {key} in {str(path)!r} has type {array.dtype} and shape {list(array.shape)}; "
                f"expected {'text' if kinds == 'U' else 'numbers'} of {' or '.join(map(str, dimensions))} dimensions"
            )
    return content


def addresses(types: np.ndarray | None, names: Sequence[str]) -> tuple[np.ndarray, np.ndarray]:
    """First column of each joint in qpos and in qvel; the last entry is the number of columns."""
    kinds = [3] * len(names) if types is None else [int(kind) for kind in types[: len(names) + 1]]
    if len(kinds) != len(names) or any(kind not in _SIZES for kind in kinds):
        raise ValueError(f"source: jnt_type: expected 0, 2 or 3 for each of {', '.join(names)}, got {kinds}")
    sizes = np.array([_SIZES[kind] for kind in kinds])
    angle_at, velocity_at = np.concatenate([[[0, 0]], np.cumsum(sizes, axis=0)]).T
    return angle_at, velocity_at
