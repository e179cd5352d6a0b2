"""Writes what a teleoperator drives as a LeRobot data set of the follower."""

import os
from typing import Any, NamedTuple

import numpy as np

from mimic.base.config import new_path
from mimic.base.distribution import NAME, VERSION
from mimic.motions.formats.episodes import ANGLE, ArmMotions, Episodes
from mimic.motions.formats.lerobot import frames_per_second, write_lerobot
from mimic.retargeting.teleoperation import FollowerCommand, Teleoperator
from mimic.runs.files import written_atomically

GRIPPER = "gripper"


class _Tick(NamedTuple):
    """Angles [rad] at the start of a tick, the command, and openings of the grippers, NaN where unknown."""

    leader: np.ndarray
    follower: np.ndarray
    command: np.ndarray
    openings: tuple[float, float]  # of the follower before the tick and as commanded


class TeleoperationRecorder:
    """Drives a teleoperator and keeps what it does; from each `engage` to the next, or to `disengage`, is an episode.

    Args:
      operator: the teleoperator, with a whole number of ticks per second.

    Attributes:
      operator: the same; another one of the same arms and rate may replace it, and begins an episode.

    Raises:
      ValueError: another rate.
    """

    def __init__(self, operator: Teleoperator):
        self.operator = operator
        frames_per_second(operator.period)
        self._episodes: list[list[_Tick]] = []
        self._engagement: tuple[Teleoperator, int] | None = None  # the episode's
        self._opening = np.nan

    @property
    def episodes(self) -> int:
        """Their number so far."""
        return len(self._episodes)

    def step(
        self, leader_qpos: Any, gripper: float | None = None, time: float | None = None, measured: Any = None
    ) -> FollowerCommand:
        """As `Teleoperator.step`.

        Args:
          leader_qpos: see there.
          gripper: see there.
          time: see there.
          measured: [joints] angles of the follower at the start of the tick [rad]; by default the last command.
        """
        operator = self.operator
        before = operator.qpos if measured is None else np.array(measured, float)
        if before.shape != operator.qpos.shape or not np.isfinite(before).all():
            raise ValueError(
                f"measured: expected {operator.follower.num_joints} finite angles [rad], got {measured!r:.80}"
            )
        command = operator.step(leader_qpos, gripper, time)
        opening = np.nan if command.gripper is None else command.gripper
        if operator.is_engaged and operator.leader_qpos is not None:
            if self._engagement != (engagement := (operator, operator.engagements)):
                self._episodes.append([])
                self._engagement, self._opening = engagement, opening
            openings = self._opening, opening
            self._episodes[-1].append(_Tick(operator.leader_qpos, before, command.qpos, openings))
        self._opening = opening
        return command

    def write(self, folder: str | os.PathLike[str], task: str = "") -> None:
        """Writes all episodes into a new folder. Needs pyarrow.

        Raises:
          ValueError: no episode, or a folder that exists.
        """
        if not self._episodes:
            raise ValueError("TeleoperationRecorder: expected an episode, got no tick with the clutch engaged")
        with written_atomically(new_path("folder", str(folder))) as out:
            write_lerobot(out, self._data_set(task))

    def _data_set(self, task: str) -> Episodes:
        operator, steps = self.operator, [len(ticks) for ticks in self._episodes]
        leader, follower, period = operator.leader, operator.follower, operator.period
        arms: list[ArmMotions] = []
        qpos = [np.array([*(tick.follower for tick in x), x[-1].command]) for x in self._episodes]
        led_by = [np.array([*(tick.leader for tick in x), x[-1].leader]) for x in self._episodes]
        commands = _padded([np.array([tick.command for tick in x]) for x in self._episodes])
        openings = _padded([np.array([*(tick.openings for tick in x), x[-1].openings[::-1]]) for x in self._episodes])
        gripper: dict[str, Any] = {}
        if np.isfinite(openings).any():
            openings = np.where(np.isfinite(openings), openings, openings[np.isfinite(openings)][0])  # the first known
            gripper = {"gripper": openings[..., :1], "gripper_names": (GRIPPER,)}
            gripper["gripper_command"] = openings[:, :-1, 1:]
        more = {"command": commands, "quantity": ANGLE, **gripper}
        for arm, x, of_arm in ((follower, qpos, more), (leader, led_by, {})):
            if arm is not None:
                speeds = _padded([np.gradient(y, period, axis=0) for y in x])
                arms.append(ArmMotions(arm.name, arm.joint_names, _padded(x), speeds, **of_arm))
        task, count = task or f"drive {follower.name} by {leader.name if leader else 'a hand'}", len(steps)
        provenance = {"written_by": f"{NAME} {VERSION}", "source": "teleoperation"}
        of_leader = arms[1] if leader else None
        return Episodes(period, task, arms[0], of_leader, steps, ["train"] * count, range(count), provenance)


def _padded(episodes: list[np.ndarray]) -> np.ndarray:
    """Episodes of one length, with the last row repeated."""
    longest = max(map(len, episodes))
    return np.array([np.pad(x, ((0, longest - len(x)), (0, 0)), mode="edge") for x in episodes])
