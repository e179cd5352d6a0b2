"""Names of columns and joints in files of others: what a column holds, and which columns belong to an arm."""

import os
import re
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from mimic.motions.formats.episodes import ANGLE, TORQUE, VELOCITY, Quantity

QUANTITIES = {  # words before or after the name of a joint
    **dict.fromkeys(("q", "qpos", "pos", "position", "positions", "angle"), ANGLE),
    **dict.fromkeys(("dq", "qd", "qdot", "qvel", "vel", "velocity", "velocities", "speed"), VELOCITY),
    **dict.fromkeys(("tau", "torque", "torques", "effort", "current"), TORQUE),
}
_NEVER_AFTER = ("q", "angle")  # `wrist_angle` is the name of a joint
UNITS = {
    **dict.fromkeys(("rad", "radian", "radians", "rad/s"), "rad"),
    **dict.fromkeys(("deg", "degree", "degrees", "deg/s", "°", "°/s"), "deg"),
    **dict.fromkeys(("percent", "%"), "percent"),
}
UNSEEN = {"", "-", "--", "null", "none", "na", "n/a", "missing"}  # cells without a number, in lower case
SECONDS = {"": 1.0, "s": 1.0, "sec": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9}
_BRACKETS = re.compile(r"(.+?)\s*[\[(](.+?)[\])]")
_LAST, _FIRST = re.compile(r"(.+)[./_ ]([^./_ ]+)"), re.compile(r"([a-z]+)[./_ ]?(.+)", re.IGNORECASE)
_LEAF = re.compile(r"(|.*[./])([^./]+)")
_NUMBERED = re.compile(r"([a-z]+)[./_ ]([a-z]+)[./_ ]?(\d+)", re.IGNORECASE)
# Before a quantity's word.
_WHOSE = (
    "actual",
    "measured",
    "target",
    "desired",
    "commanded",
    "command",
    "joint",
    "robot",
    "state",
    "observation",
    "field",
)
# Words beside the name of a joint in a column with other values of it.
_COPIES = {
    *_WHOSE,
    "d",
    "des",
    "ref",
    "reference",
    "cmd",
    "goal",
    "setpoint",
    "action",
    "leader",
    "follower",
    "master",
    "raw",
}
_COUNTED = re.compile(rf"((?:{'|'.join(_WHOSE)}|motor|servo|axis|dof|[ajq])*)(\d+)")
_ENDING = re.compile("(?:joint|angle)$")  # of a joint's key, which the other side may lack
_BY_ORDER = "by their order"
_GRIPPER = re.compile(r"gripper|finger|jaw|knuckle", re.IGNORECASE)

_HAND = re.compile(
    r"(?:.*[._/ ])?(?:eef|ee|tcp|hand|end_?effector|cartesian)(?:[._/ ]?(?:pos|position|positions|pose|state|xyz))?",
    re.I,
)
_HAND_JOINTS = re.compile(r"(?:.*[._/ ])?hand(?:[._/ ]?state)?", re.IGNORECASE)  # what numbered columns may be
_PLACES = re.compile(r"(.*?)[._/ ]?([xyz]|[0-3])", re.IGNORECASE)  # of a hand: their names and axes


class Column(NamedTuple):
    """What a column holds.

    Attributes:
      joint: name of the joint.
      quantity: what its numbers are.
      unit: a value of `UNITS` or a key of `SECONDS`; empty where the name states none.
    """

    joint: str
    quantity: Quantity
    unit: str


class Selection(NamedTuple):
    """The columns of an arm in a source.

    Attributes:
      entry: the topic, feature or data set that has them.
      joints: the source's names of the joints, base to tip.
      gripper: those of the gripper's joints or opening.
      gripper_entry: the entry that has these; empty without a gripper.
      notes: what was assumed to find them.
      commanded: other entries that have the joints, as they were commanded; of several none where the user names the
        entry.
    """

    entry: str
    joints: list[str]
    gripper: list[str]
    gripper_entry: str
    notes: list[str]
    commanded: list[str]

    @property
    def facts(self) -> dict[str, Any]:
        """What a `Recording` says about its columns."""
        return {"gripper": tuple(self.gripper), "entry": self.entry, "joints": tuple(self.joints),
                "commanded": tuple(self.commanded), "gripper_entry": self.gripper_entry}  # fmt: skip


def parse_column(text: str) -> Column:
    """Splits a column's name: `joint1.pos`, `qdot_joint1`, `q[0]`, `actual_q_0`, `elbow [deg]`, `/arm/elbow/speed`."""
    name, unit = text.strip(), ""
    if match := _BRACKETS.fullmatch(name):
        stated = match[2].strip().lower().rstrip(".")
        name, unit = (f"{match[1]}_{stated}", "") if stated.isdigit() else (match[1], UNITS.get(stated, stated))
    if not unit and (match := _LAST.fullmatch(name)) and match[2].lower() in UNITS:
        name, unit = match[1], UNITS[match[2].lower()]
    if (match := _LAST.fullmatch(name)) and match[2].lower() in QUANTITIES and match[2].lower() not in _NEVER_AFTER:
        return Column(match[1], QUANTITIES[match[2].lower()], unit)
    if (match := _FIRST.fullmatch(name)) and match[1].lower() in QUANTITIES:
        return Column(match[2], QUANTITIES[match[1].lower()], unit)
    if (match := _NUMBERED.fullmatch(name)) and match[1].lower() in _WHOSE and match[2].lower() in QUANTITIES:
        return Column(f"{match[1]} {match[3]}", QUANTITIES[match[2].lower()], unit)
    return Column(name, ANGLE, unit)


def quantity_of(entry: str) -> Quantity:
    """What an entry has, by its name: angles where this tells nothing else."""
    words = set(re.split(r"[^a-z]+", entry.lower())) - {"current"}  # also the present one
    found = {QUANTITIES[word] for word in words if word in QUANTITIES}
    return found.pop() if len(found) == 1 else ANGLE


def common_unit(path: str, units: Mapping[str, str]) -> str:
    """The unit of the angles of joints, from those that their columns state; empty where none does.

    Raises:
      ValueError: several units, or one that is not known.
    """
    stated = {unit: joint for joint, unit in units.items() if unit}
    if len(stated) > 1 or set(stated) - set(UNITS.values()):
        found = ", ".join(f"{joint} in {unit!r:.40}" for unit, joint in stated.items())
        raise ValueError(f"source: {path!r} has {found}; expected all angles in rad, in deg, or in percent")
    return next(iter(stated), "")


def find_joints(present: Sequence[str], joints: Sequence[str]) -> tuple[list[str], str] | None:
    """The names in a source that belong to joints of an arm, base to tip, and the rule that found them.

    The names are equal; or equal but for case and separators (`joint_1`, `Joint1`); or the source's have one prefix
    (`panda_joint1`), or the arm's; or one of both ends them in `joint` or `angle` (`elbow_joint`); or the source counts
    the joints from 0 or 1. None where no rule finds all, or where several prefixes fit, as in a source with two arms.
    """
    if set(joints) <= set(present):
        return list(joints), ""
    by_key = {_key(name): name for name in present}
    if len(by_key) < len(present):
        return None
    keys = [_key(joint) for joint in joints]
    prefixes = [key.removesuffix(keys[0]) for key in by_key if key.endswith(keys[0])]
    fitting = [prefix for prefix in prefixes if all(prefix + key in by_key for key in keys)]
    fitting = [prefix for prefix in fitting if not is_command(prefix)] or fitting
    if "" in fitting or len(fitting) == 1:
        prefix = "" if "" in fitting else fitting[0]
        return [by_key[prefix + key] for key in keys], "by name"
    if fitting:
        return None
    by_short = {_ENDING.sub("", key): name for key, name in by_key.items()}
    short = [_ENDING.sub("", key) for key in keys]
    if "" not in short and set(short) <= set(by_short) and len(by_short) == len(by_key):
        return [by_short[key] for key in short], "by name"
    counted = _counted(by_key, len(joints))
    measured = [prefix for prefix in counted if not is_command(prefix)] or list(counted)
    if measured:
        return (counted[measured[0]], _BY_ORDER) if len(measured) == 1 else None
    shared = next((n for n, letters in enumerate(zip(*keys, strict=False)) if len(set(letters)) > 1), 0)
    for cut in range(1, shared + 1):
        if all(key[cut:] in by_key for key in keys):
            return [by_key[key[cut:]] for key in keys], "by name"
    return None


def is_by_order(present: Sequence[str], joints: Sequence[str]) -> bool:
    """Whether names in a source belong to joints by their order alone, see `find_joints`."""
    found = find_joints(present, joints)
    return found is not None and found[1] == _BY_ORDER


def _counted(by_key: Mapping[str, str], count: int) -> dict[str, list[str]]:
    """Names that number joints from 0 or 1, by what is before the number: as many as an arm has, or more if bare."""
    groups: dict[str, dict[int, str]] = {}
    for key, name in by_key.items():
        if match := _COUNTED.fullmatch(key):
            groups.setdefault(match[1], {})[int(match[2])] = name
    fitting = {prefix: names for prefix, names in groups.items() if len(names) == count or not prefix}
    numbers = {prefix: range(min(names), min(names) + count) for prefix, names in fitting.items()}
    return {
        prefix: [names[number] for number in numbers[prefix]]
        for prefix, names in fitting.items() if min(names) < 2 and set(numbers[prefix]) <= set(names)
    }  # fmt: skip


def numbers_joints(names: Sequence[str]) -> bool:
    """Whether a source numbers joints, rather than naming them: `1`, `actual 0`, but not `joint1`."""
    bare = [_COUNTED.fullmatch(_key(name)) for name in names]
    return all(match and (not match[1] or match[1] in _WHOSE) for match in bare) and not any(
        _key(name).startswith("joint") for name in names
    )


def select(path: str, entries: Mapping[str, Sequence[str]], joints: Sequence[str], entry: str, kind: str) -> Selection:
    """Finds the columns of an arm: in the entry that is named, or in the only one that has all joints.

    Measured angles go before commanded ones, which are those of an entry whose name says so.

    Args:
      path: of the source, for messages.
      entries: names of the joints of each entry.
      joints: names of the joints that are needed.
      entry: name of the entry; empty for the only one.
      kind: what an entry is called, for messages.

    Raises:
      ValueError: no entry has all joints, several have, or the named one has not.
    """
    listed = "; ".join(f"{name} ({', '.join(names)})" for name, names in entries.items()) or "none"
    if entry and entry not in entries:
        raise ValueError(f"topic: expected a {kind} of {path!r} with joint angles: {listed}; got {entry!r}")
    considered = [entry] if entry else list(entries)
    found = {name: rule for name in considered if (rule := find_joints(entries[name], joints))}
    if not found:
        raise ValueError(
            f"source: {path!r} has no {kind} with the joints {', '.join(joints)}; its joint angles: {listed}; "
            "joints=[...] names the arm's joints among these"
        )
    notes = []
    if 0 < len(named := [name for name in found if found[name][1] != _BY_ORDER]) < len(found):
        found = {name: found[name] for name in named}
    if 0 < len(joint_angles := [name for name in found if not _HAND.fullmatch(name)]) < len(found):
        found = {name: found[name] for name in joint_angles}
    if len(found) > 1 and len(measured := [name for name in found if not is_command(name)]) == 1:
        others = [name for name in found if name not in measured]
        notes.append(f"{measured[0]}: what was measured; topic={' or topic='.join(others)} is what was commanded")
        found = {measured[0]: found[measured[0]]}
    if len(found) > 1:
        raise ValueError(
            f"source: {path!r} has the joints {', '.join(joints)} in several {kind}s; "
            f"expected one, as topic={' or topic='.join(found)}"
        )
    ((name, (columns, rule)),) = found.items()
    if is_command(name) and not entry:
        notes.append(f"{name}: what was commanded, since only it has the joints")
    gripper, gripper_entry = _gripper(entries, name, columns)
    if rule:
        others = len(entries[name]) - len(columns) - len(gripper if gripper_entry == name else ())
        among = f" among {len(entries[name])}" if rule == _BY_ORDER and others else ""
        notes.append(f"joints: {', '.join(columns)}, found {rule}{among}; joints=[...] names others")
    if gripper and gripper_entry == name and all(column.isdigit() for column in gripper):
        notes.append(f"gripper: {', '.join(gripper)}, after the joints")
    commands = [other for other in entries if is_command(other) and not _HAND.fullmatch(other)]
    commands = [other for other in commands if find_joints(entries[other], joints)]
    is_clear = name not in commands and not (entry and len(commands) > 1)  # of several arms
    commanded = commands if is_clear else []
    return Selection(name, columns, gripper, gripper_entry, notes, commanded)


def hand_position(entries: Mapping[str, Sequence[str]]) -> tuple[str, list[str]] | None:
    """The entry with positions of the hand, and the names of its three columns; None where no or several have them.

    The entry is called as hands are, as `eef_pos` or `ee_pose`, and has them first; or its columns are, as `tcp_x`.
    Numbers without axes of a `hand` or a `hand_state` may be joints of fingers, and are left out.
    """
    found = []
    for entry, names in entries.items():
        is_hand = bool(_HAND.fullmatch(entry)) and not is_command(entry)
        places = [
            (name, match[2].lower())
            for name in names
            if (match := _PLACES.fullmatch(name))
            and (_HAND.fullmatch(match[1]) or (is_hand and not match[1]))
            and not (match[2].isdigit() and _HAND_JOINTS.fullmatch(match[1] or entry))
        ]
        chosen = [name for axis in "xyz" for name, place in places if place == axis]
        if len(chosen) != 3 and len(places) >= 3:
            chosen = [name for name, _ in places[:3]]
        if len(chosen) == 3:
            found.append((entry, chosen))
    return found[0] if len(found) == 1 else None


def is_copy(name: str, joints: Sequence[str]) -> bool:
    """Whether a column has other values of one of some joints, as commanded: `target_joint1`, `joint1_cmd`, `q_d_1`."""
    return name not in joints and _without_words(name) in {_without_words(joint) for joint in joints} - {""}


def _without_words(name: str) -> str:
    return "_".join(word for word in re.split(r"[./_ ]+", name.lower()) if word not in _COPIES)


def is_command(entry: str) -> bool:
    """Whether an entry's name says that it is what was commanded, and not what was measured."""
    return bool(re.search(r"action|command|cmd|target|desired|goal|setpoint|master|leader", entry, re.IGNORECASE))


def _key(name: str) -> str:
    return re.sub(r"[^a-z0-9]", "", name.lower())


def _gripper(entries: Mapping[str, Sequence[str]], entry: str, columns: Sequence[str]) -> tuple[list[str], str]:
    """The gripper's columns, and the entry that has them: that of the joints, or else one beside it.

    Where there are several grippers, as in a source with two arms, those whose names begin as those of the joints do.
    """
    others = [name for name in entries[entry] if name not in columns]
    if gripper := _alike([name for name in others if _GRIPPER.search(name)], columns[0]):
        return gripper, entry
    if len(others) in (1, 2) and all(name.isdigit() for name in entries[entry]):
        return others, entry  # a vector without names: the joints, then the opening or the two fingers
    folder, leaf = _LEAF.fullmatch(entry).groups()  # type: ignore[union-attr]
    beside = [
        name for name in entries
        if _GRIPPER.search(name) and not is_command(name) and _LEAF.fullmatch(name)[1] == folder  # type: ignore[index]
    ]  # fmt: skip
    chosen = _alike(beside, folder + leaf) if len(beside) > 1 else beside
    return (list(entries[chosen[0]]), chosen[0]) if len(chosen) == 1 else ([], "")


def _alike(names: list[str], example: str) -> list[str]:
    """The names that share the most letters with an example from the start; all where none shares two."""
    shared = {name: len(os.path.commonprefix([_key(name), _key(example)])) for name in names}
    most = max(shared.values(), default=0)
    return [name for name in names if most < 2 or shared[name] == most]
