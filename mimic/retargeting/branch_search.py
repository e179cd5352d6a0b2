"""Searches of a live follower for another branch of postures, a step at a time.

Postures with the same hand may lie on branches that no continuous motion connects, as a wrist and its flip. At the
start the nearest to the leader's posture may soon be at a limit, so a search can look ahead: each branch follows
the leader's joints, one after the other both ways within its range, and the branch that follows best is taken.
"""

from collections.abc import Callable, Generator, Iterator, Sequence

import numpy as np
from jaxtyping import Float

from mimic.arms.embodiment import Embodiment
from mimic.retargeting.live_pose import FAR, ArmRows, Goal, LivePose
from mimic.retargeting.self_contacts import SelfContacts

_LANES, _STEPS = 12, 25  # random postures, and steps of each
_LANES_ON_THE_WAY = 4  # while the follower follows, where a tick must not take long
_STRIDE = 0.5  # rad, the longest step of a joint
_ALIKE, _AS_GOOD = 0.3, 2e-6  # rad: postures of one branch; cost above the least of branches that are compared
_MAX_BRANCHES = 4
_AHEAD, _STEPS_AHEAD = (0.15, 0.3, 0.45, 0.6, 0.8, 1.0), 2  # rad that a joint of the leader turns, and steps for each
_TOUCHING = 10.0  # added to the cost of postures in which links touch
_PERPENDICULAR = 0.1  # cosine of axes that count as that


class BranchSearch:
    """Searches branches of a follower's postures.

    Args:
      pose, rows: of its steps.
      follower: the arm.
      joint_range: [joints, 2] of its joints [rad].
      contacts: of its links, if these are checked; postures in which they touch come last.
    """

    def __init__(
        self,
        pose: LivePose,
        rows: ArmRows,
        follower: Embodiment,
        joint_range: Float[np.ndarray, "joints 2"],
        contacts: SelfContacts | None = None,
    ):
        self._pose, self._follower, self._range, self._contacts = pose, rows, np.asarray(joint_range, float), contacts
        self._middle = np.clip(self._range, -2 * np.pi, 2 * np.pi).mean(axis=1)
        self._wrists = list(_wrists(follower))
        self._random = np.random.default_rng(0)

    def search(
        self, posture: Float[np.ndarray, " joints"], goal: Callable[[], Goal]
    ) -> Iterator[tuple[np.ndarray, float] | None]:
        """The best posture [rad] of random ones and this one, and its cost; None before, at each tick.

        Args:
          posture: that is one of them [rad].
          goal: gives the goal of the next step.
        """
        lanes = yield from self._settled(self._spread(posture, _LANES_ON_THE_WAY), goal)
        costs = self._costs(goal(), lanes)
        yield lanes[costs.argmin()], float(costs.min())

    def search_ahead(
        self,
        posture: Float[np.ndarray, " joints"],
        goal: Callable[[], Goal],
        ways: Sequence[Callable[[float], Goal]],
    ) -> Iterator[tuple[np.ndarray, float] | None]:
        """As `search`, with the branch that follows the leader's next motion best.

        Args:
          posture, goal: see `search`.
          ways: goals that the leader would have after each of its next motions, by how far it moves [rad].
        """
        lanes = yield from self._settled(self._spread(posture), goal)
        best = lanes[self._costs(goal(), lanes).argmin()]
        flipped = self._flipped(best)
        lanes = yield from self._settled(np.concatenate([flipped, self._spread(best)[len(flipped) :]]), goal)
        lanes = self._branches(lanes, self._costs(goal(), lanes))
        losses = np.zeros(len(lanes))
        for way in ways if len(lanes) > 1 else ():
            ahead = lanes
            for angle in _AHEAD:
                of_way = way(angle)
                for _ in range(_STEPS_AHEAD):
                    ahead = self._step(of_way, ahead)
                losses += self._pose.cost(of_way, self._follower(ahead))
                yield None
        costs = self._pose.cost(goal(), self._follower(lanes))
        best = losses.argmin()
        yield lanes[best], float(costs[best])

    def _costs(self, goal: Goal, lanes: np.ndarray) -> np.ndarray:
        costs = self._pose.cost(goal, self._follower(lanes))
        return costs if self._contacts is None else costs + _TOUCHING * self._contacts.touch(lanes)

    def _spread(self, posture: np.ndarray, lanes: int = _LANES) -> np.ndarray:
        """Random postures [lanes, joints], of which the first is this one."""
        low, high = np.clip(self._range, -np.pi, np.pi).T
        return np.concatenate([posture[None], self._random.uniform(low, high, (lanes - 1, len(low)))])

    def _flipped(self, posture: np.ndarray) -> np.ndarray:
        """This posture and those with one wrist flipped, which leaves the hand's rotation [1 + wrists, joints]."""
        found = [posture]
        for joint, straight in self._wrists:
            other = posture.copy()
            outer = [joint - 1, joint + 1]
            other[joint] = 2 * straight - posture[joint]
            other[outer] += np.where(posture[outer] > self._middle[outer], -np.pi, np.pi)
            other -= 2 * np.pi * np.round((other - self._middle) / (2 * np.pi))
            found.append(np.clip(other, *self._range.T))
        return np.array(found[:_LANES])

    def _settled(self, lanes: np.ndarray, goal: Callable[[], Goal]) -> Generator[None, None, np.ndarray]:
        for _ in range(_STEPS):
            lanes = self._step(goal(), lanes)
            yield None
        return lanes

    def _step(self, goal: Goal, lanes: np.ndarray) -> np.ndarray:
        lower, upper = self._range.T
        return self._pose.step(goal, lanes, np.maximum(lower, lanes - _STRIDE), np.minimum(upper, lanes + _STRIDE), FAR)

    def _branches(self, lanes: np.ndarray, costs: np.ndarray) -> np.ndarray:
        """The best posture of each branch that is about as good as the best of all."""
        chosen: list[np.ndarray] = []
        for lane in np.argsort(costs):
            is_new = all(np.abs(lanes[lane] - other).max() > _ALIKE for other in chosen)
            if is_new and costs[lane] <= costs.min() + _AS_GOOD:
                chosen.append(lanes[lane])
        return np.array(chosen[:_MAX_BRANCHES])


def _wrists(arm: Embodiment) -> Iterator[tuple[int, float]]:
    """Joints between two that turn about one axis at some angle, and this angle [rad]."""
    axes = np.asarray(arm.joint_axis, float)
    for joint in range(1, arm.num_joints - 1):
        before, axis, after = axes[joint - 1 : joint + 2]
        in_line = arm.joint_parent[joint] == joint - 1 and arm.joint_parent[joint + 1] == joint
        if in_line and max(abs(before @ axis), abs(after @ axis)) < _PERPENDICULAR:
            yield joint, float(np.arctan2(axis @ np.cross(after, before), after @ before))
