"""Reads a data set of one arm whole, and writes it again with another arm's motions in place of the first one's."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from mimic.arms.embodiment import Embodiment
from mimic.motions.cleaning import Notes, beyond_range, cleaned
from mimic.motions.demonstrations import Demonstrations, is_demonstrations, load_demonstrations
from mimic.motions.doubts import doubts
from mimic.motions.formats.episodes import Motion, Recording, follows
from mimic.motions.formats.hdf5 import is_hdf5
from mimic.motions.formats.hdf5_rewriting import rewrite_hdf5
from mimic.motions.formats.lerobot_reading import is_lerobot
from mimic.motions.formats.lerobot_rewriting import rewrite_lerobot
from mimic.motions.formats.names import numbers_joints
from mimic.motions.formats.replacing import Replacement
from mimic.motions.formats.table_rewriting import rewrite_archive, rewrite_folder_of_tables, rewrite_table
from mimic.motions.formats.tables import TABLES, is_folder_of_tables
from mimic.motions.importing import check_named, read_source, source_names
from mimic.motions.units import find_unit, from_rad, in_rad


@dataclasses.dataclass(frozen=True)
class DataSet:
    """A data set of an arm, sample by sample.

    Attributes:
      path: of the source.
      entry: what has the measured angles.
      motions: by entry and episode: of the arm as measured, and as commanded [rad].
      joints: the source's names of the arm's joints, by entry.
      faults: why an episode cannot be retargeted, by its name.
      grippers: the entry and the names of the gripper's channels, by entry of the joints; none without a gripper.
      unit: of the source's angles.
      timed: whether the source has times.
      notes: what was assumed.
    """

    path: Path
    entry: str
    motions: Mapping[str, Mapping[str, Motion]]
    joints: Mapping[str, tuple[str, ...]]
    faults: Mapping[str, str]
    grippers: Mapping[str, tuple[str, tuple[str, ...]]]
    unit: str
    timed: bool
    notes: tuple[str, ...]

    @property
    def measured(self) -> Mapping[str, Motion]:
        """The motions of the arm as measured, by episode."""
        return self.motions[self.entry]

    @property
    def gripper(self) -> tuple[str, ...]:
        """Names of the gripper's channels as measured."""
        return self.grippers.get(self.entry, ("", ()))[1]

    @property
    def commands(self) -> tuple[str, ...]:
        """The entries with what was commanded."""
        return tuple(entry for entry in self.motions if entry != self.entry)


def read_data_set(
    path: Path,
    arm: Embodiment,
    *,
    joints: Sequence[str] = (),
    topic: str = "",
    units: str = "",
    rate: float | None = None,
    joint_range: Float[np.ndarray, "joints 2"] | None = None,
) -> DataSet:
    """Reads the motions of an arm with all their samples; see `read_recording` for the arguments.

    An episode that would have to be repaired, such as one in which a joint jumps, has a fault. Angles beyond the
    arm's own range are noted alone, since zeros of real arms are not quite those of their models. A file of
    demonstrations is read as it is.

    Raises:
      ValueError: what `read_recording` rejects; all episodes have faults; demonstrations of another arm.
    """
    names = source_names(arm, joints)
    ranges = np.asarray(arm.joint_range if joint_range is None else joint_range, float)
    if is_demonstrations(path):
        if joints or topic or units or rate:
            raise ValueError("joints, topic, units, rate: expected none with a file of demonstrations, which has them")
        return _demonstrations(path, arm)
    recording = read_source(path, names, topic, rate)
    check_named(recording, joints)
    unit, line = find_unit(str(path), recording, arm.joint_names, ranges, units)
    entry = recording.entry
    commands = {name: read_source(path, names, name, rate) for name in recording.commanded}
    others = [
        name for name, found in commands.items() if numbers_joints(found.joints) and not _follow(found, recording)
    ]
    recordings = {entry: recording} | {name: found for name, found in commands.items() if name not in others}
    joint_names = {name: found.joints for name, found in recordings.items()}
    motions, faults = _whole(in_rad(recording, unit, ranges), arm)
    if not motions:
        raise ValueError(next(iter(faults.values())))
    every = {entry: motions}
    for name in [name for name in recordings if name != entry]:
        found = in_rad(recordings[name], unit, ranges).motions
        every[name] = {episode: _near(found[episode], motion) for episode, motion in motions.items()}
    stated = in_rad(recording, unit, ranges).motions  # with velocities that `cleaned` drops
    raw = {name: stated[name]._replace(qpos=motion.qpos) for name, motion in motions.items()}
    suspicious = [
        beyond_range(motions, arm.joint_names, ranges),
        *doubts(arm, raw, {name: found for name, found in every.items() if name != entry}, recording.joints),
        *(f"{name}: as in the source, since its numbers are not near the measured angles" for name in others),
    ]
    notes = tuple(filter(None, (*recording.notes, line, *suspicious)))
    grippers = {name: (found.gripper_entry, found.gripper) for name, found in recordings.items() if found.gripper}
    return DataSet(path, entry, every, joint_names, faults, grippers, unit, rate is None, notes)


def _demonstrations(path: Path, arm: Embodiment) -> DataSet:
    """Demonstrations as a data set, one episode each."""
    found = load_demonstrations(path)
    found.check_fits(arm, found.dt, found.horizon)
    time, grippers = found.dt * np.arange(found.horizon + 1), [None] * found.count
    if found.gripper is not None:
        grippers = list(found.gripper)
    columns = zip(found.qpos, found.qvel, grippers, strict=True)
    motions = {f"motion {number}": Motion(time, *column) for number, column in enumerate(columns)}
    channels = {"qpos": ("qpos", found.gripper_names)} if found.gripper_names else {}
    return DataSet(path, "qpos", {"qpos": motions}, {"qpos": arm.joint_names}, {}, channels, "rad", True, ())


def _whole(recording: Recording, arm: Embodiment) -> tuple[dict[str, Motion], dict[str, str]]:
    """The motions that need no repair, with angles within the range, and what is wrong with the others."""
    motions, faults, ranges = {}, {}, np.asarray(arm.joint_range, float)
    for name, motion in recording.motions.items():
        notes = Notes()
        try:
            parts = list(cleaned(name, motion, arm.joint_names, ranges, notes).values())
        except ValueError as error:
            faults[name] = str(error).removeprefix("source: ")
            continue
        if len(parts) == 1 and np.array_equal(parts[0].time, motion.time):
            motions[name] = parts[0]
        else:
            faults[name] = "; ".join(notes.lines())
    return motions, faults


def _follow(commands: Recording, measured: Recording) -> bool:
    """Whether commands may be the angles as they were commanded, see `follows`."""
    found = [np.concatenate([motion.qpos for motion in x.motions.values()]) for x in (commands, measured)]
    return found[0].shape == found[1].shape and follows(*found)


def _near(command: Motion, motion: Motion) -> Motion:
    """The commanded angles without full turns to the measured ones."""
    difference = command.qpos - motion.qpos
    qpos = command.qpos - 2 * np.pi * np.round(difference / (2 * np.pi))
    return motion._replace(qpos=qpos, gripper=command.gripper)


def write_data_set(
    data: DataSet,
    out: Path,
    learner: Embodiment,
    motions: Mapping[str, Mapping[str, Motion]],
    kept: Sequence[str],
    joint_range: Float[np.ndarray, "joints 2"],
    yaw: float = 0.0,
) -> list[str]:
    """Writes the data set into an empty folder with the learner's motions, in the format and the unit of the source.

    Args:
      data: the data set of the expert.
      out: the folder.
      learner: whose names stand in the data set.
      motions: the learner's by entry and episode [rad], with as many samples as the expert's.
      kept: the episodes to write.
      joint_range: of the learner [rad], for units=percent.
      yaw: of its base in that of the expert [rad], for commanded steps of the hand.

    Returns:
      Lines about what is left out or has another place.
    """
    chosen = [motions[data.entry][name] for name in kept]
    if is_demonstrations(data.path):
        _write_demonstrations(out / data.path.name, data, learner, chosen)
        return []
    in_unit = {
        entry: {name: from_rad(motion, data.unit, joint_range) for name, motion in found.items()}
        for entry, found in motions.items()
    }
    grippers = {
        entry: gripper for entry, gripper in data.grippers.items()
        if any(motions[entry][name].gripper is not data.motions[entry][name].gripper for name in kept)
    }  # fmt: skip
    replacement = Replacement(learner.name, learner.joint_names, data.joints, in_unit, list(kept), grippers, yaw)
    if write := _writer(data):
        lines = write(data.path, out, replacement)
        names = ", ".join(line for line in lines if ":" not in line)
        left_out = [f"left out, as not known of {learner.name}: {names}"] if names else []
        return [*(line for line in lines if ":" in line), *left_out]
    arrays = {"joint_names": np.array(learner.joint_names)}
    arrays["qpos"] = np.concatenate([motion.qpos for motion in chosen])
    arrays["qvel"] = np.concatenate([motion.qvel for motion in chosen])  # type: ignore[misc]
    arrays["split_points"] = np.cumsum([0, *(len(motion.time) for motion in chosen)])
    arrays["dt"] = np.array(np.median(np.concatenate([np.diff(motion.time) for motion in chosen])))
    for entry in data.commands:
        arrays[f"command_{entry.strip('/').replace('/', '_')}"] = np.concatenate(
            [motions[entry][name].qpos for name in kept]
        )
    if data.gripper:
        arrays["gripper"] = np.concatenate([motion.gripper for motion in chosen])  # type: ignore[misc]
        arrays["gripper_names"] = np.array(data.gripper)
    np.savez_compressed(out / "motions.npz", **arrays)  # pyright: ignore[reportArgumentType]
    return [
        "format: mimic does not write this one again; the motions are in motions.npz, in rad and without other columns"
    ]


def _write_demonstrations(path: Path, data: DataSet, learner: Embodiment, motions: Sequence[Motion]) -> None:
    """Writes motions as demonstrations of the learner."""
    qpos, qvel = (np.stack([getattr(motion, field) for motion in motions]) for field in ("qpos", "qvel"))
    gripper = np.stack([motion.gripper for motion in motions]) if data.gripper else None  # type: ignore[arg-type]
    dt = float(motions[0].time[1])
    Demonstrations(
        qpos, qvel, qpos[:, -1], dt, learner.name, learner.joint_names, gripper=gripper, gripper_names=data.gripper
    ).save(path)


def _writer(data: DataSet) -> Callable[[Path, Path, Replacement], list[str]] | None:
    """What writes the format of a source; None where nothing does."""
    path = data.path
    if is_lerobot(path):
        return rewrite_lerobot
    if is_hdf5(path):
        return rewrite_hdf5
    if is_folder_of_tables(path):
        return rewrite_folder_of_tables
    if path.name.lower().endswith(TABLES):
        return lambda source, out, replacement: rewrite_table(source, out, replacement, data.timed)
    return rewrite_archive if path.suffix.lower() == ".npz" else None
