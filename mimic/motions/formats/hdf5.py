"""Reads joint motions from HDF5 files: robosuite and robomimic, ACT and ALOHA, DROID, and others with such names."""

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

import mujoco
import numpy as np

from mimic.base.distribution import import_extra
from mimic.base.files import check_file, read_text
from mimic.motions.formats.episodes import EXTRA, MAX_NUMBERS, Motion, Recording, follows
from mimic.motions.formats.hdf5_objects import object_poses, skeleton
from mimic.motions.formats.names import Selection, hand_position, is_command, parse_column, select
from mimic.motions.formats.tables import is_time, line_of_rate, seconds, unit_of_time

SUFFIXES = (".hdf5", ".h5")
_EPISODE = re.compile(r"(demo|traj|trajectory|episode|ep|rollout|run)_?\d+", re.IGNORECASE)
_ANGLES = re.compile(r"(.*_)?(qpos|q|joint_?(pos|positions?|states?|angles?|qpos))|gripper_(states?|positions?|width)")
_VELOCITIES = {"qpos": "qvel", "positions": "velocities", "position": "velocity", "pos": "vel"}  # names' ends
STATES, MODEL = "states", "model_file"  # robosuite's: MuJoCo's time, qpos and qvel, and the model that they are of
OTHER_COPIES = "next_obs"  # robomimic's: the observations of the next sample
_RATES = ("control_freq", "fps", "frequency", "hz", "rate")  # attributes; in Hz
_ENVIRONMENTS = ("env_args", "env_info", "env_kwargs")  # attributes with such keys, as JSON
_STEP_CONTROLLERS, ACTIONS = ("OSC", "IK"), "actions"  # robosuite's types of controllers of the hand


class Episode(NamedTuple):
    """An episode: its group, its data sets by their path within it, and the attributes from the file's to its own."""

    group: Any
    sets: dict[str, Any]
    attributes: list[Mapping[str, Any]]


class _Layout(NamedTuple):
    """Columns of qpos and qvel in flattened states by the names of joints, and the model."""

    qpos: dict[str, int]
    qvel: dict[str, int]
    model: mujoco.MjModel


def is_hdf5(path: Path) -> bool:
    """Whether a path is an HDF5 file or a folder with such files."""
    return bool(files_of(path))


def read_hdf5(path: Path, joints: Sequence[str], entry: str = "", rate: float | None = None) -> Recording:
    """The motions of joints, one for each episode. Needs h5py.

    An episode is a group such as `demo_1`, or else a file. A data set of angles is called `joint_pos`, `qpos` or the
    like, and has the joints in their order, perhaps the gripper after them; or it is called `states`, in MuJoCo's order
    of the joints of the episode's model. Times are those of the states, of a data set `time` or `timestamps`, or those
    of the rate that an attribute states.

    Args:
      path: a file, or a folder of files.
      joints: names of the joints, base to tip; or their numbers in the data set, from 1.
      entry: the data set, as its path in an episode; empty for the only one that has the joints.
      rate: samples per second, where the file does not state it.

    Raises:
      ValueError: a file that cannot be read, or that lacks the joints or their times.
    """
    h5py = import_extra("h5py", EXTRA, f"source: {str(path)!r} is an HDF5 file, which")
    motions: dict[str, Motion] = {}
    selection, numbers, files = None, 0, files_of(path)
    for file in files:
        try:
            with h5py.File(check_file(file, None), "r") as content:
                for name, episode in episodes(content):
                    layout = _layout(file, episode)
                    selection = selection or select(str(path), _entries(episode, layout), joints, entry, "data set")
                    if rate and not motions and (name_of_times := _stated_times(episode, layout, rate)):
                        selection.notes.append(line_of_rate(rate, name_of_times))
                    motion = _motion(episode, layout, selection, rate)
                    numbers += motion.qpos.size
                    if numbers > MAX_NUMBERS:
                        raise ValueError(f"expected at most {MAX_NUMBERS:,} numbers")
                    motions[episode_label(file, name, len(files))] = motion
        except RecursionError as error:
            raise ValueError(f"source: {str(file)!r} has too many levels of XML or JSON") from error
        except (OSError, KeyError, RuntimeError, TypeError, ValueError, ElementTree.ParseError) as error:
            line = " ".join(str(error).split())[:400]
            raise ValueError(
                line if line.startswith(("source", "topic")) else f"source: {str(file)!r}: {line}"
            ) from error
    if selection is None:
        raise ValueError(f"source: {str(path)!r} has no data sets of angles")
    return Recording(motions, notes=tuple(selection.notes), **selection.facts)


def episode_label(file: Path, name: str, files: int) -> str:
    """The name of the motion of an episode, of one of some files."""
    return " ".join(filter(None, (file.stem if files > 1 or not name else "", name)))


def files_of(path: Path) -> list[Path]:
    """The HDF5 files that a path names: itself, or those in it."""
    if path.is_dir():
        return sorted(file for file in path.iterdir() if file.suffix.lower() in SUFFIXES)
    return [path] if path.suffix.lower() in SUFFIXES and path.is_file() else []


def episodes(file: Any) -> Iterator[tuple[str, Episode]]:
    """The episodes of a file by name, in the order of their numbers; only data that the file itself holds."""
    sets: dict[str, dict[str, Any]] = {}

    def visit(name: str, item: Any) -> None:  # of what hard links lead to: others might lead out of the file
        if not hasattr(item, "dtype") or item.dtype.kind not in "biuf" or item.ndim not in (1, 2):
            return
        if item.is_virtual or item.external:
            raise ValueError(f"{name} is stored in another file")
        parts = name.split("/")
        depth = next((index + 1 for index, part in enumerate(parts) if _EPISODE.fullmatch(part)), 0)
        if parts[depth] != OTHER_COPIES:
            sets.setdefault("/".join(parts[:depth]), {})["/".join(parts[depth:])] = item

    file.visititems(visit)
    in_episodes = {name: found for name, found in sets.items() if name} or sets
    for name in sorted(in_episodes, key=lambda name: [int(part) for part in re.findall(r"\d+", name)]):
        group = file[name] if name else file
        parents = [
            file,
            *(file["/".join(name.split("/")[: depth + 1])] for depth in range(name.count("/") + 1) if name),
        ]
        yield name.split("/")[-1], Episode(group, in_episodes[name], [parent.attrs for parent in parents])


def _entries(episode: Episode, layout: _Layout | None) -> dict[str, list[str]]:
    """The data sets of angles with the names of their columns: numbers from 1, where nothing names them."""
    numbered = _numbered(episode)
    entries = {name: columns for name, columns in numbered.items() if _ANGLES.fullmatch(name.split("/")[-1])}
    commands = [name for name in numbered if is_command(name) and any(_follows(episode, name, x) for x in entries)]
    return entries | {name: numbered[name] for name in commands} | ({STATES: list(layout.qpos)} if layout else {})


def _follows(episode: Episode, command: str, entry: str) -> bool:
    """Whether a data set of commands has the angles of another one as they were commanded."""
    if episode.sets[command].shape != episode.sets[entry].shape or not len(episode.sets[entry]):
        return False
    return follows(_columns(episode.sets[command]), _columns(episode.sets[entry]))


def _motion(episode: Episode, layout: _Layout | None, selection: Selection, rate: float | None) -> Motion:
    """The motion of an episode."""
    numbered = _numbered(episode)
    for entry in filter(None, (selection.entry, selection.gripper_entry)):
        found = len(numbered.get(entry, ()))
        numbers = selection.joints if entry == selection.entry else selection.gripper
        expected = 1 if entry == STATES and layout else max(map(int, numbers))
        if found < expected:
            raise ValueError(f"{episode.group.name} has {found} columns as {entry}, expected {expected} or more")
    samples = _columns(episode.sets[selection.entry])
    gripper = None
    if selection.entry == STATES and layout:
        qpos = samples[:, [layout.qpos[name] for name in selection.joints]]
        qvel = samples[:, [layout.qvel[name] for name in selection.joints]]
    else:
        qpos = samples[:, [int(name) - 1 for name in selection.joints]]
        of_velocities = velocities_entry(episode, selection.entry)
        samples = _columns(episode.sets[of_velocities]) if of_velocities else None
        qvel = None if samples is None else samples[:, [int(name) - 1 for name in selection.joints]]
    if selection.gripper:
        channels = _columns(episode.sets[selection.gripper_entry])
        at = layout.qpos if selection.gripper_entry == STATES and layout else None
        gripper = channels[:, [at[name] if at else int(name) - 1 for name in selection.gripper]]
    found = hand_position({name: columns for name, columns in numbered.items() if len(episode.sets[name]) == len(qpos)})
    hand = _columns(episode.sets[found[0]])[:, :3] if found else None
    steps, objects = _hand_steps(episode, len(qpos)), None
    if layout and len(episode.sets[STATES]) == len(qpos):  # an arm is before the objects
        joints = selection.joints if selection.entry == STATES else list(layout.qpos)[: qpos.shape[1]]
        numbers = [list(layout.qpos).index(name) for name in joints]
        objects = object_poses(layout.model, _columns(episode.sets[STATES]), numbers)
    return Motion(_times(episode, len(qpos), layout, rate), qpos, qvel, gripper, hand, steps, objects)


def _numbered(episode: Episode) -> dict[str, list[str]]:
    """The data sets with the numbers of their columns, from 1."""
    widths = {name: item.shape[1] if item.ndim == 2 else 1 for name, item in episode.sets.items()}
    return {name: [str(number) for number in range(1, width + 1)] for name, width in widths.items()}


def _hand_steps(episode: Episode, count: int) -> np.ndarray | None:
    """The commanded steps of the hand's position; None where the actions are something else."""
    is_known = step_controller(episode) and ACTIONS in episode.sets and len(episode.sets[ACTIONS]) == count
    return _columns(episode.sets[ACTIONS])[:, :3] if is_known else None


def step_controller(episode: Episode) -> Mapping[str, Any]:
    """The settings of robosuite's controller whose actions are steps of the hand; empty without one."""
    for attributes in episode.attributes:
        for key in _ENVIRONMENTS:
            for settings in _mappings(_json(attributes.get(key))):
                is_delta = settings.get("control_delta") or settings.get("input_type") == "delta"
                if str(settings.get("type")).startswith(_STEP_CONTROLLERS) and is_delta:
                    return settings
    return {}


def _json(value: Any) -> Any:
    """The content of an attribute; None where it is no JSON."""
    try:
        return None if value is None else json.loads(_text(value))
    except ValueError:
        return None


def _mappings(content: Any) -> Iterator[Mapping[str, Any]]:
    """All mappings in a content of JSON."""
    if isinstance(content, Mapping):
        yield content
    inner = content.values() if isinstance(content, Mapping) else content if isinstance(content, list) else ()
    for item in inner:
        yield from _mappings(item)


def _columns(item: Any) -> np.ndarray:
    if item.size > MAX_NUMBERS:
        raise ValueError(f"{item.name} has {item.size:,} numbers, expected at most {MAX_NUMBERS:,}")
    return np.asarray(item[()], float).reshape(len(item), item.shape[1] if item.ndim == 2 else 1)


def velocities_entry(episode: Episode, entry: str) -> str:
    """The data set beside that of the angles that has their velocities; empty for none."""
    names = (entry.removesuffix(end) + other for end, other in _VELOCITIES.items() if entry.endswith(end))
    return next((name for name in names if name in episode.sets), "")


def _times(episode: Episode, count: int, layout: _Layout | None, rate: float | None) -> np.ndarray:
    """The times of samples [s]: what the user states, or the file's."""
    if rate is None and layout:
        states = _columns(episode.sets[STATES])[:, 0]
        if len(states) == count and np.all(np.diff(states) > 0):
            return states
    for name, item in _sets_of_times(episode) if rate is None else ():
        if item.shape in ((count,), (count, 1)):
            return seconds(item.name, _columns(item)[:, 0], unit_of_time(parse_column(name.split("/")[-1])))[0]
    rates = [rate] if rate else [value for attributes in reversed(episode.attributes) for value in _rates(attributes)]
    if not rates:
        raise ValueError("it states no times: no data set time or timestamps; expected rate=, samples per second")
    return np.arange(count) / rates[0]


def _sets_of_times(episode: Episode) -> list[tuple[str, Any]]:
    return [(name, item) for name, item in episode.sets.items() if is_time(parse_column(name.split("/")[-1]))]


def _stated_times(episode: Episode, layout: _Layout | None, rate: float) -> str:
    """What states times other than those of a rate; empty where nothing does."""
    names = [STATES] if layout else [name for name, _ in _sets_of_times(episode)]
    others = {value for attributes in episode.attributes for value in _rates(attributes)} - {rate}
    return names[0] if names else f"the attributes, {max(others):g}" if others else ""


def _rates(attributes: Mapping[str, Any]) -> Iterator[float]:
    """The rates that attributes state, of numbers and of environments in JSON."""
    for key in _RATES:
        if key in attributes and np.size(attributes[key]) == 1 and float(attributes[key]) > 0:
            yield float(attributes[key])
    for key in _ENVIRONMENTS:
        if key in attributes:
            content = json.loads(_text(attributes[key]))
            for settings in (content, content.get("env_kwargs", {})):
                yield from (float(settings[rate]) for rate in _RATES if isinstance(settings.get(rate), int | float))


def _layout(file: Path, episode: Episode) -> _Layout | None:
    """The columns of an episode's states, from its model; None without one."""
    if STATES not in episode.sets or MODEL not in episode.group.attrs:
        return None
    text = _text(episode.group.attrs[MODEL])
    if not text.lstrip().startswith("<"):
        places = [folder / Path(text).name for folder in (file.parent, file.parent / "models")]  # of robosuite 1.0
        text = read_text(next(filter(Path.is_file, places), places[0]))
    model = skeleton(text)
    names = [model.joint(number).name or f"unnamed joint {number + 1}" for number in range(model.njnt)]
    width = 1 + model.nq + model.nv
    if episode.sets[STATES].ndim != 2 or episode.sets[STATES].shape[1] < width:
        raise ValueError(f"states: expected {width} columns for the model, got {list(episode.sets[STATES].shape)}")
    qpos, qvel = (1 + model.jnt_qposadr).tolist(), (1 + model.nq + model.jnt_dofadr).tolist()
    return _Layout(dict(zip(names, qpos, strict=True)), dict(zip(names, qvel, strict=True)), model)


def _text(value: Any) -> str:
    return value.decode() if isinstance(value, bytes) else str(value)
