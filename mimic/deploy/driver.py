"""The interface of a robot: what the controller reads and writes in each period."""

from typing import NamedTuple, Protocol

import numpy as np


class RobotState(NamedTuple):
    """What a robot measures.

    Attributes:
      time: of the robot's clock [s].
      qpos: [joints] angles [rad].
      qvel: [joints] velocities [rad/s].
      torque: [joints] torques that the joints measure [N m], or the commanded ones without sensors.
    """

    time: float
    qpos: np.ndarray
    qvel: np.ndarray
    torque: np.ndarray


class RobotAbort(RuntimeError):
    """A robot stopped by itself, or its connection was lost.

    Attributes:
      cause: what happened, in a few words; reports count aborts by it.
    """

    def __init__(self, cause: str):
        super().__init__(cause)
        self.cause = cause


class Driver(Protocol):
    """A torque-controlled robot with a period of 1 ms, which compensates gravity itself."""

    def read(self) -> RobotState:
        """Waits for the next period and returns the robot's state.

        Raises:
          RobotAbort: the robot stopped by itself.
        """
        ...

    def write(self, torque: np.ndarray) -> None:
        """Commands the torque [joints] of this period [N m], in addition to gravity compensation.

        Raises:
          RobotAbort: the robot rejected it.
        """
        ...

    def stop(self) -> None:
        """Ends the torque control; the robot holds its position by itself."""
        ...
