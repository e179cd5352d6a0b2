"""Virtual Pandas for tests."""

import functools

import numpy as np

from mimic.arms.arm import ArmConfig
from mimic.control.joint_control import PERIOD, Reference
from mimic.deploy.driver import Command, RobotAbort, RobotState
from mimic.envs import env_config
from mimic.evaluation.virtual_robot.arm_model import robot_model
from mimic.evaluation.virtual_robot.draws import draw_world
from mimic.evaluation.virtual_robot.loops import ControlLoop
from mimic.evaluation.virtual_robot.robots import VirtualRobots
from mimic.physics.world import WorldConfig
from tests.helpers.bundles import panda

IDEAL = WorldConfig()


@functools.cache
def model():
    return robot_model(ArmConfig())


@functools.cache
def hardware() -> WorldConfig:
    config = env_config("panda7dof", world="hardware").world
    assert config is not None
    return config


def world(config=IDEAL, robots=1, seed=0, edge=""):
    return draw_world(config, robots, 7, np.random.default_rng(seed), edge)


def home():
    return np.array(panda().embodiment.home)


def virtual(config=IDEAL, pose=None, robots=1, seed=0):
    poses = np.tile(home() if pose is None else pose, (robots, 1))
    return VirtualRobots(model(), world(config, robots, seed), poses, seed)


class VirtualRobot:
    """One virtual robot in an ideal world with the interface of a real one: a `Driver` and its `Clock`."""

    def __init__(self, bundle, loop):
        self.robots = VirtualRobots(model(), world(), np.asarray(bundle.start_pose, float)[None], 0)
        self._loop = ControlLoop(loop, bundle.parameters, bundle.limits, self.robots.measure()[0])

    def read(self):
        if self.robots.cause[0]:
            raise RobotAbort(self.robots.cause[0])
        return RobotState(*(x[0] for x in self.robots.measure()))

    def write(self, command):
        path = Reference(*(x[..., None] for x in command.path))
        self._loop.command(Command(path, command.stop[:, None]))

    def stop(self):
        pass

    def wait_until(self, due):
        while self.robots.periods < round(due / PERIOD):
            self.robots.step(self._loop.torque(*self.robots.measure()))
        return self.robots.periods * PERIOD
