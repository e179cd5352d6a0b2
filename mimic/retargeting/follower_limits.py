"""Limits of a live follower: those of its arm, and motions of its joints and of its gripper within them."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from mimic.arms.embodiment import Embodiment
from mimic.base.distribution import install_command
from mimic.control.limits import JointLimits, joint_limits

_AHEAD = 0.05  # s, the shortest of the trajectories of which a tick takes the beginning
_BRAKING = 0.5  # of twice the acceleration: what a joint needs to stop before its limit
_GRIPPER_TIME = 0.25  # s at least from closed to open


def follower_limits(follower: Embodiment, velocity: Any = None) -> JointLimits:
    """The limits of an arm's model, with this velocity [rad/s] where it is given.

    Raises:
      ValueError: no finite velocity above 0.
    """
    speeds = np.asarray(follower.velocity_limit if velocity is None else velocity, float)
    if speeds.shape not in ((), (follower.num_joints,)) or not np.all(np.isfinite(speeds) & (speeds > 0)):
        raise ValueError(
            f"velocity: expected {follower.num_joints} maximum speeds above 0 [rad/s], or one, got {speeds.tolist()}; "
            f"inf is of a model that states none ({follower.name})"
        )
    speeds = np.broadcast_to(speeds, follower.num_joints)
    return joint_limits(np.asarray(follower.joint_range, float), speeds, np.asarray(follower.torque_limit))


class Gripper:
    """Maps the opening from the leader's range to the follower's, at a limited speed."""

    def __init__(self, leader: Sequence[float], follower: Sequence[float], period: float):
        for name, limits in (("leader", leader), ("follower", follower)):
            if len(limits) != 2 or not np.isfinite(limits).all() or limits[0] == limits[1]:
                raise ValueError(f"grippers: expected (closed, open) of the {name}, two finite numbers, got {limits}")
        self._leader, self._follower, self._step = tuple(leader), tuple(follower), period / _GRIPPER_TIME
        self._goal: float | None = None
        self._fraction: float | None = None

    def step(self, value: float | None) -> float | None:
        """The follower's opening at the end of a tick; a value that is None or not finite changes no goal."""
        closed, opened = self._leader
        if value is not None and np.isfinite(value):
            self._goal = float(np.clip((value - closed) / (opened - closed), 0, 1))
        if self._goal is None:
            return None
        last = self._goal if self._fraction is None else self._fraction
        self._fraction = last + float(np.clip(self._goal - last, -self._step, self._step))
        return self._follower[0] + self._fraction * (self._follower[1] - self._follower[0])


class Limiter:
    """Ruckig's online trajectories through a goal, or to rest as soon as possible."""

    def __init__(self, limits: JointLimits, period: float):
        try:
            import ruckig
        except ImportError as error:
            raise ValueError(f"Teleoperator: needs the package ruckig: {install_command('deploy')}") from error
        joints = len(limits.velocity)
        self._ruckig, self._input = ruckig.Ruckig(joints, period), ruckig.InputParameter(joints)
        self._output, self._interfaces = ruckig.OutputParameter(joints), ruckig.ControlInterface
        self._input.minimum_duration = _AHEAD  # as fast as possible, a trajectory of each tick has all the acceleration
        self._input.max_velocity, self._input.max_acceleration = limits.velocity.tolist(), limits.acceleration.tolist()
        self._input.max_jerk = limits.jerk.tolist()
        self._zero, self._limits = [0.0] * joints, limits

    @property
    def qpos(self) -> np.ndarray:
        """The last command [rad]."""
        return np.array(self._input.current_position)

    def start(self, qpos: np.ndarray) -> None:
        """At rest at these angles [rad]."""
        self._input.current_position = self._input.target_position = qpos.tolist()
        self._input.current_velocity = self._input.current_acceleration = self._zero

    def step(self, goal: np.ndarray, speed: np.ndarray) -> np.ndarray:
        """Angles after a tick on the way through a goal [rad] at a speed [rad/s], from which joints can still stop."""
        lower, upper = self._limits.position.T
        ahead = np.minimum(np.maximum(goal + _AHEAD * speed, lower), upper)
        down, up = (np.sqrt(_BRAKING * self._limits.acceleration * x) for x in (ahead - lower, upper - ahead))
        self._input.control_interface, self._input.target_position = self._interfaces.Position, ahead.tolist()
        self._input.target_velocity = np.minimum(np.maximum(speed, -down), up).tolist()
        return self._next()

    def brake(self) -> np.ndarray:
        """Angles after a tick of braking [rad]."""
        self._input.control_interface, self._input.target_velocity = self._interfaces.Velocity, self._zero
        return self._next()

    def _next(self) -> np.ndarray:
        result = self._ruckig.update(self._input, self._output)
        if result < 0 and self._input.control_interface == self._interfaces.Position:
            return self.brake()  # a goal that it cannot compute
        if result < 0:
            raise RuntimeError(f"ruckig: {result}")
        self._output.pass_to_input(self._input)
        return self.qpos
