"""The interface of a robot: its state and where it shall go, once in a tick of the policy."""

from typing import NamedTuple, Protocol

import numpy as np

from mimic.control.joint_control import Reference


class RobotState(NamedTuple):
    """What a robot measures.

    Attributes:
      qpos: [joints] angles [rad].
      qvel: [joints] velocities [rad/s].
    """

    qpos: np.ndarray
    qvel: np.ndarray


class Command(NamedTuple):
    """Where an arm goes in a tick of the policy, and where it stops if no other command follows.

    The clearance of this path, braking included, was checked. Arrays of several robots are [..., joints, robots].

    Attributes:
      path: the reference after each `STEP` periods of 1 ms, [steps, joints] each [rad, rad/s, rad/s^2]; a robot without
        a loop for paths takes its end alone, `qpos` and `qvel`.
      stop: [joints] pose in which the arm comes to rest where it brakes at the end of the path [rad].
    """

    path: Reference
    stop: np.ndarray

    @property
    def qpos(self) -> np.ndarray:
        """Angles at the end of the tick [joints] [rad]."""
        return self.path.qpos[-1]

    @property
    def qvel(self) -> np.ndarray:
        """Velocities at the end of the tick [joints] [rad/s]."""
        return self.path.qvel[-1]


class RobotAbort(RuntimeError):
    """A robot stopped by itself, or its connection was lost.

    Attributes:
      cause: what happened, in a few words; reports count aborts by it.
    """

    def __init__(self, cause: str):
        super().__init__(cause)
        self.cause = cause


class Driver(Protocol):
    """A robot with a control loop of its own, which compensates gravity and moves the joints to targets."""

    def read(self) -> RobotState:
        """The robot's state at present.

        Raises:
          RobotAbort: the robot stopped by itself.
        """
        ...

    def write(self, command: Command) -> None:
        """Commands where the robot is a tick from now; at the end of the path without a new command it must stop.

        Raises:
          RobotAbort: the robot stopped by itself, or rejected the command.
        """
        ...

    def stop(self) -> None:
        """Ends the control; the robot holds its position by itself."""
        ...
