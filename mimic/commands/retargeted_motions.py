"""The motions of both arms beside a data set that `mimic.retarget` wrote, for videos."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from mimic.arms.embodiment import Embodiment
from mimic.base.npz import read_arrays
from mimic.motions.formats.episodes import Motion

MOTIONS = "certificate.npz"
_ARMS = "expert", "learner"
_NAMES = (
    "base",
    "episodes",
    "time",
    "split_points",
    "objects",
    *(f"{arm}_{what}" for arm in _ARMS for what in ("qpos", "joints")),
)


@dataclasses.dataclass(frozen=True)
class RetargetedMotions:
    """Episodes of an expert and of a learner, one after the other.

    Attributes:
      episodes: their names.
      joints: names of the joints by arm, "expert" and "learner".
      qpos: [samples, joints] angles by arm [rad].
      time: of the samples [s].
      split_points: [episodes + 1] index of the first sample of each, and the number of samples.
      base: of the learner in the expert's base frame, [x, y, z, yaw] [m, rad]; None with hand=scaled.
      objects: [samples, objects, 4, 4] their poses in the expert's base frame; of none where they are not known.
    """

    episodes: tuple[str, ...]
    joints: Mapping[str, tuple[str, ...]]
    qpos: Mapping[str, Float[np.ndarray, "samples joints"]]
    time: Float[np.ndarray, " samples"]
    split_points: np.ndarray
    base: Sequence[float] | None
    objects: Float[np.ndarray, "samples objects 4 4"]

    def of_episode(self, number: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Times of an episode, the angles of expert and learner, and the objects."""
        rows = slice(*self.split_points[number : number + 2])
        return self.time[rows], self.qpos["expert"][rows], self.qpos["learner"][rows], self.objects[rows]


def save_motions(
    folder: Path,
    arms: Sequence[Embodiment],
    measured: Mapping[str, Motion],
    motions: Mapping[str, Motion],
    base: Sequence[float] | None,
) -> None:
    """Writes the motions of the learner into a folder, and those that were measured of the expert.

    Args:
      folder: that exists.
      arms: expert and learner.
      measured: of the expert, by episode [rad].
      motions: of the learner, by episode [rad].
      base: of the learner in the expert's base frame; None where each arm counts from its own base.
    """
    own = [measured[name] for name in motions]
    arrays = {"base": np.array([] if base is None else base, float), "episodes": np.array(list(motions))}
    for name, arm, found in zip(_ARMS, arms, (own, motions.values()), strict=True):
        arrays |= {f"{name}_qpos": np.concatenate([motion.qpos for motion in found])}
        arrays |= {f"{name}_joints": np.array(arm.joint_names)}
    arrays["time"] = np.concatenate([motion.time for motion in own])
    arrays["split_points"] = np.cumsum([0, *(len(motion.time) for motion in own)])
    objects = [motion.objects for motion in own]
    counts = {-1 if poses is None else poses.shape[1] for poses in objects}
    known = -1 not in counts and len(counts) == 1  # and the same in all episodes
    arrays["objects"] = np.concatenate(objects) if known else np.zeros((len(arrays["time"]), 0, 4, 4))  # type: ignore[arg-type]
    np.savez(folder / MOTIONS, **arrays)  # pyright: ignore[reportArgumentType]


def read_motions(folder: Path) -> RetargetedMotions:
    """The motions in a folder.

    Raises:
      ValueError: there are none, or they are damaged.
    """
    path = folder / MOTIONS
    if not path.is_file():
        raise ValueError(f"retargeted: expected a folder that mimic.retarget source=DATA wrote, got no {str(path)!r}")
    try:
        arrays = read_arrays(path, _NAMES)
        joints = {arm: tuple(map(str, arrays[f"{arm}_joints"])) for arm in _ARMS}
        qpos = {arm: np.asarray(arrays[f"{arm}_qpos"], float) for arm in _ARMS}
        episodes, points = tuple(map(str, arrays["episodes"])), np.asarray(arrays["split_points"], int)
        time, base = np.asarray(arrays["time"], float), np.asarray(arrays["base"], float)
        objects = np.asarray(arrays["objects"], float)
        if not _are_motions(joints, qpos, episodes, points, time, base, objects):
            raise ValueError("shapes, times or values that are no motions")
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"retargeted: {str(path)!r} is damaged: {error}") from error
    return RetargetedMotions(episodes, joints, qpos, time, points, base.tolist() or None, objects)


def _are_motions(
    joints: Mapping[str, tuple[str, ...]],
    qpos: Mapping[str, np.ndarray],
    episodes: tuple[str, ...],
    points: np.ndarray,
    time: np.ndarray,
    base: np.ndarray,
    objects: np.ndarray,
) -> bool:
    """Whether shapes fit, values are finite, and times increase within each episode."""
    shapes_fit = all(qpos[arm].shape == (len(time), len(joints[arm])) for arm in _ARMS)
    shapes_fit &= objects.ndim == 4 and objects.shape[::2] == (len(time), 4) and objects.shape[3] == 4
    shapes_fit &= time.ndim == 1 and base.shape in ((4,), (0,)) and points.shape == (len(episodes) + 1,)
    if not shapes_fit or points[0] != 0 or points[-1] != len(time) or (np.diff(points) <= 0).any():
        return False
    ends = points[1:-1] - 1  # from which to the next there is another episode
    steps = np.delete(np.diff(time), ends)
    return all(np.isfinite(array).all() for array in (*qpos.values(), time, base, objects)) and bool((steps > 0).all())
