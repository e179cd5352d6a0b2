"""A single virtual robot with the interface of a real one, in simulated or in real time."""

import time

import numpy as np

from mimic.control.joint_control import PERIOD
from mimic.deploy.driver import RobotAbort, RobotState
from mimic.evaluation.virtual_robot.arm_model import RobotModel
from mimic.evaluation.virtual_robot.draws import World
from mimic.evaluation.virtual_robot.robots import VirtualRobots


class VirtualRobot:
    """A `Driver` in C MuJoCo.

    Args:
      robot: the model.
      world: of one episode.
      start_pose: [joints] [rad].
      seed: of the sensors' noise.
      is_paced: whether a period takes a millisecond; commands that come later are then missing.

    Attributes:
      robots: the simulation, of one robot.
    """

    def __init__(
        self, robot: RobotModel, world: World, start_pose: np.ndarray, seed: int = 0, *, is_paced: bool = False
    ):
        self.robots = VirtualRobots(robot, world, np.asarray(start_pose, float)[None], seed)
        self._is_paced, self._started = is_paced, 0.0

    def read(self) -> RobotState:
        """See `Driver`."""
        if self._is_paced:
            self._wait()
        self._check()
        qpos, qvel = self.robots.measure()
        return RobotState(self.robots.periods * PERIOD, qpos[0], qvel[0], self.robots.torque[0].copy())

    def write(self, torque: np.ndarray) -> None:
        """See `Driver`."""
        self.robots.step(np.asarray(torque, float)[None])
        self._check()

    def stop(self) -> None:
        """See `Driver`: the simulation ends."""

    def _wait(self) -> None:
        """Waits until the next period is due, and simulates those that have passed without a command."""
        now = time.perf_counter()
        self._started = self._started or now
        due = self._started + self.robots.periods * PERIOD
        if now < due:
            time.sleep(due - now)
        for _ in range(int((now - due) / PERIOD)):
            self.robots.step(self.robots.torque, is_present=False)
            self._check()

    def _check(self) -> None:
        if self.robots.cause[0]:
            raise RobotAbort(self.robots.cause[0])
