"""A driver for a Franka arm through franky-control 2.0, whose loop at 1 kHz makes motions with Ruckig.

No one has run it on hardware. It was written from the package's interface and tested against an imitation of it. Read
docs/real_arm.md before you try it.
"""

import importlib
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from mimic.control.joint_control import PERIOD
from mimic.control.limits import trajectory_limits
from mimic.deploy.bundle import Bundle
from mimic.deploy.driver import Command, RobotAbort, RobotState
from mimic.deploy.path import STEP

JOINTS = 7
# Thresholds of the collision reflex, as in libfranka's examples of joint motions [N m], and at the hand [N, N m].
COLLISION_TORQUE = (20.0, 20.0, 18.0, 18.0, 16.0, 14.0, 12.0)
COLLISION_FORCE = (20.0, 20.0, 20.0, 25.0, 25.0, 25.0)
_ERRORS = ("ControlException", "CommandException", "NetworkException", "ProtocolException", "RealtimeException",
           "IncompatibleVersionException", "InvalidOperationException", "InvalidMotionTypeException")  # fmt: skip


class FrankyDriver:
    """A `Driver` of a Franka arm: a joint motion for each command, which replaces the one before.

    A motion goes to the end of a command's path in a tick, and then to its stop: where the program ends, the robot
    brakes by itself. Mass and inertia of a tool and a payload are set in the robot's own configuration.

    Args:
      address: host name or address of the robot's control unit.
      bundle: the controller; its limits are those of the motions, see `trajectory_limits`.
      collision_torque: [7] external torque at which the robot aborts [N m].
      collision_force: [6] external force and torque at the hand at which the robot aborts [N, N m].
      library: the module; default: franky.

    Raises:
      ValueError: franky is not installed, or the bundle has another arm.
      RobotAbort: the robot cannot be reached, or rejects its settings.
    """

    def __init__(
        self,
        address: str,
        bundle: Bundle,
        *,
        collision_torque: Sequence[float] = COLLISION_TORQUE,
        collision_force: Sequence[float] = COLLISION_FORCE,
        library: Any = None,
    ):
        if bundle.num_joints != JOINTS:
            raise ValueError(f"franky: expected a bundle with {JOINTS} joints, got {bundle.num_joints}")
        self._library = _import() if library is None else library
        self._errors = (*(getattr(self._library, name) for name in _ERRORS), RuntimeError)
        self._robot = self._call(self._library.Robot, address)
        self._call(self._robot.set_collision_behavior, list(collision_torque), list(collision_force))
        limits = trajectory_limits(bundle.limits, bundle.parameters)
        for name in ("velocity", "acceleration", "jerk"):
            limit = getattr(self._robot, f"joint_{name}_limit")
            self._call(limit.set, np.minimum(getattr(limits, name), limit.max))

    def read(self) -> RobotState:
        """See `Driver`; raises what has ended the last motion."""
        self._call(self._robot.poll_motion)
        state = self._call(lambda: self._robot.state)
        return RobotState(np.array(state.q), np.array(state.dq))

    def write(self, command: Command) -> None:
        """See `Driver`."""
        library = self._library
        tick = library.Duration(round(1000 * PERIOD * STEP * len(command.path.qpos)))
        end = library.JointWaypoint(library.JointState(command.qpos, command.qvel), minimum_time=tick)
        waypoints = [end, library.JointWaypoint(library.JointState(command.stop))]
        motion = library.JointWaypointMotion(waypoints, return_when_finished=False)
        self._call(self._robot.move, motion, asynchronous=True)

    def stop(self) -> None:
        """See `Driver`."""
        if self._robot.is_in_control:
            self._call(self._robot.move, self._library.JointStopMotion(), asynchronous=True)
        self._call(self._robot.join_motion)

    def _call(self, function: Callable[..., Any], *arguments: Any, **options: Any) -> Any:
        try:
            return function(*arguments, **options)
        except self._errors as error:
            raise RobotAbort(" ".join(str(error).split())[:200] or type(error).__name__) from error


def _import() -> Any:
    try:
        return importlib.import_module("franky")
    except ImportError as error:
        raise ValueError(
            "franky: expected the package franky-control, in the version that fits the robot's system"
        ) from error
