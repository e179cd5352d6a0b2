"""Runs an exported controller on a robot: an inner loop at 1 kHz, a safety layer, and the policy in its own process.

It needs NumPy and onnxruntime alone, neither JAX nor MuJoCo. `load_bundle` reads what `mimic.export` with
format=controller wrote, a `Driver` connects a robot, and `run_controller` runs a motion on it.
"""

from mimic.deploy.bundle import Bundle, load_bundle, write_bundle
from mimic.deploy.config import SafetyConfig
from mimic.deploy.driver import Driver, RobotAbort, RobotState
from mimic.deploy.fake_robot import FakeRobot
from mimic.deploy.runner import Report, run_controller

__all__ = [
    "Bundle",
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
