"""Live teleoperation: a leader arm, a person or a hand drives a follower of another embodiment, tick by tick.

Each tick has three stages. A sample of the leader is checked, and gives a goal of the follower's hand. The posture
takes steps to this goal within the velocity limits, see `mimic.retargeting.live_pose`; it never jumps to another
branch. The command follows the posture by Ruckig's online trajectories, within all limits and always able to stop.
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
from mimic.base.distribution import install_command
from mimic.control.limits import JointLimits, joint_limits
from mimic.metric.config import MetricConfig
from mimic.retargeting.branch_search import BranchSearch
from mimic.retargeting.hand_target import matched_hands, placement
from mimic.retargeting.leaders import ArmLeader, HandLeader, Samples
from mimic.retargeting.live_pose import FAR, NEAR, ArmRows, Goal, LivePose
from mimic.retargeting.self_contacts import Near, SelfContacts

HANDS = ("exact", "relative")
STATES = ("tracking", "nearest", "catching up", "approaching", "holding", "waiting", "disengaged")
_TOLERANCE = 1e-3, np.radians(0.5)  # m, rad: hands that are nearer count as reached
_STEP_TIME, _MAX_STEPS = 0.015, 5  # s of a tick for each step of the posture, and steps at most
_TIMEOUT = 0.2  # s without a sample, after which the follower is said to hold
_FREE, _SPEED_TIME = 0.8, 0.03  # of the velocity limits: below, the path's speed counts, smoothed over this time [s]
_APPROACH, _OVERTIME = 0.5, 1.25  # of the velocity limits, after `engage`; of the time that a posture is away
_AHEAD = 0.05  # s, the shortest of the trajectories of which a tick takes the beginning
_BRAKING = 0.5  # of twice the acceleration: what a joint needs to stop before its limit
_GRIPPER_TIME = 0.25  # s at least from closed to open
_STUCK = 0.3  # s with a hand that is not reached, after which another branch is searched
_LINE, _DETOUR = 16, 1.1  # points of a straight way to another branch; it may increase the hand's cost so much
_SLOWING, _RETREAT = 0.1, 0.05  # s in which links that come near each other lose 63 % of the room; m/s apart, at most
_AT_WALL = 1e-6  # m
_BACKED = 4  # times that a step which goes too far is halved
_LEAD, _CORNER = 1.0, 0.03  # ticks that the path leads the command, where links have less room [chain lengths]


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
        self._gripper = _Gripper(*grippers, self.period)
        self._limiter = _Limiter(self.limits, self.period)
        self._steps = int(np.clip(np.ceil(self.period / _STEP_TIME), 1, _MAX_STEPS))
        self._smoothing = float(1 - np.exp(-self.period / _SPEED_TIME))
        self._reach = self.limits.velocity * self.period
        self._contacts = None if capsules is None else SelfContacts(follower, capsules)
        self._branches = BranchSearch(self._pose, own, follower, self.limits.position, self._contacts)
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
        self._limiter.start(np.clip(qpos, self._lower, self._upper))
        self.disengage()

    def engage(self) -> None:
        """Lets the next sample lead: with "relative" from here, with "exact" by an approach of limited speed."""
        self.is_engaged, self._anchor = True, None
        self._goal: Any = None  # or a `Goal`
        self.engagements += 1
        self._posture = self._path = self._limiter.qpos
        self._speed, self._posture_rows, self._is_reached = np.zeros_like(self._path), None, True
        self._left = FAR
        self._is_near, self._stuck, self._searched, self._is_chosen = self._is_relative, 0.0, None, False
        self._pace, self._time_left = 1.0 if self._is_relative else _APPROACH, np.inf
        self._cost, self._allowed = 0.0, np.inf  # of the hand on the way to another branch
        self._held_apart = ""  # links of the follower that hold its posture back

    def disengage(self) -> None:
        """Brakes the follower, which then stays where it is."""
        self.is_engaged, self._goal = False, None
        self._samples.forget()

    @property
    def qpos(self) -> Float[np.ndarray, " joints"]:
        """The last command [rad]."""
        return self._limiter.qpos

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
            return FollowerCommand(self._limiter.brake(), opening, status)
        if sample is not None:
            self._goal = self._goal_of(sample)
        if self._goal is None:
            status = TeleoperationStatus("waiting", self._samples.reason or "no sample yet", np.nan, np.nan)
            return FollowerCommand(self._limiter.step(self._path, self._speed), opening, status)
        self._advance(self._goal)
        qpos = self._limiter.step(self._path, self._speed)
        rows = self._rows[1](np.array([self._posture, qpos]))
        self._posture_rows = rows[:1]
        if not self._is_near:
            self._cost = float(self._pose.cost(self._goal, rows[1:])[0])
        return FollowerCommand(qpos, opening, self._status(*self._pose.errors(self._goal, rows)))

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
            self._anchor = hands.copy(), self._rows[1](self._path[None])[0].take(self._follower_hands, axis=0)
        then, start = self._anchor
        position += start[:pairs] - then[:pairs]
        # Rows are axes: the rotation since then, R R_then^T, acts on each axis of the start.
        of_pairs = (x.reshape(pairs, 3, 3) for x in (start[pairs:], then[pairs:], axes))
        of_start, of_then, of_now = of_pairs
        axes[:] = (of_start @ (of_then.swapaxes(1, 2) @ of_now)).reshape(-1, 3)
        return self._pose.goal(rows, hands)

    def _advance(self, goal: Goal) -> None:
        """Moves the posture towards the goal, and the path towards the posture."""
        if self._waits():
            self._speed = 0 * self._speed
            return
        self._limit_approach()
        reach, posture, rows, last = self._reach, self._posture[None], self._posture_rows, self._posture
        if self._is_near:
            reach = self._pace * reach
        lower, upper = np.maximum(self._lower, last - reach), np.minimum(self._upper, last + reach)
        self._held_apart = ""
        for _ in range(self._steps):
            near, walls = self._walls(posture[0], self._steps)
            before, posture = posture, self._pose.step(goal, posture, lower, upper, NEAR, self._left, rows, walls)
            self._hold_apart(near, walls, posture[0] - before[0])
            if near is not None:
                posture = self._backed(before[0], posture[0], near)[None]
            rows = None
        self._posture = posture[0]
        moved = self._posture - last
        fraction = float(np.abs(moved / reach).max())
        # A path that goes as fast as it may ends at once, where the command must be able to stop, as one at a wall.
        is_free = self._is_near and fraction < _FREE and not self._held_apart
        kept = 1 - self._smoothing
        self._speed = kept * self._speed + self._smoothing / self.period * moved if is_free else 0 * moved
        self._search(goal)
        if self._searched is not None and not self._is_near:
            return  # where an approach goes is not known yet
        if self._is_near:
            self._path = self._posture
        else:
            self._approach()

    def _approach(self) -> None:
        """Moves the path towards a posture that it has not reached."""
        moved = self._posture - self._path
        fraction = self._ticks_away(self._posture)
        part = moved / max(fraction, 1.0) / self._steps
        for _ in range(self._steps):
            near, walls = self._walls(self._path, self._steps)
            if self._hold_apart(near, walls, part):
                self._follow_from_here()  # by steps that know the walls
                return
            self._path = self._path + part
        if fraction <= 1:
            self._path, self._is_near = self._posture, True

    def _ticks_away(self, posture: np.ndarray) -> float:
        """Ticks that the path takes to a posture, at its pace."""
        return float(np.abs((posture - self._path) / (self._pace * self._reach)).max())

    def _limit_approach(self) -> None:
        """Ends an approach when its time is over, or when the leader moved on so that the hand only loses by it."""
        self._time_left -= self.period
        is_over = self._time_left <= 0
        if is_over or (self._is_near and self._is_reached):
            self._pace = 1.0
        if not self._is_near and (is_over or self._cost > self._allowed):
            self._follow_from_here()

    def _follow_from_here(self) -> None:
        """Gives up the posture that the path has not reached."""
        self._posture, self._posture_rows, self._is_near = self._path, None, True

    def _backed(self, before: np.ndarray, after: np.ndarray, near: Near) -> np.ndarray:
        """A step near walls, or a part of it that goes no deeper: walls may be curved."""
        minimum = min(near.room.min(), 0.0) - _AT_WALL
        for _ in range(_BACKED):
            now = self._contacts and self._contacts.near(after)
            if now is None or now.room.min() >= minimum:
                return after
            after = (before + after) / 2
        return before

    def _waits(self) -> bool:
        """Whether the path waits for the command, which would cut a corner between links that are near each other."""
        if self._contacts is None or np.all(np.abs(self._path - self._limiter.qpos) <= _LEAD * self._reach):
            return False
        near = [self._contacts.near(qpos) for qpos in (self._path, self._limiter.qpos)]
        return any(x is not None and x.room.min() < _CORNER * self._rows[1].unit for x in near)

    def _walls(self, qpos: np.ndarray, steps: int = 1) -> tuple[Near | None, Any]:
        """Links near each other in a posture, and how far a step of a tick may change their distances."""
        near = None if self._contacts is None else self._contacts.near(qpos)
        if near is None:
            return None, None
        bounds = np.minimum(-self.period / _SLOWING * near.room, _RETREAT * self.period) / steps
        return near, (near.gradient, bounds)

    def _hold_apart(self, near: Near | None, walls: Any, moved: np.ndarray) -> bool:
        """Notes whether a step is at a wall, or beyond."""
        is_held = near is not None and bool(np.any(walls[0] @ moved <= walls[1] + _AT_WALL))
        if self._contacts is not None and near is not None and is_held:
            self._held_apart = self._contacts.names(near)
        return is_held

    def _search(self, goal: Goal) -> None:
        """Searches other branches at the start of an approach, and while the hand is not reached, in each tick."""
        if self._searched is None:
            is_well = self._is_reached or not self._is_near
            self._stuck = 0.0 if is_well else self._stuck + self.period
            if self._is_near and self._stuck < _STUCK:
                return
            if not self._is_near and self._is_chosen:
                return  # on its way
            now = self._posture, lambda: self._goal
            search, ahead = self._branches, lambda way, angle: self._goal_of(way(self._samples.last, angle))
            ways = [functools.partial(ahead, way) for way in self._leads.ways]
            self._searched = search.search(*now) if self._is_near else search.search_ahead(*now, ways)
        found = None
        for _ in range(self._steps):
            found = found or next(self._searched)
        if found is None:
            return
        self._searched, self._stuck, self._is_chosen = None, 0.0, True
        posture = self._turned(found[0])
        if not self._is_near or self._leads_there(goal, posture, found[1]):
            self._posture, self._posture_rows, self._is_near = posture, None, False
            self._time_left = _OVERTIME * self.period * self._ticks_away(posture)

    def _turned(self, posture: np.ndarray) -> np.ndarray:
        """The posture with each joint within half a turn from the path's, where its range has both."""
        turned = posture - 2 * np.pi * np.round((posture - self._path) / (2 * np.pi))
        return np.where((turned >= self._lower) & (turned <= self._upper), turned, posture)

    def _leads_there(self, goal: Goal, posture: np.ndarray, cost: float) -> bool:
        """Whether another branch is better, and the hand does not go away from its goal on the straight way there."""
        line = self._posture + np.linspace(0, 1, _LINE)[:, None] * (posture - self._posture)
        costs = self._pose.cost(goal, self._rows[1](line))
        self._allowed = _DETOUR * float(costs[0])
        is_better = cost < 0.5 * costs[0] and costs.max() <= self._allowed
        return is_better and not (self._contacts and self._contacts.touch(line[1:]).any())

    def _status(self, positions: Sequence[float], rotations: Sequence[float]) -> TeleoperationStatus:
        """What the follower does, and why, from errors [m, rad] of the hands of the posture and of the command."""
        near, turned = _TOLERANCE
        reached = [x <= near and y <= turned for x, y in zip(positions, rotations, strict=True)]
        self._is_reached, self._left = reached[0], positions[0] / self._rows[1].unit
        errors, reason = (1e3 * positions[1], math.degrees(rotations[1])), self._samples.reason
        if self._samples.age > _TIMEOUT:
            return TeleoperationStatus("holding", reason or f"no sample for {self._samples.age:.1f} s", *errors)
        if not self._is_near:
            return TeleoperationStatus("approaching", reason or "on the way to a posture with this hand", *errors)
        if reached[1]:
            return TeleoperationStatus("tracking", reason, *errors)
        if reached[0]:
            return TeleoperationStatus("catching up", reason or "the leader is faster than the limits", *errors)
        position, rotation = positions[0], rotations[0]
        at_limit = (self._posture - self._lower < 1e-3) | (self._upper - self._posture < 1e-3)
        names = ", ".join(np.array(self.follower.joint_names)[at_limit])
        why = f"{names} at the limit" if names else "out of reach" if position > _TOLERANCE[0] else "rotation not free"
        why = f"{self._held_apart} would touch" if self._held_apart else why
        why = f"{why}: the nearest hand is {1e3 * position:.0f} mm and {np.degrees(rotation):.0f} deg away"
        why = f"{reason}; {why}" if reason else why
        return TeleoperationStatus("nearest", why, *errors)


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


class _Gripper:
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


class _Limiter:
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
