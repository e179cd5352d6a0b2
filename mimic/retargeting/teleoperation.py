"""Live teleoperation: a leader arm, a person or a hand drives a follower of another embodiment, tick by tick.

In each tick a sample of the leader is checked, see `mimic.retargeting.leaders`. It gives a goal of the follower's hand,
to which the follower moves within its limits, see `mimic.retargeting.live_follower`.
"""

import functools
import math
from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from mimic.arms.capsules import Capsules
from mimic.arms.embodiment import Embodiment
from mimic.base.config import check_choice
from mimic.control.limits import JointLimits
from mimic.metric.config import MetricConfig
from mimic.retargeting.follower_limits import Gripper, follower_limits
from mimic.retargeting.hand_target import matched_hands, placement
from mimic.retargeting.leaders import ArmLeader, HandLeader, Samples, Way
from mimic.retargeting.live_follower import REACHED, LiveFollower
from mimic.retargeting.live_pose import ArmRows, Goal, LivePose
from mimic.retargeting.self_contacts import SelfContacts

HANDS = ("exact", "relative")
STATES = ("tracking", "nearest", "catching up", "approaching", "holding", "waiting", "disengaged")
_TIMEOUT = 0.2  # s without a sample, after which the follower is said to hold
_AT_LIMIT = 1e-3  # rad


class TeleoperationStatus(NamedTuple):
    """What the follower does.

    Attributes:
      state: one of `STATES`.
      reason: of a state that is not "tracking", in words; also that a sample was ignored.
      position_mm, rotation_deg: maximum error of the commanded hands; NaN while there is no goal.
    """

    state: str
    reason: str
    position_mm: float
    rotation_deg: float


class FollowerCommand(NamedTuple):
    """A command of the follower.

    Attributes:
      qpos: [joints] angles at the end of the tick [rad].
      gripper: in the units of the follower's range; None where the leader never gave one.
      status: what the follower does.
    """

    qpos: Float[np.ndarray, " joints"]
    gripper: float | None
    status: TeleoperationStatus


class Teleoperator:
    """Drives a follower so that its hand does what the leader's does, with the posture nearest to the leader's.

    Call `engage`, and `step` at each tick of the follower. Nothing compiles, and `step` raises no error for samples
    that are not finite, late, lost or out of order: the follower then holds its goal and says why.

    Args:
      leader: the arm that gives the motion; without a known hand, as a person's, the end of its last link leads. With
        None poses of the hands lead, as a headset gives them, and the posture is pulled to the follower's home pose.
      follower: the arm that is driven.
      hand: "exact" puts the hand where the leader's is; "relative" repeats the leader's motion since `engage`, from
        where the follower's hand was then (a clutch).
      base: for the follower's base in the leader's base frame: see `imitate_pose`.
      scale: factor on translations of the hand; about the leader's base with "exact".
      mirror: reflect the motion between left and right, for a follower that faces the operator.
      rate: ticks per second.
      limits: of the follower. Default: position and velocity of its model, and what `joint_limits` derives from them.
      velocity: [joints] or one number, maximum speed [rad/s], for a model that states none.
      metric: of postures.
      grippers: (closed, open) of the leader and of the follower, in the units of each.
      capsules: of the follower, from `fit_capsules`, to keep its links apart, see `SelfContacts`.

    Attributes:
      limits: of the follower.
      period: of a tick [s].
      is_engaged: whether the leader drives.
      engagements: number of times that the clutch was engaged.

    Raises:
      ValueError: an argument out of range, no velocity limit, a metric that is no weighted sum, or no ruckig.
    """

    def __init__(
        self,
        leader: Embodiment | None,
        follower: Embodiment,
        *,
        hand: Literal["exact", "relative"] = "exact",
        base: Any = None,
        scale: float = 1.0,
        mirror: bool = False,
        rate: float = 100.0,
        limits: JointLimits | None = None,
        velocity: Any = None,
        metric: MetricConfig | None = None,
        grippers: tuple[Sequence[float], Sequence[float]] = ((0.0, 1.0), (0.0, 1.0)),
        capsules: Capsules | None = None,
    ):
        check_choice("hand", hand, HANDS)
        for name, number in (("scale", scale), ("rate", rate)):
            if not (np.isfinite(number) and number > 0):
                raise ValueError(f"{name}: expected a finite number above 0, got {number}")
        self.period, self._is_relative = 1.0 / rate, hand == "relative"
        self.limits = limits or follower_limits(follower, velocity)
        self.leader, self.follower = leader, follower
        self._lower, self._upper = self.limits.position.T
        home, own = np.clip(follower.home, self._lower, self._upper), ArmRows(follower)
        where, mirrored = placement(base), np.array([1.0, -1.0 if mirror else 1.0, 1.0])
        self._to_base = mirrored[:, None] * where.rotation
        self._leads = HandLeader(follower, own, home, self._to_base) if leader is None else ArmLeader(leader)
        self._rows, leads = (self._leads.rows, own), self._leads.arm
        self._pairs = matched_hands(leads, follower)
        self._pose = LivePose(*self._rows, self._pairs, (metric or MetricConfig()).build(leads, follower))
        of_leader, of_follower = (rows.unit for rows in self._rows)
        self._factor = scale * of_leader / of_follower
        self._origin = where.rotation.T @ where.position / of_follower
        self._mirrored = np.tile(mirrored, len(self._pairs))[:, None] if mirror else None
        self._leader_hands, self._follower_hands = (
            rows.hand_rows(hands) for rows, hands in zip(self._rows, self._pairs.T, strict=True)
        )
        self._samples = Samples(self._leads, self.period)
        self._gripper = Gripper(*grippers, self.period)
        contacts = None if capsules is None else SelfContacts(follower, capsules)
        ways = [functools.partial(self._goal_ahead, way) for way in self._leads.ways]
        self._live = LiveFollower(self._pose, own, follower, self.limits, self.period, contacts, ways)
        self.engagements = 0
        self.reset(home)

    def reset(self, qpos: Float[np.ndarray, " joints"]) -> None:
        """Disengages, with the follower at rest at these angles [rad].

        Raises:
          ValueError: angles that are not finite or outside of the limits.
        """
        qpos = np.asarray(qpos, float)
        joints = self.follower.num_joints
        inside = qpos.shape == (joints,) and bool(np.all((qpos >= self._lower - 1e-6) & (qpos <= self._upper + 1e-6)))
        if not inside:
            raise ValueError(f"qpos: expected {joints} angles within the follower's limits [rad], got {qpos.tolist()}")
        self._live.reset(qpos)
        self.disengage()

    def engage(self) -> None:
        """Lets the next sample lead: with "relative" from here, with "exact" by an approach of limited speed."""
        self.is_engaged, self._anchor = True, None
        self._goal: Any = None  # or a `Goal`
        self.engagements += 1
        self._live.engage(is_near=self._is_relative)

    def disengage(self) -> None:
        """Brakes the follower, which then stays where it is."""
        self.is_engaged, self._goal = False, None
        self._samples.forget()

    @property
    def qpos(self) -> Float[np.ndarray, " joints"]:
        """The last command [rad]."""
        return self._live.qpos

    @property
    def leader_qpos(self) -> np.ndarray | None:
        """The last sample that counted; None before the first one since `engage`."""
        return None if self._goal is None else self._samples.last

    @property
    def goal(self) -> tuple[Float[np.ndarray, "hands 3"], Float[np.ndarray, "hands 3 3"]] | None:
        """Positions [m] and rotations that the follower's hands are driven to, in its base frame; None without one."""
        if self._goal is None:
            return None
        pairs = len(self._pairs)
        axes = self._goal.hands[pairs:].reshape(pairs, 3, 3)
        return self._goal.hands[:pairs] * self._rows[1].unit, np.swapaxes(axes, 1, 2)

    def step(self, leader_qpos: Any, gripper: float | None = None, time: float | None = None) -> FollowerCommand:
        """The command of the next tick.

        Args:
          leader_qpos: [leader_joints] angles [rad], or poses [hands, 4, 4] of the hands [m] where no arm leads; None
            where no sample arrived.
          gripper: of the leader, in the units of its range; None where unknown.
          time: of the sample [s], on a clock of the leader; None to take each sample as new.

        Raises:
          ValueError: another number of joints, which is an error of the program.
        """
        sample = self._samples.accept(leader_qpos, time)
        opening = self._gripper.step(gripper if self.is_engaged else None)
        if not self.is_engaged:
            status = TeleoperationStatus("disengaged", "engage() lets the leader drive", np.nan, np.nan)
            return FollowerCommand(self._live.brake(), opening, status)
        if sample is not None:
            self._goal = self._goal_of(sample)
        if self._goal is None:
            status = TeleoperationStatus("waiting", self._samples.reason or "no sample yet", np.nan, np.nan)
            return FollowerCommand(self._live.wait(), opening, status)
        return FollowerCommand(self._live.follow(self._goal), opening, self._status())

    def _goal_ahead(self, way: Way, angle: float) -> Goal:
        """The goal that the leader would have farther on."""
        return self._goal_of(way(self._samples.last, angle))

    def _goal_of(self, sample: np.ndarray) -> Goal:
        """The goal of a sample of the leader."""
        rows, pairs = self._leads.of_sample(sample).dot(self._to_base), len(self._pairs)
        hands = rows.take(self._leader_hands, axis=0)
        position, axes = hands[:pairs], hands[pairs:]  # parts of the same array
        position *= self._factor
        if not self._is_relative:
            position -= self._origin
            if self._mirrored is not None:
                axes *= self._mirrored
            return self._pose.goal(rows, hands)
        if self._anchor is None:
            self._anchor = hands.copy(), self._rows[1](self._live.path[None])[0].take(self._follower_hands, axis=0)
        then, start = self._anchor
        position += start[:pairs] - then[:pairs]
        # Rows are axes: the rotation since then, R R_then^T, acts on each axis of the start.
        of_pairs = (x.reshape(pairs, 3, 3) for x in (start[pairs:], then[pairs:], axes))
        of_start, of_then, of_now = of_pairs
        axes[:] = (of_start @ (of_then.swapaxes(1, 2) @ of_now)).reshape(-1, 3)
        return self._pose.goal(rows, hands)

    def _status(self) -> TeleoperationStatus:
        """What the follower does, and why."""
        live, reason = self._live, self._samples.reason
        errors = 1e3 * live.error.position, math.degrees(live.error.rotation)
        if self._samples.age > _TIMEOUT:
            return TeleoperationStatus("holding", reason or f"no sample for {self._samples.age:.1f} s", *errors)
        if not live.is_near:
            return TeleoperationStatus("approaching", reason or "on the way to a posture with this hand", *errors)
        if live.error.is_reached:
            return TeleoperationStatus("tracking", reason, *errors)
        if live.posture_error.is_reached or live.is_fastest:
            return TeleoperationStatus("catching up", reason or "the leader is faster than the limits", *errors)
        why = self._why_nearest()
        return TeleoperationStatus("nearest", f"{reason}; {why}" if reason else why, *errors)

    def _why_nearest(self) -> str:
        """What keeps the follower's posture from the goal, in words."""
        posture, (position, rotation) = self._live.posture, self._live.posture_error
        at_limit = (posture - self._lower < _AT_LIMIT) | (self._upper - posture < _AT_LIMIT)
        names = ", ".join(np.array(self.follower.joint_names)[at_limit])
        why = f"{names} at the limit" if names else "out of reach" if position > REACHED[0] else "rotation not free"
        why = f"{self._live.held_apart} would touch" if self._live.held_apart else why
        return f"{why}: the nearest hand is {1e3 * position:.0f} mm and {np.degrees(rotation):.0f} deg away"
