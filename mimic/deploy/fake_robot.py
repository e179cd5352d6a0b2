"""A robot without physics for tests and examples: its joints are where they were commanded to be."""

import numpy as np

from mimic.control.joint_control import PERIOD
from mimic.control.limits import JointLimits
from mimic.deploy.driver import Command, RobotAbort, RobotState
from mimic.deploy.path import STEP


class FakeRobot:
    """A `Driver` and its `Clock`, in simulated time; it aborts beyond its limits.

    At the end of a path without a new command it stops within a step, in the pose in which the arm would come to rest.

    Args:
      qpos: [joints] start pose [rad].
      limits: the manufacturer's limits.

    Attributes:
      time: since the start [s].
      states: list of the states after each step of a path.
      commands: list of all commands.
    """

    def __init__(self, qpos: np.ndarray, limits: JointLimits):
        self._limits, self.time = limits, 0.0
        self.states = [RobotState(np.array(qpos, float), np.zeros(len(qpos)))]
        self.commands: list[Command] = []
        self._next = 0  # sample of the last command's path

    def read(self) -> RobotState:
        """See `Driver`."""
        qpos, qvel = self.states[-1]
        lower, upper = self._limits.position.T
        for cause, is_exceeded in (
            ("joint position limit", np.any((qpos < lower) | (qpos > upper))),
            ("joint velocity limit", np.any(np.abs(qvel) > self._limits.velocity)),
        ):
            if is_exceeded:
                raise RobotAbort(cause)
        return RobotState(qpos.copy(), qvel.copy())

    def write(self, command: Command) -> None:
        """See `Driver`."""
        self.commands.append(command)
        self._next = 0

    def stop(self) -> None:
        """See `Driver`."""

    def wait_until(self, due: float) -> float:
        """See `Clock`."""
        while self.time < due - 1e-9:
            self.states.append(self._state())
            self.time += STEP * PERIOD
        return self.time

    def _state(self) -> RobotState:
        """The state after the next step."""
        if not self.commands:
            return self.states[-1]
        path, index = self.commands[-1].path, self._next
        self._next += 1
        if index < len(path.qpos):
            return RobotState(path.qpos[index].copy(), path.qvel[index].copy())
        return RobotState(self.commands[-1].stop.copy(), np.zeros(len(path.qpos[0])))
