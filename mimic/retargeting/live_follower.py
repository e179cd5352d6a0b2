"""Moves a live follower to a goal of its hand, tick by tick.

The posture takes steps to the goal within the velocity limits, see `mimic.retargeting.live_pose`; it never jumps to
another branch. The path is the posture, or on the way to one of another branch. The command follows the path within all
limits, see `mimic.retargeting.follower_limits`.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from mimic.arms.embodiment import Embodiment
from mimic.control.limits import JointLimits
from mimic.retargeting.branch_search import BranchSearch
from mimic.retargeting.follower_limits import Limiter
from mimic.retargeting.live_pose import FAR, NEAR, ArmRows, Goal, LivePose
from mimic.retargeting.self_contacts import Near, SelfContacts

REACHED = 1e-3, np.radians(0.5)  # m, rad: hands that are nearer count as reached
_STEP_TIME, _MAX_STEPS = 0.015, 5  # s of a tick for each step of the posture, and steps at most
_FASTEST = 1 - 1e-6  # of the velocity limits
_FREE, _SPEED_TIME = 0.8, 0.03  # of the velocity limits: below, the path's speed counts, smoothed over this time [s]
_APPROACH = 0.5  # of the velocity limits, until the first goal after `engage` is reached: nobody knows the way there
_OVERTIME = 1.25  # of the time that a posture is away
_STUCK = 0.3  # s with a hand that is not reached, after which another branch is searched
_LINE, _DETOUR = 16, 2.0  # points of a straight way to another branch; it may increase the hand's cost so much
_SLOWING, _RETREAT = 0.1, 0.05  # s in which links that come near each other lose 63 % of the room; m/s apart, at most
_AT_WALL = 1e-6  # m
_BACKED = 4  # times that a step which goes too far is halved
_LEAD, _CORNER = 1.0, 0.03  # ticks that the path leads the command, where links have less room [chain lengths]


class HandError(NamedTuple):
    """Maximum distance [m] and angle [rad] of the hands from their goals."""

    position: float
    rotation: float

    @property
    def is_reached(self) -> bool:
        """Whether the hands count as at their goals."""
        return self.position <= REACHED[0] and self.rotation <= REACHED[1]


class LiveFollower:
    """A follower that moves to goals.

    Args:
      pose: steps of the posture.
      rows: the follower's kinematics.
      follower: the arm.
      limits: of the arm.
      period: of a tick [s].
      contacts: of its links, if these are kept apart.
      ways: goals that the leader would have after each of its next motions, by how far it moves [rad].

    Attributes:
      posture: [joints] angles that move to the goal [rad].
      path: [joints] the same, or on the way there.
      is_near: whether they are the same.
      is_fastest: whether the posture moves as fast as the limits let it.
      posture_error, error: of the posture's hands and of the command's, in the last tick.
      held_apart: links that hold the posture back; empty without.
    """

    def __init__(
        self,
        pose: LivePose,
        rows: ArmRows,
        follower: Embodiment,
        limits: JointLimits,
        period: float,
        contacts: SelfContacts | None,
        ways: Sequence[Callable[[float], Goal]],
    ):
        self._pose, self._rows, self._period, self._contacts, self._ways = pose, rows, period, contacts, ways
        self._lower, self._upper = limits.position.T
        self._limiter = Limiter(limits, period)
        self._steps = int(np.clip(np.ceil(period / _STEP_TIME), 1, _MAX_STEPS))
        self._smoothing = float(1 - np.exp(-period / _SPEED_TIME))
        self._reach = limits.velocity * period
        self._branches = BranchSearch(pose, rows, follower, limits.position, contacts)

    @property
    def qpos(self) -> Float[np.ndarray, " joints"]:
        """The last command [rad]."""
        return self._limiter.qpos

    def reset(self, qpos: Float[np.ndarray, " joints"]) -> None:
        """At rest at these angles [rad], which are within the limits."""
        self._limiter.start(np.clip(qpos, self._lower, self._upper))

    def engage(self, *, is_near: bool) -> None:
        """Starts from here: near the goals to come, or by an approach to them."""
        self.posture = self.path = self.qpos
        self._speed, self._posture_rows, self.posture_error = np.zeros_like(self.path), None, HandError(0.0, 0.0)
        self._left: float = FAR
        self.is_near, self._stuck, self._searched, self._is_chosen = is_near, 0.0, None, False
        self._pace, self._time_left = 1.0 if is_near else _APPROACH, np.inf
        self._cost, self._allowed = 0.0, np.inf  # of the hand on the way to another branch
        self.held_apart, self.is_fastest = "", False

    def brake(self) -> Float[np.ndarray, " joints"]:
        """The command of a tick in which the follower comes to rest [rad]."""
        return self._limiter.brake()

    def wait(self) -> Float[np.ndarray, " joints"]:
        """The command of a tick without a goal [rad]."""
        return self._limiter.step(self.path, self._speed)

    def follow(self, goal: Goal) -> Float[np.ndarray, " joints"]:
        """The command of a tick [rad]."""
        self._goal = goal
        self._advance()
        qpos = self._limiter.step(self.path, self._speed)
        rows = self._rows(np.array([self.posture, qpos]))
        self._posture_rows = rows[:1]
        if not self.is_near:
            self._cost = float(self._pose.cost(goal, rows[1:])[0])
        self.posture_error, self.error = map(HandError, *self._pose.errors(goal, rows))
        self._left = self.posture_error.position / self._rows.unit
        return qpos

    def _advance(self) -> None:
        """Moves the posture towards the goal, and the path towards the posture."""
        if self._waits():
            self._speed = 0 * self._speed
            return
        self._limit_approach()
        reach, posture, rows, last = self._reach, self.posture[None], self._posture_rows, self.posture
        if self.is_near:
            reach = self._pace * reach
        lower, upper = np.maximum(self._lower, last - reach), np.minimum(self._upper, last + reach)
        self.held_apart = ""
        for _ in range(self._steps):
            near, walls = self._walls(posture[0])
            before, posture = posture, self._pose.step(self._goal, posture, lower, upper, NEAR, self._left, rows, walls)
            self._hold_apart(near, walls, posture[0] - before[0])
            if near is not None:
                posture = self._backed(before[0], posture[0], near)[None]
            rows = None
        self.posture = posture[0]
        moved = self.posture - last
        fraction = float(np.abs(moved / reach).max())
        self.is_fastest = fraction > _FASTEST
        # A path that goes as fast as it may ends at once, where the command must be able to stop, as one at a wall.
        is_free = self.is_near and fraction < _FREE and not self.held_apart
        kept = 1 - self._smoothing
        self._speed = kept * self._speed + self._smoothing / self._period * moved if is_free else 0 * moved
        self._search()
        if self._searched is not None and not self.is_near:
            return  # where an approach goes is not known yet
        if self.is_near:
            self.path = self.posture
        else:
            self._approach()

    def _approach(self) -> None:
        """Moves the path towards a posture that it has not reached."""
        moved = self.posture - self.path
        fraction = self._ticks_away(self.posture)
        part = moved / max(fraction, 1.0) / self._steps
        for _ in range(self._steps):
            near, walls = self._walls(self.path)
            if self._hold_apart(near, walls, part):
                self._follow_from_here()  # by steps that know the walls
                return
            self.path = self.path + part
        if fraction <= 1:
            self.path, self.is_near = self.posture, True

    def _ticks_away(self, posture: np.ndarray) -> float:
        """Ticks that the path takes to a posture, at its pace."""
        return float(np.abs((posture - self.path) / (self._pace * self._reach)).max())

    def _limit_approach(self) -> None:
        """Ends an approach when its time is over, or when the leader moved on so that the hand only loses by it."""
        self._time_left -= self._period
        is_over = self._time_left <= 0
        if is_over or (self.is_near and self.posture_error.is_reached):
            self._pace = 1.0
        if not self.is_near and (is_over or self._cost > self._allowed):
            self._follow_from_here()

    def _follow_from_here(self) -> None:
        """Gives up the posture that the path has not reached."""
        self.posture, self._posture_rows, self.is_near = self.path, None, True

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
        if self._contacts is None or np.all(np.abs(self.path - self._limiter.qpos) <= _LEAD * self._reach):
            return False
        near = [self._contacts.near(qpos) for qpos in (self.path, self._limiter.qpos)]
        return any(x is not None and x.room.min() < _CORNER * self._rows.unit for x in near)

    def _walls(self, qpos: np.ndarray) -> tuple[Near | None, Any]:
        """Links near each other in a posture, and how far a step may change their distances."""
        near = None if self._contacts is None else self._contacts.near(qpos)
        if near is None:
            return None, None
        bounds = np.minimum(-self._period / _SLOWING * near.room, _RETREAT * self._period) / self._steps
        return near, (near.gradient, bounds)

    def _hold_apart(self, near: Near | None, walls: Any, moved: np.ndarray) -> bool:
        """Notes whether a step is at a wall, or beyond."""
        is_held = near is not None and bool(np.any(walls[0] @ moved <= walls[1] + _AT_WALL))
        if self._contacts is not None and near is not None and is_held:
            self.held_apart = self._contacts.names(near)
        return is_held

    def _search(self) -> None:
        """Searches other branches at the start of an approach, and while the hand is not reached, in each tick."""
        if self._searched is None:
            is_well = self.posture_error.is_reached or self.is_fastest or not self.is_near
            self._stuck = 0.0 if is_well else self._stuck + self._period
            if self.is_near and self._stuck < _STUCK:
                return
            if not self.is_near and self._is_chosen:
                return  # on its way
            search, now = self._branches, (self.posture, lambda: self._goal)
            self._searched = search.search(*now) if self.is_near else search.search_ahead(*now, self._ways)
        found = None
        for _ in range(self._steps):
            found = found or next(self._searched)
        if found is None:
            return
        self._searched, self._stuck, self._is_chosen = None, 0.0, True
        posture = self._turned(found[0])
        if not self.is_near or self._leads_there(posture, found[1]):
            self.posture, self._posture_rows, self.is_near = posture, None, False
            self._time_left = _OVERTIME * self._period * self._ticks_away(posture)

    def _turned(self, posture: np.ndarray) -> np.ndarray:
        """The posture with each joint within half a turn from the path's, where its range has both."""
        turned = posture - 2 * np.pi * np.round((posture - self.path) / (2 * np.pi))
        return np.where((turned >= self._lower) & (turned <= self._upper), turned, posture)

    def _leads_there(self, posture: np.ndarray, cost: float) -> bool:
        """Whether another branch is better, and the hand does not go far from its goal on the straight way there."""
        line = self.posture + np.linspace(0, 1, _LINE)[:, None] * (posture - self.posture)
        costs = self._pose.cost(self._goal, self._rows(line))
        self._allowed = _DETOUR * float(costs[0])
        is_better = cost < 0.5 * costs[0] and costs.max() <= self._allowed
        return is_better and not (self._contacts and self._contacts.touch(line[1:]).any())
