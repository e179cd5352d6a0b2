"""Steps of a live follower towards the leader's hand, and of the postures with this hand towards the leader's.

All is NumPy in double precision, for several postures at once, so that a step needs no compilation. Points and unit
vectors that move with the joints are the rows of one table. Each row is pulled to a target with a stiffness, and a step
minimises the sum of the pulls within a box of joint angles: Gauss-Newton's method. The hand's position is pulled most,
then its rotation, then the links, so that a hand out of reach gives up its rotation before its position.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import mujoco
import numpy as np
from jaxtyping import Float

from mimic.arms.embodiment import Embodiment
from mimic.arms.model_tree import quaternion
from mimic.metric.distance import PARTS, Metric

_ROTATION, _POSTURE, _DAMPING = 3e-4, 3e-7, 1e-7  # weights of a step; the hand's position in chain lengths has 1
# Damping per chain length of the pull on hands: the second derivative of their position, which Gauss-Newton's method
# leaves out, is at most the pull times the distance from a joint. Without it hands out of reach oscillate.
_LEVER = 0.5
_SMOOTHING = 1e-2  # chain lengths below which a distance of links is a square
FAR, NEAR = 0.3, 0.03  # chain lengths, the longest pulls on hands: of a search, and of a follower
_PASSES = 3  # of a step near walls, each with those that the last one went beyond
_STIFF, _ON_WALL = 1e3, 1e-7  # of walls, beside 1 of the hand's position; m beyond them
# Of costs for mju_boxQP, which ends at gradients of 1e-8, a tenth of the posture's; rad of the boxes, which it needs.
_SCALE, _WIDTH = 1e6, 1e-12


class Goal(NamedTuple):
    """What a follower is pulled to, in its base frame and in its chain lengths.

    Attributes:
      points: [leader_links, 3] positions of the leader's links, in its own chain lengths.
      pulls: [rows, 3] targets of the follower's link directions, hand positions and hand axes, times the stiffness.
      stiffness: [rows] of these pulls.
      hands: [4 pairs, 3] positions of the matched hands, then their axes.
    """

    points: Float[np.ndarray, "leader_links 3"]
    pulls: Float[np.ndarray, "rows 3"]
    stiffness: Float[np.ndarray, " rows"]
    hands: Float[np.ndarray, "hand_rows 3"]


Rows = Float[np.ndarray, "lanes rows 3"]  # points and unit vectors of an arm in its base frame, in chain lengths


class ArmRows:
    """Kinematics of an arm as a table of rows; hands that the model does not know are the ends of its chains.

    MuJoCo's kinematics of a model of joints and sites: one call in C for what takes NumPy twenty.

    Attributes:
      joints, links, hands: their numbers.
      unit: chain length [m].
      knows_roll: whether the rotation of the hands about their z-axes is known.
      anchors, axes: rows of the joints, as slices.
      points, directions, positions: rows of the links and of the hands' positions; the hands' axes are last.
      moving: rows from the links on.
    """

    def __init__(self, arm: Embodiment):
        self.unit, self.joints, self.links = float(arm.chain_length), arm.num_joints, arm.num_links
        self.knows_roll, (positions, rotations, hand_joint) = bool(arm.hand_joint), _hands(arm)
        self.hands = len(hand_joint)
        site_joint = [*arm.link_joint, *hand_joint]
        poses = np.concatenate([arm.link_position, positions]), np.concatenate([arm.link_rotation, rotations])
        self._model = _model(arm, site_joint, poses[0], poses[1], self.unit)
        self._data = data = mujoco.MjData(self._model)
        joints = np.array([self._model.joint(str(joint)).id for joint in range(self.joints)])
        sites = np.array([self._model.site(str(site)).id for site in range(len(site_joint))])
        self._qpos, self._address = data.qpos, self._model.jnt_qposadr[joints]
        self._parts = [x.ravel() for x in (data.xanchor, data.xaxis, data.site_xpos, data.site_xmat)]
        anchors, axes, points, matrices = np.split(
            np.arange(sum(map(len, self._parts))), np.cumsum([len(x) for x in self._parts])[:-1]
        )
        anchors, axes, points = (x.reshape(-1, 3) for x in (anchors, axes, points))
        columns = matrices.reshape(-1, 3, 3).swapaxes(1, 2)[sites]
        links, hands = self.links, self.hands
        rows = anchors[joints], axes[joints], points[sites[:links]], columns[:links, 0], points[sites[links:]]
        self._index = np.concatenate([*rows, columns[links:].reshape(-1, 3)])
        edges = np.cumsum([0, *map(len, rows)]).tolist()
        self.anchors, self.axes, self.points, self.directions, self.positions = map(slice, edges, edges[1:])
        self.moving, self._hand_axes = slice(edges[2], None), edges[-1]
        of_rows = [*arm.link_joint, *arm.link_joint, *hand_joint, *np.repeat(hand_joint, 3)]
        is_point = np.repeat([1.0, 0.0, 1.0, 0.0], [links, links, hands, 3 * hands])
        moves = [[is_ancestor(arm, joint, row) for row in of_rows] for joint in range(self.joints)]
        self._moves, self._is_point = np.array(moves, float)[:, :, None], is_point[:, None]

    def __call__(self, qpos: Float[np.ndarray, "lanes joints"]) -> Rows:
        """The rows at joint angles [rad]."""
        rows = np.empty((len(qpos), *self._index.shape))
        for lane, angles in enumerate(qpos):
            self._qpos[self._address] = angles
            mujoco.mj_kinematics(self._model, self._data)
            np.concatenate(self._parts).take(self._index, out=rows[lane], mode="clip")
        return rows

    def hand_rows(self, hands: np.ndarray) -> np.ndarray:
        """Numbers [4 hands] of the rows of some hands: positions, then three axes of each."""
        axes = self._hand_axes + 3 * hands[:, None] + np.arange(3)
        return np.concatenate([self.positions.start + hands, axes.ravel()])

    def jacobian(self, rows: Rows) -> Float[np.ndarray, "lanes joints moving 3"]:
        """Derivatives of the moving rows with respect to the joint angles."""
        cross = (rows[:, self.axes] @ LEVI_CIVITA).reshape(-1, self.joints, 3, 3)
        return ((rows[:, None, self.moving] - self._is_point * rows[:, self.anchors, None]) @ cross) * self._moves


LEVI_CIVITA = np.cross(np.eye(3)[:, None], np.eye(3)).reshape(3, 9)  # v @ (a @ this) is a x v


def _model(
    arm: Embodiment, site_joint: Sequence[int], positions: np.ndarray, rotations: np.ndarray, unit: float
) -> mujoco.MjModel:
    """Joints of an arm and sites that move with them, named by their numbers, in units of a length."""
    spec, bodies = joint_spec(arm, unit)
    for site, (joint, position, rotation) in enumerate(zip(site_joint, positions, rotations, strict=True)):
        body, origin = bodies[joint + 1]
        body.add_site(name=str(site), pos=position / unit - origin, quat=quaternion(rotation))
    return spec.compile()


def joint_spec(arm: Embodiment, unit: float) -> tuple[mujoco.MjSpec, list[tuple[Any, np.ndarray]]]:
    """A model of an arm's joints, named by their numbers, in units of a length [m].

    Returns:
      The model, and its bodies, the base's first, with their origins in the zero pose.
    """
    spec = mujoco.MjSpec()
    spec.compiler.autolimits, spec.compiler.degree = False, False
    bodies: list[tuple[Any, np.ndarray]] = [(spec.worldbody, np.zeros(3))]
    for joint, parent in enumerate(arm.joint_parent):
        anchor, (body, origin) = np.asarray(arm.joint_anchor[joint], float) / unit, bodies[parent + 1]
        child = body.add_body(pos=anchor - origin, mass=1.0, inertia=np.ones(3), explicitinertial=True)
        child.add_joint(name=str(joint), axis=np.asarray(arm.joint_axis[joint], float))
        bodies.append((child, anchor))
    return spec, bodies


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


def is_ancestor(arm: Embodiment, joint: int, other: int) -> bool:
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
        joints = follower.joints
        self._factor = np.zeros((joints, joints + 7))  # where mju_boxQP works
        self._leader, self._follower, self._pairs, matched = leader, follower, len(pairs), pairs[:, 1]
        self.knows_roll = leader.knows_roll and follower.knows_roll
        # Of the cosine of the rotation, r (1 - cos theta) = r/4 sum |e_k - t_k|^2 over the axes.
        of_axes = np.full(3, 0.5) if self.knows_roll else np.eye(3)[2]
        self._chord = of_axes / 4  # sin^2 of half the angle
        self._hands = follower.hand_rows(matched)
        self._of_hands = self._hands - follower.directions.start  # among the rows of a goal
        self._stiffness = np.zeros(follower.links + 4 * follower.hands)
        self._pulls = np.zeros((len(self._stiffness), 3))
        self._hand_stiffness = np.concatenate([np.ones(len(pairs)), np.tile(_ROTATION * of_axes, len(pairs))])[:, None]
        self._stiffness[self._of_hands] = self._hand_stiffness[:, 0]

    def goal(self, leader: Float[np.ndarray, "rows 3"], hands: Float[np.ndarray, "hand_rows 3"]) -> Goal:
        """The goal of one posture of the leader.

        Args:
          leader: its rows, with the axes of the follower's base frame.
          hands: [4 pairs, 3] positions of the matched hands in the follower's base frame [follower's chain lengths],
            then their axes.
        """
        links, pulls, stiffness = self._follower.links, self._pulls.copy(), self._stiffness.copy()
        pulls[:links] = directed = self._rotation.dot(leader[self._leader.directions])
        np.sqrt(np.vecdot(directed, directed), out=stiffness[:links])
        pulls[self._of_hands] = self._hand_stiffness * hands
        return Goal(leader[self._leader.points], pulls, stiffness, hands)

    def pulls(self, goal: Goal, rows: Rows, longest: float = FAR, left: float = FAR) -> tuple[np.ndarray, ...]:
        """Forces [lanes, moving, 3], stiffnesses [lanes, moving] and damping [lanes] of the pulls.

        Args:
          goal: of the pulls.
          rows: of the follower.
          longest: pull on a hand [chain lengths].
          left: pull that the last goal left, which damps this step [chain lengths].
        """
        links, moving = self._follower.links, rows[:, self._follower.moving]
        stiffness = np.empty(moving.shape[:2])
        # Weights w of the distances of links, as w / |d| |d|^2.
        tension = self._translation / self._link_distances(goal, rows)
        tension.sum(axis=1, out=stiffness[:, :links])
        stiffness[:, links:] = goal.stiffness
        force = moving * stiffness[..., None]
        force[:, :links] -= tension.swapaxes(1, 2) @ goal.points
        force[:, links:] -= goal.pulls
        of_hands = force[:, 2 * links : 2 * links + self._follower.hands]  # stiffness 1, or 0 without a match
        length = np.sqrt(np.vecdot(of_hands, of_hands))
        fraction = longest / np.maximum(length, longest)
        of_hands *= fraction[..., None]
        return force, stiffness, _DAMPING + _LEVER * np.minimum(np.vecdot(length, fraction), left)

    def cost(self, goal: Goal, rows: Rows) -> Float[np.ndarray, " lanes"]:
        """Sum of the pulls' costs, k |x - t|^2 / 2, where all rows but the hands' positions are unit vectors."""
        of_links = (self._translation * self._link_distances(goal, rows)).sum(axis=(1, 2))
        apart, pairs = rows[:, self._hands[: self._pairs]] - goal.hands[: self._pairs], self._pairs
        directions = rows[:, self._follower.directions.start :].copy()
        directions[:, self._of_hands[:pairs]] = 0
        stiffness = goal.stiffness.sum() - pairs
        turned = stiffness - (directions * goal.pulls).sum(axis=(1, 2))
        return of_links + turned + np.vecdot(apart, apart).sum(axis=1) / 2

    def _link_distances(self, goal: Goal, rows: Rows) -> Float[np.ndarray, "lanes leader_links links"]:
        apart = rows[:, None, self._follower.points] - goal.points[:, None]
        return np.sqrt(np.vecdot(apart, apart) + _SMOOTHING**2)

    def errors(self, goal: Goal, rows: Rows) -> tuple[list[float], list[float]]:
        """Maximum distance [m] and angle [rad] of the hands, of each lane."""
        apart, pairs = rows.take(self._hands, axis=1) - goal.hands, self._pairs
        squares = np.vecdot(apart, apart)
        chords = squares[:, pairs:].reshape(-1, pairs, 3) @ self._chord
        positions, chords = squares[:, :pairs].max(axis=1).tolist(), chords.max(axis=1).tolist()
        return (
            [self._follower.unit * math.sqrt(x) for x in positions],
            [2 * math.asin(min(math.sqrt(x), 1.0)) for x in chords],
        )

    def step(
        self,
        goal: Goal,
        qpos: Float[np.ndarray, "lanes joints"],
        lower: Float[np.ndarray, "lanes joints"],
        upper: Float[np.ndarray, "lanes joints"],
        longest: float = NEAR,
        left: float = FAR,
        rows: Rows | None = None,
        walls: tuple[np.ndarray, np.ndarray] | None = None,
    ) -> Float[np.ndarray, "lanes joints"]:
        """Joint angles within the box [lower, upper] after a step.

        Args:
          goal: of the step.
          qpos: before the step [rad].
          lower, upper: of the box [rad].
          longest, left: see `pulls`.
          rows: at these angles, where they are known.
          walls: gradients [walls, joints] and bounds [walls]: the step's products with the gradients are at least
            these, as far as the box lets them; of a single lane.
        """
        rows = self._follower(qpos) if rows is None else rows
        force, stiffness, damping = self.pulls(goal, rows, longest, left)
        columns = self._follower.jacobian(rows)
        flat = columns.reshape(*columns.shape[:2], -1)
        gradient = (flat @ force.reshape(len(qpos), -1, 1))[..., 0]
        hessian = (columns * stiffness[:, None, :, None]).reshape(flat.shape) @ flat.swapaxes(1, 2)
        joints, (lower, upper) = hessian.shape[-1], (lower - qpos, upper - qpos)
        hessian.reshape(-1, joints * joints)[:, :: joints + 1] += damping[:, None]
        step = self._step_in_box(hessian, gradient, lower, upper)
        if walls is not None:
            normals, bounds = walls
            for _ in range(_PASSES):
                beyond = (step[0] @ normals.T < bounds - _ON_WALL) * _STIFF
                if not beyond.any():
                    break
                hessian += (beyond * normals.T) @ normals
                gradient -= (beyond * bounds) @ normals
                step = self._step_in_box(hessian, gradient, lower, upper)
        return qpos + step

    def _step_in_box(
        self, hessian: np.ndarray, gradient: np.ndarray, lower: np.ndarray, upper: np.ndarray
    ) -> np.ndarray:
        """The minimum of a quadratic function in a box."""
        step, factor, upper = np.zeros_like(gradient), self._factor, np.maximum(upper, lower + _WIDTH)
        for lane in range(len(gradient)):
            mujoco.mju_boxQP(
                step[lane], factor, None, _SCALE * hessian[lane], _SCALE * gradient[lane], lower[lane], upper[lane]
            )
        return step
