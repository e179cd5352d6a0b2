"""A robot without physics for tests and examples: joints with independent inertias."""

import time

import numpy as np

from mimic.control.joint_control import PERIOD
from mimic.control.limits import JointLimits
from mimic.deploy.driver import RobotAbort, RobotState

_TOLERANCE = 1e-9  # relative, of rounding in a torque that changes at its limit


class FakeRobot:
    """A `Driver` whose joints are double integrators with viscous friction; it aborts beyond its limits.

    Args:
      qpos: [joints] start pose [rad].
      limits: the manufacturer's limits.
      inertia: [joints] of the joints [kg m^2].
      damping: [joints] of the joints [N m s/rad].
      is_paced: whether `read` waits for the next millisecond; otherwise time is simulated.

    Attributes:
      states: list of all states that were read.
    """

    def __init__(
        self,
        qpos: np.ndarray,
        limits: JointLimits,
        inertia: np.ndarray,
        damping: np.ndarray | float = 0.1,
        *,
        is_paced: bool = False,
    ):
        self._qpos, self._limits = np.array(qpos, float), limits
        self._qvel, self._torque = np.zeros((2, len(self._qpos)))
        self._inertia, self._damping, self._is_paced = inertia, damping, is_paced
        self._command: np.ndarray | None = None
        self._periods, self._missed, self._started = 0, 0, 0.0
        self.states: list[RobotState] = []

    def read(self) -> RobotState:
        """See `Driver`."""
        if self._is_paced:
            self._wait()
        self._move()  # after the wait: the controller's other processes may use the core until then
        self._check()
        time_s = (self._periods + self._missed) * PERIOD
        state = RobotState(time_s, self._qpos.copy(), self._qvel.copy(), self._torque.copy())
        self.states.append(state)
        return state

    def write(self, torque: np.ndarray) -> None:
        """See `Driver`; what is wrong with the torque is raised by the next `read`."""
        self._command = np.array(torque, float)

    def stop(self) -> None:
        """See `Driver`."""
        self._qvel[:] = 0

    def _move(self) -> None:
        """One period with the commanded torque."""
        torque, self._command = self._command, None
        if torque is None:
            return
        change = np.abs(torque - self._torque) / PERIOD
        if np.any(change > self._limits.torque_rate * (1 + _TOLERANCE)):
            raise RobotAbort("torque rate")
        self._torque = torque
        self._qvel += PERIOD * (self._torque - self._damping * self._qvel) / self._inertia
        self._qpos += PERIOD * self._qvel
        self._periods += 1

    def _wait(self) -> None:
        now = time.perf_counter()
        self._started = self._started or now
        elapsed = (self._periods + (self._command is not None)) * PERIOD  # at the end of the commanded period
        due = self._started + elapsed
        if now < due:
            time.sleep(due - now)
        else:  # periods that were missed are counted, and not made up for
            self._missed += int((now - due) / PERIOD)
            self._started = now - elapsed

    def _check(self) -> None:
        lower, upper = self._limits.position.T
        for cause, exceeded in (
            ("joint position limit", np.any((self._qpos < lower) | (self._qpos > upper))),
            ("joint velocity limit", np.any(np.abs(self._qvel) > self._limits.velocity)),
            ("torque limit", np.any(np.abs(self._torque) > self._limits.torque)),
        ):
            if exceeded:
                raise RobotAbort(cause)
