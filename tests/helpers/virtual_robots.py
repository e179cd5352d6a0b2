"""Virtual Pandas for tests."""

import functools

import numpy as np

from mimic.arms.arm import ArmConfig
from mimic.envs import env_config
from mimic.evaluation.virtual_robot.arm_model import robot_model
from mimic.evaluation.virtual_robot.draws import draw_world
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
