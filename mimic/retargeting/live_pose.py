"""Steps of a live follower towards the leader's hand, and of the postures with this hand towards the leader's.

All is NumPy in double precision, for several postures at once, so that a step needs no compilation. Points and unit
vectors that move with the joints are the rows of one table. Each row is pulled to a target with a stiffness, and a step
minimises the sum of the pulls within a box of joint angles: Gauss-Newton's method. The hand's position is pulled most,
then its rotation, then the links, so that a hand out of reach gives up its rotation before its position.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from mimic.arms.embodiment import Embodiment
from mimic.metric.distance import PARTS, Metric

_ROTATION, _POSTURE, _DAMPING = 3e-4, 3e-7, 1e-7  # weights of a step; the hand's position in chain lengths has 1
# Damping per chain length of the pull on hands: the second derivative of their position, which Gauss-Newton's method
# leaves out, is at most the pull times the distance from a joint. Without it hands out of reach oscillate.
_LEVER = 0.5
_SMOOTHING = 1e-2  # chain lengths below which a distance of links is a square
FAR, NEAR = 0.3, 0.03  # chain lengths, the longest pulls on hands: of a search, and of a follower
_PASSES = 3  # of a step, each without the joints that the last one moved to the edge of the box


class Goal(NamedTuple):
    """What a follower is pulled to, in its base frame and in its chain lengths.

    Attributes:
      points: [leader_links, 3] positions of the leader's links, in its own chain lengths.
      rows: [rows, 3] of the follower's hand positions, link directions and hand axes.
      stiffness: [rows] of these pulls.
      position, axes: [pairs, 3] and [pairs, 3, 3] of the matched hands; their axes are rows.
    """

    points: Float[np.ndarray, "leader_links 3"]
    rows: Float[np.ndarray, "rows 3"]
    stiffness: Float[np.ndarray, " rows"]
    position: Float[np.ndarray, "pairs 3"]
    axes: Float[np.ndarray, "pairs 3 3"]


class Rows(NamedTuple):
    """Points and unit vectors of an arm, [lanes, number, 3] each, in its base frame and in chain lengths.

    Attributes:
      anchors, axes: of the joints.
      moving: link positions, hand positions, link directions, and hand axes.
    """

    anchors: np.ndarray
    axes: np.ndarray
    moving: np.ndarray


class ArmRows:
    """Kinematics of an arm as a table of rows; hands that the model does not know are the ends of its chains.

    Attributes:
      links, hands: their numbers.
      unit: chain length [m].
      knows_roll: whether the rotation of the hands about their z-axes is known.
    """

    def __init__(self, arm: Embodiment):
        self.unit, joints, self.links = float(arm.chain_length), arm.num_joints, arm.num_links
        axis, anchor = np.asarray(arm.joint_axis, float), np.asarray(arm.joint_anchor, float) / self.unit
        skew = np.cross(np.eye(3), axis[:, None])
        self._sine, self._versine = np.zeros((2, joints, 1, 4, 4))
        for matrix, part in ((self._sine, skew), (self._versine, skew @ skew)):
            matrix[:, 0, :3, :3], matrix[:, 0, :3, 3] = part, -(part @ anchor[..., None])[..., 0]
        self._parents, self.knows_roll = arm.joint_parent, bool(arm.hand_joint)
        positions, rotations, hand_joint = _hands(arm)
        self.hands = len(hand_joint)
        points = [anchor, arm.link_position / self.unit, positions / self.unit]
        directions = [axis, arm.link_rotation[:, :, 0], np.swapaxes(rotations, 1, 2).reshape(-1, 3)]
        order = points[0], directions[0], points[1], points[2], directions[1], directions[2]
        is_point = np.repeat([1.0, 0.0, 1.0, 1.0, 0.0, 0.0], [len(rows) for rows in order])
        self._zero = np.concatenate([np.concatenate(order), is_point[:, None]], axis=1)[:, None, :, None]
        of_rows = [*arm.link_joint, *hand_joint, *arm.link_joint, *np.repeat(hand_joint, 3)]
        self._frame = np.array([*range(joints), *range(joints), *of_rows]) + 1
        self._joints, self._is_point = joints, is_point[2 * joints :]
        self._moves = np.array([[_is_ancestor(arm, joint, row) for row in of_rows] for joint in range(joints)])[:, None]

    def __call__(self, qpos: Float[np.ndarray, "lanes joints"]) -> Rows:
        """The rows at joint angles [rad]."""
        angle = qpos.T[..., None, None]
        steps = _IDENTITY + np.sin(angle) * self._sine + (1 - np.cos(angle)) * self._versine
        frames = np.empty((self._joints + 1, len(qpos), 4, 4))
        frames[0] = _IDENTITY
        for joint, parent in enumerate(self._parents):
            np.matmul(frames[parent + 1], steps[joint], out=frames[joint + 1])
        rows = (frames[self._frame] @ self._zero)[..., :3, 0].swapaxes(0, 1)
        return Rows(rows[:, : self._joints], rows[:, self._joints : 2 * self._joints], rows[:, 2 * self._joints :])

    def hand(self, rows: Rows) -> tuple[np.ndarray, np.ndarray]:
        """Positions [lanes, hands, 3] and axes [lanes, hands, 3, 3], one a row."""
        position = rows.moving[:, self.links : self.links + self.hands]
        return position, rows.moving[:, 2 * self.links + self.hands :].reshape(len(position), self.hands, 3, 3)

    def jacobian(self, rows: Rows) -> Float[np.ndarray, "lanes joints 3 rows"]:
        """Derivatives of the moving rows with respect to the joint angles."""
        cross = (rows.axes @ _LEVI_CIVITA).reshape(*rows.axes.shape[:2], 3, 3)
        moments = cross @ rows.anchors[..., None]
        return (cross @ np.swapaxes(rows.moving, 1, 2)[:, None] - moments * self._is_point) * self._moves


_IDENTITY = np.eye(4)
_LEVI_CIVITA = np.cross(np.eye(3)[:, None], np.eye(3)).transpose(0, 2, 1).reshape(3, 9)


def _hands(arm: Embodiment) -> tuple[np.ndarray, np.ndarray, list[int]]:
    """Positions, rotations and joints of the hands; of an arm without known hands, the ends of its chains' last links.

    The z-axis is then along the last link.
    """
    if arm.hand_joint:
        return np.asarray(arm.hand_position, float), np.asarray(arm.hand_rotation, float), list(arm.hand_joint)
    last = [chain[-1] for chain in arm.chains]
    rotation = np.roll(np.asarray(arm.link_rotation, float)[last], -1, axis=2)
    ends = [arm.segment_end[max(i for i, link in enumerate(arm.segment_link) if link == of_chain)] for of_chain in last]
    return np.array(ends), rotation, [arm.link_joint[link] for link in last]


def _is_ancestor(arm: Embodiment, joint: int, other: int) -> bool:
    """Whether a joint moves what another one moves."""
    while other > joint:
        other = arm.joint_parent[other]
    return other == joint


class LivePose:
    """The pull of a leader's hand and posture on a follower.

    Args:
      leader, follower: the arms.
      pairs: [pairs, 2] of hands that match.
      metric: of constant weights, see `Metric.is_weighted_sum`.

    Raises:
      ValueError: another metric.
    """

    def __init__(self, leader: ArmRows, follower: ArmRows, pairs: np.ndarray, metric: Metric):
        if not metric.is_weighted_sum:
            raise ValueError("metric: expected a constant correspondence, constant weights and the reduction mean")
        factors = np.asarray(metric.factors(leader.hands, follower.hands))[:, : leader.links, : follower.links]
        translation, rotation = (factors[PARTS.index(part)] for part in ("translation", "rotation"))
        self._translation, self._rotation = _POSTURE * translation, _POSTURE * np.pi / 2 * rotation.T
        self._leader, self._follower, links, hands = leader, follower, follower.links, follower.hands
        self.knows_roll, self._matched = leader.knows_roll and follower.knows_roll, pairs[:, 1]
        # Of the cosine of the rotation, r (1 - cos theta) = r/4 sum |e_k - t_k|^2 over the axes.
        of_axes = _ROTATION * (np.full(3, 0.5) if self.knows_roll else np.eye(3)[2])
        self._directed, self._axes = (
            slice(hands, hands + links),
            hands + links + 3 * self._matched[:, None] + np.arange(3),
        )
        self._stiffness, self._rows = np.zeros(4 * hands + links), np.zeros((4 * hands + links, 3))
        self._stiffness[self._matched], self._stiffness[self._axes] = 1, of_axes

    def goal(
        self,
        rows: Rows,
        position: Float[np.ndarray, "pairs 3"],
        axes: Float[np.ndarray, "pairs 3 3"],
        to_base: Float[np.ndarray, "3 3"],
    ) -> Goal:
        """The goal of the leader's rows of one posture, with hands that are given in the follower's base frame.

        Args:
          rows: of the leader.
          position: of the matched hands [follower's chain lengths].
          axes: of the hands, one a row.
          to_base: rotation or reflection from the leader's base frame to the follower's.
        """
        links, hands = self._leader.links, self._leader.hands
        moving, targets, stiffness = rows.moving[0] @ to_base.T, self._rows.copy(), self._stiffness.copy()
        pulls = self._rotation @ moving[links + hands : 2 * links + hands]
        strengths = np.sqrt(np.einsum("ij,ij->i", pulls, pulls))
        targets[self._directed], stiffness[self._directed] = pulls / (strengths[:, None] + 1e-30), strengths
        targets[self._matched], targets[self._axes] = position, axes
        return Goal(moving[:links], targets, stiffness, position, axes)

    def pulls(self, goal: Goal, rows: Rows, longest: float = FAR, left: float = FAR) -> tuple[np.ndarray, ...]:
        """Forces [lanes, rows, 3], stiffnesses [lanes, rows], damping [lanes] and cost [lanes] of the pulls.

        Args:
          goal: of the pulls.
          rows: of the follower.
          longest: pull on a hand [chain lengths].
          left: pull that the last goal left, which damps this step [chain lengths].
        """
        links, moving, hands = self._follower.links, rows.moving, self._follower.hands
        force, stiffness = np.empty(moving.shape), np.empty(moving.shape[:2])
        # Weights w of the distances of links, as w / |d| |d|^2.
        apart = moving[:, None, :links] - goal.points[:, None]
        distance = np.sqrt(np.einsum("lijk,lijk->lij", apart, apart) + _SMOOTHING**2)
        tension = self._translation / distance
        force[:, :links], stiffness[:, :links] = np.einsum("lij,lijk->ljk", tension, apart), tension.sum(axis=1)
        difference = moving[:, links:] - goal.rows
        force[:, links:], stiffness[:, links:] = goal.stiffness[:, None] * difference, goal.stiffness
        squares = np.einsum("lik,lik->li", difference, difference)
        cost = np.einsum("ij,lij->l", self._translation, distance) + squares @ goal.stiffness / 2
        length = np.sqrt(squares[:, :hands]) + 1e-30
        pull = np.minimum(length, longest)
        force[:, links : links + hands] *= (pull / length)[..., None]
        return force, stiffness, _DAMPING + _LEVER * np.minimum(pull @ goal.stiffness[:hands], left), cost

    def errors(self, goal: Goal, rows: Rows) -> tuple[np.ndarray, np.ndarray]:
        """Maximum distance [m] and angle [rad] of the hands, [lanes] each."""
        difference = rows.moving[:, self._follower.links :] - goal.rows
        squares = np.einsum("lik,lik->li", difference, difference)
        apart = self._follower.unit * np.sqrt(squares[:, self._matched].max(axis=1))
        chord = squares[:, self._axes]  # of one axis 4 sin^2 of half the angle, of all three twice as much
        chord = chord.sum(axis=-1) / 8 if self.knows_roll else chord[..., 2] / 4
        return apart, 2 * np.arcsin(np.sqrt(np.minimum(chord.max(axis=1), 1)))

    def step(
        self,
        goal: Goal,
        qpos: Float[np.ndarray, "lanes joints"],
        lower: Float[np.ndarray, "lanes joints"],
        upper: Float[np.ndarray, "lanes joints"],
        longest: float = NEAR,
        left: float = FAR,
        rows: Rows | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Joint angles within the box [lower, upper] after a step, and the cost [lanes] before it.

        Args:
          goal: of the step.
          qpos: before the step [rad].
          lower, upper: of the box [rad].
          longest, left: see `pulls`.
          rows: at these angles, where they are known.
        """
        rows = self._follower(qpos) if rows is None else rows
        force, stiffness, damping, cost = self.pulls(goal, rows, longest, left)
        columns = self._follower.jacobian(rows)
        flat = columns.reshape(*columns.shape[:2], -1)
        gradient = (flat @ np.swapaxes(force, 1, 2).reshape(len(qpos), -1, 1))[..., 0]
        hessian = (columns * stiffness[:, None, None]).reshape(flat.shape) @ np.swapaxes(flat, 1, 2)
        return qpos + _step_in_box(hessian, damping, gradient, lower - qpos, upper - qpos), cost


def _step_in_box(
    hessian: np.ndarray, damping: np.ndarray, gradient: np.ndarray, lower: np.ndarray, upper: np.ndarray
) -> np.ndarray:
    """The minimum of a damped quadratic function in a box, where joints that reach an edge stay there."""
    joints = np.arange(hessian.shape[-1])
    hessian[:, joints, joints] += damping[:, None]
    step = np.linalg.solve(hessian, -gradient[..., None])[..., 0]
    free = np.ones(gradient.shape, bool)
    for _ in range(_PASSES):
        inside = np.minimum(np.maximum(step, lower), upper)
        held = (inside != step) & free
        if not held.any():
            break
        free &= ~held
        fixed = np.where(free, 0, inside)
        matrix = np.where(free[:, :, None] & free[:, None], hessian, 0)
        matrix[:, joints, joints] += ~free
        right = np.where(free, -gradient - (hessian @ fixed[..., None])[..., 0], fixed)
        step = np.linalg.solve(matrix, right[..., None])[..., 0]
    return np.minimum(np.maximum(step, lower), upper)
