"""What stands in place of an arm's joints where another arm takes over a data set, and in which columns."""

import re
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from mimic.motions.formats.episodes import ANGLE, EXPERT, GRIPPER, VELOCITY, Motion, Quantity
from mimic.motions.formats.names import is_copy, numbers_joints, parse_column


class Replacement(NamedTuple):
    """Motions of a learner in place of those of the expert in a source.

    Attributes:
      robot: the learner's name.
      joints: its joints, base to tip.
      old_joints: the expert's joints by entry, as the source calls them.
      motions: the learner's motions by entry and episode, with the samples and the unit of the source, and with
        velocities.
      kept: names of the episodes that are written.
      grippers: the entry and the names of the gripper's channels that motions have otherwise, by entry of the joints.
      yaw: of the learner's base in that of the expert [rad].
    """

    robot: str
    joints: tuple[str, ...]
    old_joints: Mapping[str, tuple[str, ...]]
    motions: Mapping[str, Mapping[str, Motion]]
    kept: Sequence[str]
    grippers: Mapping[str, tuple[str, tuple[str, ...]]] = {}
    yaw: float = 0.0


class Column(NamedTuple):
    """A column after the replacement.

    Attributes:
      name: of the column.
      index: the column that is carried over, or that of the expert whose place it takes.
      quantity: of a joint of the learner; None for a column that is carried over.
      joint: number of that joint, or of the gripper's channel.
    """

    name: str
    index: int
    quantity: Quantity | None = None
    joint: int = 0


def replaced_columns(
    names: Sequence[str], old_joints: Sequence[str], joints: Sequence[str], gripper: Sequence[str] = ()
) -> tuple[list[Column], list[str]]:
    """The columns with those of one arm's joints replaced by another's, and the names of columns that are left out.

    Angles and velocities stand where the first ones of the expert stood, and are called as these were: by the learner's
    names of joints, or by numbers where the source numbers them. Torques of the expert are none of the learner, and
    neither are other values of its joints, as commanded ones in the same table.
    Channels of `gripper` keep their names.
    """
    numbered = numbers_joints(old_joints)
    columns: list[Column] = []
    dropped: list[str] = []
    replaced: set[Quantity] = set()
    for index, name in enumerate(names):
        parsed = parse_column(name)
        joint = parsed.joint.removeprefix(EXPERT)
        if parsed.joint in gripper and parsed.quantity == ANGLE:
            columns.append(Column(name, index, GRIPPER, gripper.index(parsed.joint)))
        elif joint in old_joints and parsed.quantity not in (ANGLE, VELOCITY) or is_copy(parsed.joint, old_joints):
            dropped.append(name)
        elif joint not in old_joints:
            columns.append(Column(name, index))
        elif parsed.quantity not in replaced:
            replaced.add(parsed.quantity)
            old = re.findall(r"\d+", joint)[-1] if numbered else joint
            new = [str(int(old) + number) for number in range(len(joints))] if numbered else joints
            at = name.rindex(old)
            texts = (name[:at] + text + name[at + len(old) :] for text in new)
            columns += [Column(text, index, parsed.quantity, number) for number, text in enumerate(texts)]
    return columns, dropped


def replaced_values(values: np.ndarray, columns: Sequence[Column], motion: Motion) -> np.ndarray:
    """The values [samples, columns] of the columns, of the type of the old values [samples, old columns].

    Args:
      values: what the source has.
      columns: see `replaced_columns`.
      motion: of the learner, at the same samples.
    """
    of = {ANGLE: motion.qpos, VELOCITY: motion.qvel, GRIPPER: motion.gripper}
    parts = [
        values[:, column.index] if column.quantity is None else of[column.quantity][:, column.joint]  # type: ignore[index]
        for column in columns
    ]
    return np.stack(parts, axis=1).astype(values.dtype)
