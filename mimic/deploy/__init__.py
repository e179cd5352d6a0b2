"""Runs an exported controller on a robot: the policy and a safety layer at the policy's rate, and a driver.

It needs NumPy and onnxruntime alone, neither JAX nor MuJoCo. `load_bundle` reads what `mimic.export` with
format=controller wrote, a `Driver` connects a robot with a control loop of its own, and `run_controller` runs a motion.
"""

from mimic.deploy.bundle import Bundle, load_bundle, write_bundle
from mimic.deploy.config import SafetyConfig
from mimic.deploy.driver import Command, Driver, RobotAbort, RobotState
from mimic.deploy.fake_robot import FakeRobot
from mimic.deploy.runner import Report, run_controller

__all__ = [
    "Bundle",
    "Command",
    "Driver",
    "FakeRobot",
    "Report",
    "RobotAbort",
    "RobotState",
    "SafetyConfig",
    "load_bundle",
    "run_controller",
    "write_bundle",
]
