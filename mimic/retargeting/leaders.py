"""What leads a live follower, an arm or poses of hands alone, and the check of its samples."""

import math
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from jaxtyping import Float

from mimic.arms.embodiment import Embodiment
from mimic.arms.pose_limits import continuous_joints
from mimic.retargeting.live_pose import ArmRows
from mimic.retargeting.pose import wrap_angles

_MAX_SPEED = 4 * np.pi  # rad/s of a leader; a sample that moved faster is a jump
_PATIENCE = 0.12  # s after which samples that agree with each other count, though they jumped or time ran backwards
_LEVER = 0.4  # m that a hand moves for what counts as one rad
_NO_ROTATION = 1e-2  # by which entries of R R^T may differ from those of the identity

Way = Callable[[Any, float], np.ndarray]  # sample, rad -> the sample that a leader would have farther on


class ArmLeader:
    """Joint angles [rad] of an arm lead, as a person's skeleton.

    Attributes:
      arm: the leader.
      rows: its kinematics.
      ways: how its sample may change next.
      fault: what a sample is that cannot be used, in words.
    """

    fault = "not finite"

    def __init__(self, arm: Embodiment):
        self.arm, self.rows = arm, ArmRows(arm)
        self._joints, self._continuous = arm.num_joints, continuous_joints(arm)
        self._range = np.asarray(arm.joint_range, float)
        self.ways: list[Way] = [
            lambda here, angle, way=sign * unit: self._moved(here, angle * way)
            for sign in (1, -1)
            for unit in np.eye(self._joints)
        ]

    def sample(self, qpos: Any) -> np.ndarray:
        """A copy of a sample [joints], as drivers use their buffers again.

        Raises:
          ValueError: another shape.
        """
        sample = np.array(qpos, float)
        if sample.shape != (self._joints,):
            raise ValueError(f"leader_qpos: expected {self._joints} angles [rad], got shape {sample.shape}")
        return sample

    def is_finite(self, sample: np.ndarray) -> bool:
        """Whether a sample can be used."""
        return math.isfinite(sample.dot(sample))

    def is_within(self, before: np.ndarray, after: np.ndarray, reach: float) -> bool:
        """Whether a sample differs from another one by at most a reach [rad]."""
        moved = after - before
        # The norm is checked first because it is fast.
        return moved.dot(moved) <= reach**2 or bool(np.abs(wrap_angles(moved, self._continuous)).max() <= reach)

    def of_sample(self, sample: np.ndarray) -> Float[np.ndarray, "rows 3"]:
        """The rows of a sample."""
        return self.rows(sample[None])[0]

    def _moved(self, here: np.ndarray, change: np.ndarray) -> np.ndarray:
        lower, upper = self._range.T
        return np.clip(here + change, np.minimum(lower, here), np.maximum(upper, here))


class HandLeader:
    """Poses of hands lead, as a headset gives them; the posture is pulled to a reference posture of the follower.

    Args:
      follower: the arm.
      rows: its kinematics.
      reference: the posture [rad].
      to_base: [3, 3] that turns a row of the leader's base frame to the follower's by a product from the right.

    Attributes:
      arm, rows, ways, fault: see `ArmLeader`.
    """

    fault = "not finite, or no rotation"

    def __init__(self, follower: Embodiment, rows: ArmRows, reference: np.ndarray, to_base: np.ndarray):
        self.arm, self.rows = follower, rows
        self._reference = rows(np.asarray(reference, float)[None])[0] @ to_base.T
        self._hands = rows.hand_rows(np.arange(rows.hands))
        self.ways = list(_ways_of_a_hand())

    def sample(self, poses: Any) -> np.ndarray:
        """A copy of poses [hands, 4, 4] [m], or [4, 4] of a single hand.

        Raises:
          ValueError: another shape.
        """
        sample, hands = np.array(poses, float), self.rows.hands
        if sample.shape != (hands, 4, 4) and (hands, *sample.shape) != (1, 4, 4):
            raise ValueError(f"leader_qpos: expected {hands} poses [4, 4] of hands, got shape {sample.shape}")
        return sample.reshape(hands, 4, 4)

    def is_finite(self, sample: np.ndarray) -> bool:
        """Whether a sample can be used: its numbers are finite, and its rotations are rotations."""
        if not np.isfinite(sample).all():
            return False
        rotations = sample[:, :3, :3]
        is_orthonormal = np.abs(rotations @ rotations.swapaxes(1, 2) - np.eye(3)).max() < _NO_ROTATION
        return bool(is_orthonormal and np.linalg.det(rotations).min() > 0)

    def is_within(self, before: np.ndarray, after: np.ndarray, reach: float) -> bool:
        """Whether hands differ from others by at most a reach, in rad, or in m as if on a lever."""
        cosine = (np.sum(before[:, :3, :3] * after[:, :3, :3], axis=(1, 2)).min() - 1) / 2
        apart = np.linalg.norm(after[:, :3, 3] - before[:, :3, 3], axis=1).max()
        return bool(apart <= _LEVER * reach and math.acos(min(max(cosine, -1.0), 1.0)) <= reach)

    def of_sample(self, sample: np.ndarray) -> Float[np.ndarray, "rows 3"]:
        """The rows of the reference posture, with the hands of a sample."""
        rows, hands = self._reference.copy(), len(sample)
        rows[self._hands[:hands]] = sample[:, :3, 3] / self.rows.unit
        rows[self._hands[hands:]] = sample[:, :3, :3].swapaxes(1, 2).reshape(-1, 3)
        return rows


def _ways_of_a_hand() -> Iterator[Way]:
    """Translations of all hands along the axes, and rotations of each about its own."""
    for sign in (1, -1):
        for axis in range(3):
            yield lambda here, angle, axis=axis, sign=sign: here + sign * _LEVER * angle * _SHIFT[axis]
            yield lambda here, angle, axis=axis, sign=sign: here @ _rotation(axis, sign * angle)


_SHIFT = np.einsum("ai,j->aij", np.eye(4)[:3], np.eye(4)[3])  # translations along the axes


def _rotation(axis: int, angle: float) -> np.ndarray:
    pose, (one, other) = np.eye(4), [(axis + 1) % 3, (axis + 2) % 3]
    pose[[one, other], [one, other]] = math.cos(angle)
    pose[other, one], pose[one, other] = math.sin(angle), -math.sin(angle)
    return pose


class Samples:
    """Checks the leader's samples.

    Args:
      leader: of the samples.
      period: of a tick [s].

    Attributes:
      reason: why the last sample was ignored; empty where it was not.
      age: time since the last sample that was accepted [s].
      last: that sample.
    """

    def __init__(self, leader: ArmLeader | HandLeader, period: float):
        self._leader, self._period = leader, period
        self.forget()

    def forget(self) -> None:
        """Takes the next sample wherever it is."""
        self.reason, self.age, self._newest = "", 0.0, -np.inf
        self.last: Any = None
        self._jumped, self._agreeing, self._backwards = None, 0.0, 0.0

    def accept(self, sample: Any, time: float | None) -> np.ndarray | None:
        """The sample; None where there is none, or it is ignored."""
        self.age += self._period
        self.reason = ""
        if sample is None:
            return None
        sample = self._leader.sample(sample)
        if not self._leader.is_finite(sample) or (time is not None and not math.isfinite(time)):
            self.reason = f"ignored a sample that is {self._leader.fault}"
        elif time is not None and self._is_old(time):
            self.reason = "ignored a sample that is not newer than the last one"
        elif self._is_jump(sample):
            self.reason = "ignored a sample that jumped"
        else:
            self.last, self.age, self._jumped = sample, 0.0, None
            return sample
        return None

    def _is_old(self, time: float) -> bool:
        if time == self._newest:
            return True  # the same sample again, however long
        self._backwards = self._backwards + self._period if time < self._newest else 0.0
        if 0 < self._backwards <= _PATIENCE:
            return True
        self._newest, self._backwards = time, 0.0
        return False

    def _is_jump(self, sample: np.ndarray) -> bool:
        reach = _MAX_SPEED * max(self.age, self._period)
        if self.last is None or self._leader.is_within(self.last, sample, reach):
            return False
        before, self._jumped = self._jumped, sample
        near = before is not None and self._leader.is_within(before, sample, reach)
        self._agreeing = self._agreeing + self._period if near else 0.0
        return self._agreeing <= _PATIENCE
