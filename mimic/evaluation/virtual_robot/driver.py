"""A single virtual robot with the interface of a real one, in simulated time."""

import numpy as np

from mimic.control.joint_control import PERIOD, Reference
from mimic.deploy.bundle import Bundle
from mimic.deploy.driver import Command, RobotAbort, RobotState
from mimic.evaluation.virtual_robot.arm_model import RobotModel
from mimic.evaluation.virtual_robot.draws import World
from mimic.evaluation.virtual_robot.loops import ControlLoop
from mimic.evaluation.virtual_robot.robots import VirtualRobots


class VirtualRobot:
    """A `Driver` in C MuJoCo, and its `Clock`.

    Args:
      robot: the model.
      world: of one episode.
      bundle: gives the parameters of the control loop.
      start_pose: [joints] [rad].
      loop: see `ControlLoop`.
      seed: of the sensors' noise.

    Attributes:
      robots: the simulation, of one robot.
    """

    def __init__(
        self,
        robot: RobotModel,
        world: World,
        bundle: Bundle,
        start_pose: np.ndarray,
        loop: str = "mimic",
        seed: int = 0,
    ):
        self.robots = VirtualRobots(robot, world, np.asarray(start_pose, float)[None], seed)
        self._loop = ControlLoop(loop, bundle.parameters, bundle.limits, self.robots.measure()[0])

    def read(self) -> RobotState:
        """See `Driver`."""
        if self.robots.cause[0]:
            raise RobotAbort(self.robots.cause[0])
        qpos, qvel = self.robots.measure()
        return RobotState(qpos[0], qvel[0])

    def write(self, command: Command) -> None:
        """See `Driver`."""
        path = Reference(*(x[..., None] for x in command.path))
        self._loop.command(Command(path, command.stop[:, None], command.stiffness[:, None]))

    def stop(self) -> None:
        """See `Driver`: the simulation ends."""

    def wait_until(self, due: float) -> float:
        """See `Clock`."""
        while self.robots.periods < round(due / PERIOD):
            self.robots.step(self._loop.torque(*self.robots.measure()))
        return self.robots.periods * PERIOD
