"""Writes HDF5 files of demonstrations again for another arm; all other data sets and attributes stay as they are."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from mimic.base.files import copy_file
from mimic.motions.formats.episodes import TORQUE, Motion
from mimic.motions.formats.hdf5 import (
    ACTIONS,
    MODEL,
    OTHER_COPIES,
    STATES,
    episode_label,
    episodes,
    files_of,
    step_controller,
    velocities_entry,
)
from mimic.motions.formats.names import is_command, quantity_of
from mimic.motions.formats.replacing import Replacement, replaced_columns, replaced_values

# robomimic's names, in place of states
_ANGLES, _VELOCITIES, _GRIPPER = "obs/robot0_joint_pos", "obs/robot0_joint_vel", "obs/robot0_gripper_qpos"
_SOURCE = "source"  # group that keeps the states of the expert's simulation
_FUNCTIONS = {"_cos": np.cos, "_sin": np.sin}  # ends of names of data sets with these of the angles


def rewrite_hdf5(source: Path, out: Path, replacement: Replacement) -> list[str]:
    """Writes the files into an empty folder, under their names; returns what has moved, and torques that are left out.

    Flattened states of a simulation belong to the expert's model: they are kept in the group `source` of the episode,
    and the learner's angles and velocities stand in `obs/robot0_joint_pos` and `obs/robot0_joint_vel`.
    """
    import h5py

    lines: dict[str, None] = {}
    files = files_of(source)
    for file in files:
        path = out / file.name
        copy_file(file, path)
        path.chmod(0o644)
        with h5py.File(path, "r+") as content:
            removed = set()
            for name, episode in list(episodes(content)):
                label = episode_label(file, name, len(files))
                if label in replacement.kept:
                    lines |= dict.fromkeys(_replace(episode, label, replacement))
                elif name:
                    removed.add(name)
                    del content[episode.group.name]
            _update_masks(content, removed)
            is_empty = not any(True for _ in episodes(content))
        if is_empty or (len(files) > 1 and not any(label.startswith(file.stem) for label in replacement.kept)):
            path.unlink()
    return list(lines)


def _replace(episode: Any, label: str, replacement: Replacement) -> Iterator[str]:
    """Replaces the data sets of an episode."""
    if ACTIONS in episode.sets and (controller := step_controller(episode)):
        yield _turn_steps(episode.group, controller, replacement.yaw)
    elif unknown := [name for name in episode.sets if is_command(name) and name not in replacement.old_joints]:
        yield f"as in the source, since nothing tells what they command: {', '.join(unknown)}"
    count = min(map(len, replacement.old_joints.values()))
    for name, item in list(episode.sets.items()):
        if quantity_of(name.split("/")[-1]) == TORQUE and item.ndim == 2 and item.shape[1] >= count:
            del episode.group[name]
            yield name
    for entry, old_joints in replacement.old_joints.items():
        motion = replacement.motions[entry][label]
        if entry == STATES and MODEL in episode.group.attrs:
            yield _move_states(episode.group)
            _set(episode.group, _ANGLES, motion.qpos)
            _set(episode.group, _VELOCITIES, np.asarray(motion.qvel))
            _set(episode.group, "time", np.asarray(motion.time))
            if motion.gripper is not None:
                _set(episode.group, _GRIPPER, motion.gripper)
            continue
        _replace_set(episode.group, entry, old_joints, replacement, motion)
        of_gripper, gripper = replacement.grippers.get(entry, ("", ()))
        if of_gripper and of_gripper != entry:
            _set(episode.group, of_gripper, np.reshape(motion.gripper, episode.group[of_gripper].shape))  # type: ignore[arg-type]
        if other := velocities_entry(episode, entry):
            _replace_set(episode.group, other, old_joints, replacement, motion._replace(qpos=motion.qvel))
        for end, function in _FUNCTIONS.items():
            if f"{entry}{end}" in episode.sets:
                turned = motion._replace(qpos=function(motion.qpos))
                _replace_set(episode.group, f"{entry}{end}", old_joints, replacement, turned)
        folder, _, leaf = entry.rpartition("/")
        if (copy := f"{OTHER_COPIES}/{leaf}") in episode.group and folder:
            after = np.minimum(np.arange(1, len(motion.time) + 1), len(motion.time) - 1)
            _replace_set(episode.group, copy, old_joints, replacement, motion.take(after))
            yield f"{copy}: the last one is that of {entry}, since no later one is known"


def _turn_steps(group: Any, controller: Mapping[str, Any], yaw: float) -> str:
    """Turns the commanded steps of the hand into the axes of the learner's base, where a controller has those."""
    if controller.get("input_ref_frame", "world") != "base" or not yaw:
        return f"{ACTIONS}: steps of the expert's hand, as in the source; with hand=exact the learner's are the same"
    steps, (cosine, sine) = np.array(group[ACTIONS]), (np.cos(yaw), np.sin(yaw))
    width = 6 if "POSE" in controller["type"] else 3
    for first in range(0, min(width, steps.shape[1]), 3):  # of the position, and of the rotation
        x, y = steps[:, first].copy(), steps[:, first + 1].copy()
        steps[:, first], steps[:, first + 1] = cosine * x + sine * y, cosine * y - sine * x
    _set(group, ACTIONS, steps)
    return f"{ACTIONS}: steps of the hand, in the axes of the learner's base"


def _replace_set(group: Any, entry: str, old: tuple[str, ...], replacement: Replacement, motion: Motion) -> None:
    """Replaces the columns of the joints in a data set, which are numbered from 1."""
    values = group[entry][()]
    table = values.reshape(len(values), -1)
    names = [str(number) for number in range(1, table.shape[1] + 1)]
    of_gripper, gripper = replacement.grippers.get(entry, ("", ()))
    columns, _ = replaced_columns(names, old, replacement.joints, gripper if of_gripper == entry else ())
    _set(group, entry, replaced_values(table, columns, motion))


def _set(group: Any, entry: str, values: np.ndarray) -> None:
    """Writes a data set with the attributes and the compression of the one that it replaces."""
    old = group.get(entry)
    attributes, compression = ({}, None) if old is None else (dict(old.attrs), old.compression)
    if old is not None:
        del group[entry]
    new = group.create_dataset(entry, data=values, compression=compression)
    new.attrs.update(attributes)


def _move_states(group: Any) -> str:
    """Moves the states of the expert's simulation, and the name of its model, to a group of their own."""
    if STATES in group:
        kept = group.require_group(_SOURCE)
        group.move(STATES, f"{_SOURCE}/{STATES}")
        kept.attrs[MODEL] = group.attrs[MODEL]
        del group.attrs[MODEL]
    return (
        f"states: those of the expert's simulation, kept as {_SOURCE}/{STATES}; the learner's joints are {_ANGLES} and "
        f"{_VELOCITIES}"
    )


def _update_masks(content: Any, removed: set[str]) -> None:
    """Removes episodes from the lists of robomimic's filter keys, and from the total of samples."""
    for mask in (content.get("mask") or {}).values():
        names = [name for name in mask[()] if (name.decode() if isinstance(name, bytes) else str(name)) not in removed]
        parent, leaf, kind = mask.parent, mask.name.rpartition("/")[2], mask.dtype
        del parent[leaf]
        parent.create_dataset(leaf, data=np.array(names, kind))
    data = content.get("data")
    if removed and data is not None and "total" in data.attrs:
        counts = [group.attrs["num_samples"] for group in data.values() if "num_samples" in group.attrs]
        data.attrs["total"] = type(data.attrs["total"])(sum(counts))
