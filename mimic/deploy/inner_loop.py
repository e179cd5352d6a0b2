"""The inner loops of robots at 1 kHz: references that move towards their targets, and the torques that track them."""

import numpy as np

from mimic.control.joint_control import PERIOD, JointParameters, Reference
from mimic.deploy.joint_motion import (
    JointTorque,
    State,
    joint_motion,
    joint_numbers,
    joint_reference,
    moved,
    tracking_torque,
)

_SLOWING = 3.0  # of the damping of the inner loop


class InnerLoop:
    """The references of some robots' joints, and the torques of the last period.

    Lists have a number for each joint of each robot, in the order of arrays [joints, robots].

    Args:
      joints: parameters, [joints, robots] each.
      is_position: whether targets are angles [rad]; otherwise velocities [rad/s].
      slow: speeds beyond which the joints are braked in addition [joints, robots] [rad/s].

    Attributes:
      states: references; replaced in each period.
      torques: [N m].
    """

    def __init__(self, joints: JointParameters, is_position: bool, slow: np.ndarray):
        self._size, self._is_position = joints.lower.shape, is_position
        self._stiffness, self._damping = joints.stiffness, joints.damping
        self._motions = [joint_motion(JointParameters(*numbers), 1) for numbers in joint_numbers(joints)]
        change, slowing = PERIOD * joints.torque_rate, _SLOWING * joints.damping
        limits = joints.lower, joints.upper, joints.inertia, joints.friction, joints.torque, change, slow, slowing
        self._limits = [JointTorque(*numbers) for numbers in joint_numbers(limits)]
        zeros = np.zeros(self._size)
        self.states: list[State] = []
        self.torques = zeros.ravel().tolist()
        self.set_reference(Reference(zeros, zeros, zeros))
        self.set_targets(zeros, np.ones(self._size))

    @property
    def reference(self) -> Reference:
        """The references, [joints, robots] each."""
        return joint_reference(self.states, self._size)

    @property
    def torque(self) -> np.ndarray:
        """The torques [joints, robots] of the last period [N m]."""
        return np.array(self.torques).reshape(self._size)

    def set_reference(self, reference: Reference) -> None:
        """Sets the references, [joints, robots] each."""
        self.states = joint_numbers(reference)

    def set_targets(self, value: np.ndarray, stiffness: np.ndarray) -> None:
        """Sets the targets [joints, robots], see `Target`."""
        self._targets = value.ravel().tolist()
        # The damping ratio stays the same.
        self._gains = joint_numbers((stiffness * self._stiffness, np.sqrt(stiffness) * self._damping))

    def period(self, qpos: list[float], qvel: list[float], is_held: list[bool], is_lost: list[bool]) -> None:
        """Moves the references by one period, and computes the torques.

        Args:
          qpos, qvel: measured [rad, rad/s].
          is_held: whether the target acts; otherwise the joint stops.
          is_lost: whether nothing is measured: the torque is then that of the reference's motion alone.
        """
        states, torques = [], []
        for i, (state, held, lost) in enumerate(zip(self.states, is_held, is_lost, strict=True)):
            target = self._targets[i] if held else None
            state, _ = moved(state, 1, self._motions[i], 1, target, is_position=self._is_position)
            measured, gains = ((state[0], state[1]), (0.0, 0.0)) if lost else ((qpos[i], qvel[i]), self._gains[i])
            states.append(state)
            torques.append(tracking_torque(*measured, state, gains, self.torques[i], self._limits[i]))
        self.states, self.torques = states, torques
