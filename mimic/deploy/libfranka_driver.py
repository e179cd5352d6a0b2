"""A driver for a Franka arm through pylibfranka, libfranka's Python binding.

No one has run it on hardware. It was written from the binding's documentation and tested against an imitation of its
interface. Read docs/real_arm.md before you try it.
"""

import importlib
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from mimic.deploy.driver import RobotAbort, RobotState

JOINTS = 7
# Thresholds of the collision reflex, as in libfranka's examples of joint motions [N m], and at the hand [N, N m].
COLLISION_TORQUE = (20.0, 20.0, 18.0, 18.0, 16.0, 14.0, 12.0)
COLLISION_FORCE = (20.0, 20.0, 20.0, 25.0, 25.0, 25.0)


class LibfrankaDriver:
    """A `Driver` of a Franka arm: joint torques at 1 kHz, in addition to the gravity compensation of its controller.

    The mass and the inertia of a tool and a payload are set in the robot's own configuration; its gravity compensation
    and its collision reflex need them.

    Args:
      address: host name or address of the robot's control unit.
      collision_torque: [7] external torque at which the robot aborts [N m].
      collision_force: [6] external force and torque at the hand at which the robot aborts [N, N m].
      library: the module; default: pylibfranka.

    Raises:
      ValueError: pylibfranka is not installed.
      RobotAbort: the robot cannot be reached, or rejects its settings.
    """

    def __init__(
        self,
        address: str,
        *,
        collision_torque: Sequence[float] = COLLISION_TORQUE,
        collision_force: Sequence[float] = COLLISION_FORCE,
        library: Any = None,
    ):
        self._library = _import() if library is None else library
        self._errors = (self._library.FrankaException, RuntimeError)
        self._control: Any = None
        self._robot = self._call(self._library.Robot, address)
        torque, force = list(collision_torque), list(collision_force)
        self._call(self._robot.set_collision_behavior, torque, torque, force, force)
        self._is_answered, self._torque = True, [0.0] * JOINTS

    def read(self) -> RobotState:
        """See `Driver`. The first call starts the torque control; after each call the robot expects a torque."""
        if self._control is None:
            self._control = self._call(self._robot.start_torque_control)
        state, _ = self._call(self._control.readOnce)
        self._is_answered = False
        return RobotState(state.time.to_sec(), np.array(state.q), np.array(state.dq), np.array(state.tau_J))

    def write(self, torque: np.ndarray) -> None:
        """See `Driver`."""
        self._torque = [float(x) for x in torque]
        self._call(self._control.writeOnce, self._library.Torques(self._torque))
        self._is_answered = True

    def stop(self) -> None:
        """See `Driver`. The last command, of the last torque, says that the motion has ended."""
        control = self._control
        try:
            if control is not None:
                last = self._library.Torques(self._torque)
                last.motion_finished = True
                if self._is_answered:
                    self._call(control.readOnce)
                self._call(control.writeOnce, last)
        finally:
            self._control = None
            self._call(self._robot.stop)

    def _call(self, function: Callable[..., Any], *arguments: Any) -> Any:
        try:
            return function(*arguments)
        except self._errors as error:
            self._control = None  # an error ends the control
            raise RobotAbort(" ".join(str(error).split())[:200] or type(error).__name__) from error


def _import() -> Any:
    try:
        return importlib.import_module("pylibfranka")
    except ImportError as error:
        raise ValueError(
            "libfranka: expected the package pylibfranka, in the version that fits the robot's system"
        ) from error
