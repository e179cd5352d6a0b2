"""Motions to write as a dataset, and motions as they were read from one."""

import dataclasses
from collections.abc import Mapping, Sequence
from itertools import groupby
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

EXTRA = "datasets"  # of mimic: the packages that read and write these formats
MAX_NUMBERS = 2**27  # that are read of a dataset: 1 GiB in double precision; seven joints for a day at 100 Hz
_NEAR = 0.1  # of the range of all angles: how far commanded ones are from measured ones
EXPERT = "expert."  # before the names of the expert's joints, where they are beside the robot's


class Quantity(NamedTuple):
    """What a number of a joint is.

    Attributes:
      name: short name, as LeRobot's robots append it to the name of a joint.
      unit: SI unit.
    """

    name: str
    unit: str


ANGLE, VELOCITY, TORQUE = Quantity("pos", "rad"), Quantity("vel", "rad/s"), Quantity("torque", "N m")
GRIPPER = Quantity("gripper", "")


class Motion(NamedTuple):
    """One motion, of any length, at the times of its source.

    Attributes:
      time: [samples] s.
      qpos: [samples, joints] angles, in rad unless a `Recording` says otherwise.
      qvel: [samples, joints] the same per second; None if the source has no velocities.
      gripper: [samples, channels] joints or opening of the gripper, as the source has them; None without a gripper.
      hand: [samples, 3] positions of the hand in any axes; None where the source has none.
      hand_step: [samples, 3] commanded steps of the hand in the axes of the base, in any unit; None without.
      objects: [samples, objects, 4, 4] poses of objects in the arm's base frame [m]; None where not known.
    """

    time: Float[np.ndarray, " samples"]
    qpos: Float[np.ndarray, "samples joints"]
    qvel: Float[np.ndarray, "samples joints"] | None
    gripper: Float[np.ndarray, "samples channels"] | None = None
    hand: Float[np.ndarray, "samples 3"] | None = None
    hand_step: Float[np.ndarray, "samples 3"] | None = None
    objects: Float[np.ndarray, "samples objects 4 4"] | None = None

    def take(self, index: Any) -> "Motion":
        """The samples with these indices."""
        return Motion(*(None if values is None else values[index] for values in self))  # type: ignore[arg-type]


class Recording(NamedTuple):
    """The motions of one arm in a source.

    Attributes:
      motions: by name, as messages call them.
      gripper: names of the gripper's channels.
      unit: of the angles: a value of `UNITS`; empty where the source does not state one.
      robot: the robot's type, of a source that may be in any of these units; None where others than rad are unusual.
      notes: lines about what was assumed, changed or left out.
      entry: what has the angles: the topic, feature, data set or array.
      joints: the source's names of the joints, base to tip.
      commanded: other entries that have the same joints, as they were commanded.
      gripper_entry: what has the gripper's channels.
    """

    motions: dict[str, Motion]
    gripper: tuple[str, ...] = ()
    unit: str = ""
    robot: str | None = None
    notes: tuple[str, ...] = ()
    entry: str = ""
    joints: tuple[str, ...] = ()
    commanded: tuple[str, ...] = ()
    gripper_entry: str = ""


def follows(commands: Float[np.ndarray, "samples joints"], angles: Float[np.ndarray, "samples joints"]) -> bool:
    """Whether commands may be the angles as they were commanded, by their values: those of each joint are near it."""
    known = np.isfinite(commands).all(axis=1) & np.isfinite(angles).all(axis=1)
    if not known.any():
        return False
    apart = np.median(np.abs(commands - angles)[known], axis=0)
    return bool(np.all(apart < _NEAR * np.ptp(angles[known])))


@dataclasses.dataclass(frozen=True)
class ArmMotions:
    """Motions of one arm, each from time 0 to T dt.

    Attributes:
      arm: its name.
      joint_names: its joints, base to tip.
      qpos: [N, T+1, n] joint angles [rad].
      qvel: [N, T+1, n] joint velocities [rad/s].
      command: [N, T, n] what was commanded from each sample to the next; None if unknown.
      quantity: what the commands are.
      gripper: [N, T+1, m] joints or opening of its gripper, in the units of their source; None if unknown.
      gripper_names: its channels.
      gripper_command: [N, T, m] what was commanded of them; None if unknown.
    """

    arm: str
    joint_names: tuple[str, ...]
    qpos: Float[np.ndarray, "episodes samples joints"]
    qvel: Float[np.ndarray, "episodes samples joints"]
    command: Float[np.ndarray, "episodes steps joints"] | None = None
    quantity: Quantity = TORQUE
    gripper: Float[np.ndarray, "episodes samples channels"] | None = None
    gripper_names: tuple[str, ...] = ()
    gripper_command: Float[np.ndarray, "episodes steps channels"] | None = None


@dataclasses.dataclass(frozen=True)
class Episodes:
    """Motions to write as a dataset.

    Attributes:
      dt: time between two samples [s].
      task: what the robot does, in words.
      robot: the arm whose state and commands a dataset is about.
      expert: the arm that it imitates, at the same times; None where there is none.
      steps: steps of each episode, at most T; later samples are not written.
      splits: name of the split of each episode; episodes of a split are next to each other.
      numbers: number of each episode within its split.
      provenance: what the motions are from, as text, for the metadata.
    """

    dt: float
    task: str
    robot: ArmMotions
    expert: ArmMotions | None
    steps: Sequence[int]
    splits: Sequence[str]
    numbers: Sequence[int]
    provenance: Mapping[str, Any]

    @property
    def ranges(self) -> dict[str, tuple[int, int]]:
        """The first episode of each split, and the one after its last."""
        found: dict[str, tuple[int, int]] = {}
        for split, group in groupby(range(len(self.splits)), key=lambda episode: self.splits[episode]):
            indices = list(group)
            found[split] = (indices[0], indices[-1] + 1)
        return found
