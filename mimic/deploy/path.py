"""Paths of references: a target acts for a tick of the policy, then the reference brakes to rest."""

import numpy as np

from mimic.control.joint_control import (
    PERIOD,
    VELOCITY_RATE,
    JointParameters,
    Reference,
    next_reference,
    reference_limits,
)

STEP = 10  # periods of 1 ms between two samples of a path
_REST = 1e-4, 1e-2  # speed and acceleration below which a joint is at rest: 2e-6 rad from where it would stop


class PathGenerator:
    """Generates the paths of robots' references within their limits.

    Args:
      mode: of the targets, see `mimic.control.joint_control`.
      joints: parameters, [joints, robots] or [joints, 1] each.
      hold: periods for which a target acts, a multiple of `STEP`.

    Attributes:
      hold_steps, brake_steps: samples while a target acts, and then at most until every joint is at rest.
    """

    def __init__(self, mode: str, joints: JointParameters, hold: int):
        self._mode = mode
        self._limits, self._brake_limits = reference_limits(joints), reference_limits(joints, STEP * PERIOD)
        self.hold_steps = hold // STEP
        stop_time = joints.velocity / joints.acceleration + 2 * joints.acceleration / joints.jerk + 8 / VELOCITY_RATE
        self.brake_steps = int(np.ceil(np.max(stop_time) / (STEP * PERIOD)))

    def target_path(self, reference: Reference, target: np.ndarray) -> np.ndarray:
        """The path [3, samples, joints, robots] from a reference until all joints are at rest, see `next_reference`.

        Args:
          reference: where the path begins, [joints, robots] each; it is not a sample of the path.
          target: angles [rad] or velocities [rad/s], [joints, robots].
        """
        samples = []
        for _ in range(self.hold_steps):
            for _ in range(STEP):
                reference = next_reference(self._mode, reference, target, self._limits, np)
            samples.append(reference)
        return np.concatenate([np.stack(samples, axis=1), self.braking_path(reference)], axis=1)

    def braking_path(self, reference: Reference) -> np.ndarray:
        """The path [3, samples, joints, robots] on which a reference brakes until all joints are at rest."""
        samples, zero = [], np.zeros_like(reference.qpos)
        for _ in range(self.brake_steps):
            reference = next_reference("joint_velocity", reference, zero, self._brake_limits, np, STEP * PERIOD)
            samples.append(reference)
            if np.abs(reference.qvel).max() < _REST[0] and np.abs(reference.qacc).max() < _REST[1]:
                break
        samples[-1] = Reference(reference.qpos, zero, zero)
        return np.stack(samples, axis=1)


def extended(path: np.ndarray, samples: int) -> np.ndarray:
    """A path [3, samples, joints, robots] of this length: the arms stay where it ends, at rest."""
    return np.concatenate([path, np.repeat(path[:, -1:], samples - path.shape[1], axis=1)], axis=1)
