"""Motions to write as a dataset, and motions as they were read from one."""

import dataclasses
from collections.abc import Mapping, Sequence
from itertools import groupby
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from mimic.base.distribution import install_command

EXTRA = "datasets"  # of mimic: the packages that read and write these formats
MAX_NUMBERS = 2**27  # that are read of a dataset: 1 GiB in double precision; seven joints for a day at 100 Hz
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


class Motion(NamedTuple):
    """One motion at the times of its file; `qvel` is None if the file has no velocities."""

    time: Float[np.ndarray, " samples"]
    qpos: Float[np.ndarray, "samples joints"]
    qvel: Float[np.ndarray, "samples joints"] | None


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
    """

    arm: str
    joint_names: tuple[str, ...]
    qpos: Float[np.ndarray, "episodes samples joints"]
    qvel: Float[np.ndarray, "episodes samples joints"]
    command: Float[np.ndarray, "episodes steps joints"] | None = None
    quantity: Quantity = TORQUE


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


def package_error(what: str, package: str) -> ValueError:
    """The error of a format whose package is not installed."""
    return ValueError(f"{what} needs the package {package}: {install_command(EXTRA)}")


def choose_entry(path: str, entries: Mapping[str, Sequence[str]], joints: Sequence[str], entry: str, kind: str) -> str:
    """The entry of a dataset to read: the one that is named, or the only one that has all joints.

    Args:
      path: of the dataset, for messages.
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
    fitting = [name for name in considered if set(joints) <= set(entries[name])]
    if not fitting:
        raise ValueError(
            f"source: {path!r} has no {kind} with the joints {', '.join(joints)}; its joint angles: {listed}; "
            "joints=[...] names the arm's joints among these"
        )
    if len(fitting) > 1:
        raise ValueError(
            f"source: {path!r} has the joints {', '.join(joints)} in several {kind}s; "
            f"expected one, as topic={' or topic='.join(fitting)}"
        )
    return fitting[0]
