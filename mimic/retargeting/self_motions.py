"""Ways of a redundant arm past times at which a path has no exact hand, through all postures that it can reach in time.

The postures of a redundant arm with one hand pose form curves, its self-motions. A path of nearest postures may arrive
at a time from which the arm cannot go on fast enough, although it could with an earlier change of posture. Here many
postures move at once: from one time to the next each follows the hand with the least change, and spreads along its
curve as far as the velocity limits let it. So the postures that the arm can reach are known at each time, up to the
distance between them, until one of them is at the path again.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from mimic.arms.embodiment import Embodiment
from mimic.arms.pose_limits import continuous_joints, motion_limits
from mimic.retargeting.hand_speeds import hands_and_jacobians
from mimic.retargeting.hand_target import POSITION_TOLERANCE, ROTATION_TOLERANCE
from mimic.retargeting.pose import wrap_angles

_AHEAD = 32, 128  # times before those without an exact hand at which the arm may begin to leave the path
_FRACTIONS = 1.0, 0.5  # of the part of its curve to which a posture may go from one time to the next
_APART, _MOST = 0.25, 600  # of the maximum change, between postures that are kept; and how many are kept at most
_CLOSE = 0.3  # of the tolerances of an exact hand, for rounding to single precision
_MARGIN = 1 - 1e-4  # of the maximum change
_STEPS = 2  # of Newton's method, back to the hand
_SINGULAR = 1e-9  # damping of J J^T, in squared changes of the hand for the maximum change of the joints


class _Arm(NamedTuple):
    """An arm that moves in time.

    Attributes:
      arm: the embodiment.
      chosen: its hands that have a target.
      jump: maximum change of each joint from one time to the next [rad].
      lower, upper: limits of the joints [rad].
      continuous: joints that can rotate by a full revolution.
    """

    arm: Embodiment
    chosen: np.ndarray
    jump: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    continuous: np.ndarray

    @property
    def middle(self) -> np.ndarray:
        """Of the limits [rad], 0 without."""
        lower, upper = (np.where(np.isfinite(limit), limit, 0.0) for limit in (self.lower, self.upper))
        return (lower + upper) / 2


def past_failing_times(
    learner: Embodiment,
    chosen: np.ndarray,
    targets: Float[np.ndarray, "time hands 4 4"],
    path: Float[np.ndarray, "time joints"],
    exact: Bool[np.ndarray, " time"],
    jump: Float[np.ndarray, " joints"],
    possible: Bool[np.ndarray, " time"] | None = None,
    starts: Float[np.ndarray, "postures joints"] | None = None,
) -> Float[np.ndarray, "time joints"]:
    """The path with a way past each run of times without an exact hand, where one is found.

    Args:
      learner: an arm with more joints than its hands need.
      chosen: the hands that have a target.
      targets: their poses in the learner's base frame.
      path: joint angles [rad].
      exact: at which times of the path the hands are exact, within the limits.
      jump: maximum change of each joint from one time to the next [rad].
      possible: at which times a posture with exact hands is known; there is no search past others. Default None: all.
      starts: postures with which a way may begin at the first time; that of the path alone by default.
    """
    jump = _MARGIN * np.minimum(jump, np.pi)  # finite
    arm = _Arm(learner, chosen, jump, *motion_limits(learner), continuous_joints(learner))
    path, exact, start = np.array(path, float), np.array(exact), 0
    starts = np.concatenate([path[:1][exact[:1]], np.empty((0, len(jump))) if starts is None else starts])
    starts = starts[_within(arm, starts)]
    possible = np.ones(len(path), bool) if possible is None else possible
    while len(failing := start + np.flatnonzero(~exact[start:])):
        first = int(failing[0])
        start = first + int(np.argmax(np.append(exact[first:], True)))
        begins = dict.fromkeys(max(first - ahead, 0) for ahead in _AHEAD) if possible[first:start].all() else ()
        for begin in begins:
            reached = starts if begin == 0 else path[begin : begin + 1][exact[begin : begin + 1]]
            if len(reached) and (way := _way(arm, targets, path, exact, begin, first, reached)) is not None:
                path, start = way
                exact[begin:start] = True
                break
    return path


def _way(
    arm: _Arm, targets: np.ndarray, path: np.ndarray, exact: np.ndarray, begin: int, first: int, starts: np.ndarray
) -> tuple[np.ndarray, int] | None:
    """The path with another way from some postures on past its first failing time, and when it is on the path again.

    None where the arm cannot get past that time.
    """
    reached, parents = [starts], []
    for time in range(begin, len(path) - 1):
        if time >= first and exact[time + 1]:
            apart = wrap_angles(reached[-1] - path[time + 1], arm.continuous)
            for node in np.flatnonzero(np.all(np.abs(apart) <= arm.jump, axis=1)):
                rest = path[time + 1 :] + (reached[-1][node] - path[time + 1] - apart[node])  # full revolutions
                if _within(arm, rest).all():
                    return np.concatenate([path[:begin], _traced(reached, parents, int(node)), rest]), time + 1
        qpos, origin = _next(arm, targets[time + 1], reached[-1])
        if not len(qpos):
            return None
        reached.append(qpos)
        parents.append(origin)
    return np.concatenate([path[:begin], _traced(reached, parents, 0)]), len(path)


def _traced(reached: list[np.ndarray], parents: list[np.ndarray], node: int) -> np.ndarray:
    """The postures on the way to one of the last ones."""
    way = [reached[-1][node]]
    for postures, origin in zip(reached[-2::-1], parents[::-1], strict=True):
        node = int(origin[node])
        way.append(postures[node])
    return np.array(way[::-1])


def _next(arm: _Arm, target: np.ndarray, qpos: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Postures that can be reached from some until the next time, and from which of these."""
    near, jacobian, good = _at_hand(arm, target, qpos)
    usable = np.abs(near - qpos).max(axis=1) < 1
    origin, near, jacobian = np.flatnonzero(usable), near[usable], jacobian[usable]
    change, ways = (near - qpos[origin]) / arm.jump, []
    free = np.swapaxes(np.linalg.svd(jacobian)[2][:, jacobian.shape[1] :], 0, 1)  # in which the hands stand
    for direction in np.concatenate([free, -free]):
        # The least change may be too large for a joint that another posture of the curve moves less.
        with np.errstate(divide="ignore", invalid="ignore"):
            enter, leave = ((side * np.sign(direction) - change) / direction for side in (-1, 1))
        enter = np.clip(np.where(direction == 0, -np.inf, enter).max(axis=1, keepdims=True), 0, None)
        leave = np.where(direction == 0, np.inf, leave).min(axis=1, keepdims=True).clip(enter)
        ways += [near + (enter + part * (leave - enter)) * direction * arm.jump for part in _FRACTIONS]
    spread, _, inside = _at_hand(arm, target, np.concatenate(ways))
    postures, origin = np.concatenate([near, spread]), np.tile(origin, len(ways) + 1)
    good = np.concatenate([good[usable], inside]) & np.all(np.abs(postures - qpos[origin]) <= arm.jump, axis=1)
    postures, origin = postures[good], origin[good]
    order = np.argsort(
        np.abs(postures[:, arm.continuous] - arm.middle[arm.continuous]).sum(axis=1)
    )  # least wound first
    postures, origin = postures[order], origin[order]
    cells = np.round(wrap_angles(postures, arm.continuous) / (_APART * arm.jump)).astype(int)
    first = np.unique(cells, axis=0, return_index=True)[1]
    first = first[:: -(-len(first) // _MOST) or 1]
    return postures[first], origin[first]


def _at_hand(arm: _Arm, target: np.ndarray, qpos: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Postures with these hands near some, by least changes relative to the maximum ones.

    It also returns the hands' changes for the maximum change of each joint, [postures, rows, joints], and whether the
    hands are exact, within the limits.
    """
    jacobian, error = _jacobian_and_error(arm, target, qpos)
    for _ in range(_STEPS):
        square = jacobian @ np.swapaxes(jacobian, 1, 2) + _SINGULAR * np.eye(jacobian.shape[1])
        change = np.swapaxes(jacobian, 1, 2) @ np.linalg.solve(square, error[..., None])
        qpos = qpos - arm.jump * change[..., 0]
        jacobian, error = _jacobian_and_error(arm, target, qpos)
    apart = np.linalg.norm(error.reshape(len(qpos), len(arm.chosen), 2, 3), axis=-1).max(axis=1)
    exact = np.all(apart <= _CLOSE * np.array([POSITION_TOLERANCE, ROTATION_TOLERANCE]), axis=1)
    return qpos, jacobian, exact & _within(arm, qpos)


def _jacobian_and_error(arm: _Arm, target: np.ndarray, qpos: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Changes of the hands for the maximum change of each joint, and [postures, rows] their small errors [m, rad]."""
    poses, jacobian = hands_and_jacobians(arm.arm, qpos)
    poses = poses[:, arm.chosen]
    apart = poses[..., :3, :3] @ np.swapaxes(target[:, :3, :3], -1, -2)
    skew = (apart - np.swapaxes(apart, -1, -2)) / 2
    rotation = np.stack([skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]], axis=-1)
    error = np.concatenate([poses[..., :3, 3] - target[:, :3, 3], rotation], axis=-1)
    rows = 6 * len(arm.chosen)
    jacobian = jacobian[:, arm.chosen].reshape(len(qpos), rows, len(arm.jump)) * arm.jump
    return jacobian, error.reshape(len(qpos), rows)


def _within(arm: _Arm, qpos: np.ndarray) -> Bool[np.ndarray, " postures"]:
    return np.all((qpos >= arm.lower) & (qpos <= arm.upper), axis=1)
