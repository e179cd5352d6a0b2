"""The control loops of virtual robots at 1 kHz: from commands to reference motions, and to torques that track them.

All arrays of commands are [..., joints, robots], those of robots [robots, joints].
"""

from typing import Protocol

import numpy as np

from mimic.base.distribution import import_extra
from mimic.control.joint_control import (
    PERIOD,
    JointParameters,
    Reference,
    joint_torque,
    next_reference,
    reference_limits,
)
from mimic.control.limits import JointLimits, trajectory_limits
from mimic.deploy.driver import Command
from mimic.deploy.path import STEP

LOOPS = ("mimic", "ruckig")
_SLOW_DOWN = 0.92  # of the velocity limit, beyond which a joint is braked in addition
_SLOWING = 3.0  # its damping, as a multiple of that of the controller


class ReferenceMotion(Protocol):
    """The reference motion of some robots."""

    def command(self, command: Command) -> None:
        """Takes a command, which replaces the last one."""
        ...

    def next(self) -> Reference:
        """The reference [joints, robots] after one more period."""
        ...


class PathMotion:
    """The motion of mimic's inner loop: along the path of a command, and to its stop where no other command follows.

    Args:
      joints: parameters, [joints, robots] each.
      qpos: [joints, robots] at the start [rad].
    """

    def __init__(self, joints: JointParameters, qpos: np.ndarray):
        self._limits, self._reference = reference_limits(joints), Reference(qpos, 0 * qpos, 0 * qpos)
        self._stop, self._samples = qpos, np.zeros((0, 3, *qpos.shape))

    def command(self, command: Command) -> None:
        """See `ReferenceMotion`."""
        ends = np.concatenate([np.stack(self._reference)[None], np.stack(command.path, axis=1)])
        fraction = np.arange(1, STEP + 1)[:, None, None, None] / STEP
        between = [before + fraction * (after - before) for before, after in zip(ends, ends[1:], strict=False)]
        self._samples, self._stop = np.concatenate(between), command.stop

    def next(self) -> Reference:
        """See `ReferenceMotion`."""
        if len(self._samples):
            self._reference, self._samples = Reference(*self._samples[0]), self._samples[1:]
        else:
            self._reference = next_reference("joint_position", self._reference, self._stop, self._limits, np)
        return self._reference


class RuckigMotion:
    """The motion of Ruckig's online trajectories, as franky gives them to a Franka arm.

    It goes to the end of a command's path, its velocity included, in a tick, and from there to the stop where no other
    command follows; the acceleration at both is zero.

    Args:
      limits: of velocity, acceleration and jerk.
      qpos: [joints, robots] at the start [rad].

    Raises:
      ValueError: ruckig is not installed.
    """

    def __init__(self, limits: JointLimits, qpos: np.ndarray):
        ruckig = import_extra("ruckig", "deploy", "robot_loop:")
        joints, robots = qpos.shape
        self._zero, self._command = [0.0] * joints, None
        self._ruckig = [ruckig.Ruckig(joints, PERIOD) for _ in range(robots)]
        self._inputs = [ruckig.InputParameter(joints) for _ in range(robots)]
        self._outputs = [ruckig.OutputParameter(joints) for _ in range(robots)]
        self._finished = ruckig.Result.Finished
        for parameters, start in zip(self._inputs, qpos.T.tolist(), strict=True):
            parameters.current_position = parameters.target_position = start
            parameters.max_velocity, parameters.max_acceleration = (
                limits.velocity.tolist(),
                limits.acceleration.tolist(),
            )
            parameters.max_jerk = limits.jerk.tolist()

    def command(self, command: Command) -> None:
        """See `ReferenceMotion`."""
        self._stops = command.stop.T.tolist()
        duration = len(command.path.qpos) * STEP * PERIOD
        for parameters, qpos, qvel in zip(self._inputs, command.qpos.T.tolist(), command.qvel.T.tolist(), strict=True):
            parameters.target_position, parameters.target_velocity = qpos, qvel
            parameters.minimum_duration = duration

    def next(self) -> Reference:
        """See `ReferenceMotion`."""
        rows = [self._next(robot) for robot in range(len(self._ruckig))]
        return Reference(*np.array(rows).transpose(1, 2, 0))

    def _next(self, robot: int) -> list[list[float]]:
        """Position, velocity and acceleration of a robot's joints after one more period."""
        parameters, output = self._inputs[robot], self._outputs[robot]
        result = self._ruckig[robot].update(parameters, output)
        if result < 0:
            raise RuntimeError(f"ruckig: {result}")
        output.pass_to_input(parameters)
        if result == self._finished and any(parameters.target_velocity):
            parameters.target_position, parameters.target_velocity = self._stops[robot], self._zero
            parameters.minimum_duration = None
        return [output.new_position, output.new_velocity, output.new_acceleration]


class ControlLoop:
    """The control loop of some robots: a reference motion, and the torques of an impedance controller that track it.

    As robots do, it brakes a joint in addition that is near its velocity limit or leaves the range of references: an
    arm that accelerates overshoots.

    Args:
      name: one of `LOOPS`: "mimic" tracks the path of a command, "ruckig" goes to its end by `RuckigMotion`.
      parameters: [joints] each.
      limits: the manufacturer's.
      qpos: measured at the start [robots, joints] [rad].
    """

    def __init__(self, name: str, parameters: JointParameters, limits: JointLimits, qpos: np.ndarray):
        robots = len(qpos)
        self._joints = JointParameters(*(np.tile(np.asarray(x, float)[:, None], robots) for x in parameters))
        self._slow = _SLOW_DOWN * limits.velocity[:, None]
        trajectories = trajectory_limits(limits, parameters)
        motion = PathMotion(self._joints, qpos.T) if name == "mimic" else RuckigMotion(trajectories, qpos.T)
        self._motion: ReferenceMotion = motion
        self._torque = np.zeros(qpos.T.shape)

    def command(self, command: Command) -> None:
        """Takes a command for each robot, see `Driver`."""
        self._motion.command(command)

    def torque(self, qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
        """The torques of a period [robots, joints] [N m], in addition to gravity compensation.

        Args:
          qpos, qvel: measured [robots, joints] [rad, rad/s].
        """
        qpos, qvel, joints = qpos.T, qvel.T, self._joints
        torque = joint_torque("joint_position", qpos, qvel, self._motion.next(), qpos, self._torque, joints, np)
        is_leaving = (qvel > 0) & (qpos > joints.upper) | (qvel < 0) & (qpos < joints.lower)
        excess = np.where(is_leaving, qvel, qvel - np.clip(qvel, -self._slow, self._slow))
        torque = np.clip(torque - _SLOWING * joints.damping * excess, -joints.torque, joints.torque)
        change = joints.torque_rate * PERIOD
        self._torque = np.clip(torque, self._torque - change, self._torque + change)
        return self._torque.T
