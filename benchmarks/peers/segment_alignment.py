"""Retargets poses in closed form: upper arm, forearm and hand of the learner get the directions of the expert's.

The idea is that of SEW-Mimic (arXiv 2602.01632), for any serial chain of revolute joints. Shoulder, elbow, wrist and
hand are vertices of the centre line; the three parts of an arm lie between them.
"""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from benchmarks.peers.subproblems import (
    PARALLEL,
    bend_to_angle,
    dot,
    frame_of,
    rotate_onto,
    rotate_onto_by_two,
    rotated,
    unit,
)
from mimic.arms.embodiment import Embodiment
from mimic.arms.pose_limits import pose_limits
from mimic.metric.kinematics import joint_frames
from mimic.retargeting.pose import checked_poses, wrap_angles
from mimic.retargeting.pose_baselines import BASELINES, Poses

_PARTS = 3  # upper arm, forearm, hand
_SWEEPS = 3  # more than one for joints whose axis does not pass through the start of their part
_MIN_ROTATION_RATE = 0.05  # rad/rad; a joint that rotates a part by less does not orient it
_ROLL = np.cos(np.radians(30))  # a joint with its axis within 30 degrees of its part rolls it, and orients the next one
_RIGID = 0.1  # maximum change of the length of an upper arm or forearm by joint motion, as a fraction of it
_MIN_FRACTION = 0.5  # of the arm's length from the shoulder on, for upper arm and forearm together
_BEYOND_RANGE = 1e3  # 1/rad; prefers any solution within the joint range to those beyond it
_GENERIC_POSES = 32  # random poses in which the effect of each joint is measured


class Landmarks(NamedTuple):
    """Vertices of the centre line, by number from the base (0) to the tip."""

    shoulder: int
    elbow: int
    wrist: int
    hand: int


class PartJoints(NamedTuple):
    """At most two joints, base to tip, that orient a part; the first may be the roll joint of the previous part."""

    joints: tuple[int, ...]
    takes_roll: bool


class Placement(NamedTuple):
    """Joint axes and anchors and centre-line vertices of an arm in some poses, in the base frame [m]."""

    axes: Float[np.ndarray, "joints poses 3"]
    anchors: Float[np.ndarray, "joints poses 3"]
    vertices: Float[np.ndarray, "vertices poses 3"]


def align_segments(
    expert: Embodiment, learner: Embodiment, qpos: Poses, *, expert_marks: Landmarks | None = None
) -> Poses | None:
    """Rotates upper arm, forearm and hand to the directions of the expert's, as nearly as the learner's joints allow.

    From base to tip, the joints that orient a part rotate it to the expert's direction: two joints by Paden and Kahan's
    subproblem 2 with its least-squares extension, one joint by subproblem 1. A joint that rolls a part about itself
    orients the next part; both parts are then solved together. Further joints of a part stay in the home pose. Of
    several solutions one within the joint range is preferred, then the one nearest to the home pose; angles are clipped
    to the range.

    Args:
      expert: n joints.
      learner: n_hat joints.
      qpos: the expert's poses [rad].
      expert_marks: shoulder, elbow, wrist and hand of the expert where they are known, as of a captured arm; those of
        `landmarks` where None.

    Returns:
      The learner's poses [rad]; None where an arm has no elbow: fewer than three segments that a joint rotates. None
      for trees.

    Raises:
      ValueError: `qpos` is not [..., time, n], or not finite.
    """
    qpos = checked_poses(expert, np.asarray(qpos), axes=("time",))
    if not all(arm.is_serial and len(arm.chains) == 1 for arm in (expert, learner)):
        return None
    expert_marks = landmarks(expert) if expert_marks is None else expert_marks
    learner_marks = expert_marks if _same_segments(expert, learner) else landmarks(learner)
    if expert_marks is None or learner_marks is None:
        return None
    directions = part_directions(expert, expert_marks, qpos.reshape(-1, expert.num_joints))
    solved = np.tile(np.asarray(learner.home, float), (directions.shape[1], 1))
    steps = _steps(part_joints(learner, learner_marks))
    for _ in range(_SWEEPS):
        near = solved.copy()  # initially the home pose
        for part, joints in steps:
            solve = _orient_two_parts if len(joints) == 4 else _orient
            goals = directions[part : part + 2]
            solved[:, joints] = solve(learner, solved, learner_marks[part : part + 3], joints, goals, near)
    lower, upper = pose_limits(learner, float)
    return np.clip(solved, lower, upper).reshape(*qpos.shape[:-1], learner.num_joints).astype(qpos.dtype)


def landmarks(arm: Embodiment) -> Landmarks | None:
    """Shoulder, elbow, wrist and hand of an arm; None where joints rotate fewer than three of its segments.

    The hand is the tip. Shoulder, elbow and wrist are the vertices with the maximum product of the lengths of upper arm
    and forearm (in the zero pose), among those whose lengths no joint changes, starting at the first segment that a
    joint rotates. Where such parts are short compared to the arm, as in a snake robot, the lengths may change.
    """
    points = _zero_vertices(arm)
    first = next((i for i in range(len(points) - 1) if _is_rotated(arm, i)), len(points))
    triples = list(itertools.combinations(range(first, len(points) - 1), 3))
    if not triples:
        return None
    spans = _spans(_placement(arm, _generic_poses(arm)).vertices)
    zero = np.linalg.norm(points[:, None] - points, axis=-1)
    reach = np.linalg.norm(np.diff(points[first:], axis=0), axis=1).sum()

    def is_rigid(triple: tuple[int, int, int]) -> bool:
        shoulder, elbow, wrist = triple
        parts = [(shoulder, elbow), (elbow, wrist)]
        lengths = [zero[part] for part in parts]
        steady = all(spans[part] <= _RIGID * length for part, length in zip(parts, lengths, strict=True))
        return steady and sum(lengths) >= _MIN_FRACTION * reach

    candidates = [triple for triple in triples if is_rigid(triple)] or [t for t in triples if t[0] == first]
    return Landmarks(*max(candidates, key=lambda t: float(zero[t[0], t[1]] * zero[t[1], t[2]])), len(points) - 1)


def part_directions(
    arm: Embodiment, marks: Landmarks, qpos: Float[np.ndarray, "poses joints"]
) -> Float[np.ndarray, "3 poses 3"]:
    """Unit directions of upper arm, forearm and hand, from landmark to landmark."""
    vertices = _placement(arm, np.asarray(qpos, float)).vertices
    return np.stack([unit(vertices[end] - vertices[start]) for start, end in zip(marks[:-1], marks[1:], strict=True)])


def part_joints(arm: Embodiment, marks: Landmarks) -> list[PartJoints]:
    """Joints that orient each part, base to tip."""
    placement = _placement(arm, _generic_poses(arm))
    result: list[PartJoints] = []
    used: set[int] = set()
    roll: int | None = None  # roll joint of the previous part
    for part in range(_PARTS):
        start, end = marks[part : part + 2]
        free = [joint for joint in range(arm.num_joints) if joint not in used]
        rotating = [joint for joint in free if _rotation_rate(arm, placement, joint, start, end) > _MIN_ROTATION_RATE]
        rolls_this = bool(rotating) and part + 1 < _PARTS and _is_roll(placement, rotating[-1], start, end)
        next_roll = rotating.pop() if rolls_this else None
        chosen: list[int] = []
        for joint in rotating:
            if not any(_are_parallel(placement, joint, other) for other in chosen):
                chosen.append(joint)
        joints = tuple(chosen[:2])
        result.append(PartJoints(joints, bool(joints) and joints[0] == roll))
        used |= set(rotating)  # the remaining ones stay in the home pose
        if roll is not None:
            used.add(roll)
        # A joint that rolls two parts in line rotates neither: no joint between them bends.
        roll = None if next_roll == roll else next_roll
    return result


def _steps(parts: list[PartJoints]) -> list[tuple[int, list[int]]]:
    """Parts with the joints that orient them; four joints orient a part and the next one."""
    steps, is_done = [], False
    for part, (joints, _) in enumerate(parts):
        following = parts[part + 1] if part + 1 < len(parts) else PartJoints((), False)
        both = not is_done and following.takes_roll and len(joints) == len(following.joints) == 2
        if not is_done and joints:
            steps.append((part, [*joints, *(following.joints if both else ())]))
        is_done = both
    return steps


def _orient(
    arm: Embodiment,
    qpos: np.ndarray,
    marks: Sequence[int],
    joints: list[int],
    goals: Float[np.ndarray, "parts poses 3"],
    near: np.ndarray,
) -> np.ndarray:
    """Angles [poses, joints] of one or two joints that rotate a part to the first goal."""
    placement = _placement(arm, qpos)
    part = unit(placement.vertices[marks[1]] - placement.vertices[marks[0]])
    axes = [placement.axes[joint] for joint in joints]
    if len(joints) == 1:
        return _wrap(arm, qpos[:, joints] + rotate_onto(axes[0], part, goals[0])[:, None], joints)
    changes = rotate_onto_by_two(axes[0], axes[1], part, goals[0])
    return _nearest(arm, qpos, joints, [np.stack(change, axis=1) for change in changes], near)


def _orient_two_parts(
    arm: Embodiment,
    qpos: np.ndarray,
    marks: Sequence[int],
    joints: list[int],
    goals: Float[np.ndarray, "parts poses 3"],
    near: np.ndarray,
) -> np.ndarray:
    """Angles [poses, 4] of shoulder (two), roll and elbow that rotate two parts to their goals.

    The elbow sets the angle between the parts. The other three joints then rotate both parts to their goals: the
    shoulder brings the roll axis to its direction under that rotation, and the roll joint completes it.
    """
    placement = _placement(arm, qpos)
    points = [placement.vertices[mark] for mark in marks]
    upper, lower = unit(points[1] - points[0]), unit(points[2] - points[1])
    first, second, roll, elbow = (placement.axes[joint] for joint in joints)
    goal = frame_of(goals[0], goals[1])
    changes = []
    for bend in bend_to_angle(elbow, lower, upper, dot(goals[0], goals[1])):
        bent = rotated(elbow, bend, lower)
        rotation = goal @ frame_of(upper, bent).swapaxes(1, 2)
        goal_axis = np.einsum("nij,nj->ni", rotation, roll)
        for a, b in rotate_onto_by_two(first, second, roll, goal_axis):
            back = rotated(second, -b, rotated(first, -a, goals[1]))
            changes.append(np.stack([a, b, rotate_onto(roll, bent, back), bend], axis=1))
    return _nearest(arm, qpos, joints, changes, near)


def _nearest(
    arm: Embodiment, qpos: np.ndarray, joints: list[int], changes: list[np.ndarray], near: np.ndarray
) -> np.ndarray:
    """The solution [poses, joints] that exceeds the joint range least; of equal ones, the nearest to other angles."""
    solutions = np.stack([_wrap(arm, qpos[:, joints] + change, joints) for change in changes])
    lower, upper = (limit[joints] for limit in pose_limits(arm, float))
    beyond = np.maximum(np.maximum(lower - solutions, solutions - upper), 0).sum(axis=-1)
    cost = _BEYOND_RANGE * beyond + (_wrap(arm, solutions - near[:, joints], joints) ** 2).sum(axis=-1)
    return np.take_along_axis(solutions, cost.argmin(axis=0)[None, :, None], axis=0)[0]


def _generic_poses(arm: Embodiment) -> Float[np.ndarray, "poses joints"]:
    lower, upper = np.asarray(arm.joint_range, float).T
    return np.random.default_rng(0).uniform(lower, upper, (_GENERIC_POSES, arm.num_joints))


def _spans(vertices: Float[np.ndarray, "vertices poses 3"]) -> Float[np.ndarray, "vertices vertices"]:
    """Range of the distance between each pair of vertices over the poses [m]."""
    distances = np.linalg.norm(vertices[:, None] - vertices[None], axis=-1)
    return distances.max(axis=-1) - distances.min(axis=-1)


def _placement(arm: Embodiment, qpos: Float[np.ndarray, "poses joints"]) -> Placement:
    frames = joint_frames(arm, list(qpos.T), None)
    shape = (len(qpos), 3)

    def rows(vector: tuple) -> np.ndarray:
        return np.stack(np.broadcast_arrays(*vector, qpos[:, 0])[:3], axis=1)

    rotations = [np.stack([rows(row) for row in frame.rotation], axis=1) for frame in frames]
    anchors = [np.broadcast_to(rows(frame.anchor), shape) for frame in frames]
    zero_anchors = np.concatenate([np.zeros((1, 3)), np.asarray(arm.joint_anchor)])
    axes = [rotation @ axis for rotation, axis in zip(rotations[1:], np.asarray(arm.joint_axis), strict=True)]
    vertices = [
        anchors[mover + 1] + rotations[mover + 1] @ (point - zero_anchors[mover + 1])
        for mover, point in zip(_movers(arm), _zero_vertices(arm), strict=True)
    ]
    return Placement(np.stack(axes), np.stack(anchors[1:]), np.stack(vertices))


def _movers(arm: Embodiment) -> list[int]:
    """Last joint that moves each vertex of the centre line; -1 for none."""
    return [-1, *(arm.link_joint[link] for link in arm.segment_link)]


def _zero_vertices(arm: Embodiment) -> Float[np.ndarray, "vertices 3"]:
    return np.concatenate([np.asarray(arm.segment_start)[:1], np.asarray(arm.segment_end)])


def _same_segments(expert: Embodiment, learner: Embodiment) -> bool:
    """Whether both centre lines have the same segments, as of one arm with different locked joints."""
    a, b = (np.linalg.norm(arm.segment_end - arm.segment_start, axis=1) for arm in (expert, learner))
    return len(a) == len(b) and bool(np.allclose(a, b))


def _is_rotated(arm: Embodiment, segment: int) -> bool:
    """Whether a joint changes the direction of a segment; rotation about the segment itself does not."""
    direction = unit(np.asarray(arm.segment_end[segment] - arm.segment_start[segment]))
    axes = np.asarray(arm.joint_axis)[: _movers(arm)[segment + 1] + 1]
    return bool(np.any(np.linalg.norm(np.cross(axes, direction), axis=-1) > PARALLEL))


def _rotation_rate(arm: Embodiment, placement: Placement, joint: int, start: int, end: int) -> float:
    """Rotation of the direction from one vertex to another by a joint [rad/rad], root mean square over the poses."""
    axis, anchor = placement.axes[joint], placement.anchors[joint]
    points = placement.vertices[start], placement.vertices[end]
    moved = [mover >= joint for mover in (_movers(arm)[start], _movers(arm)[end])]
    rates = [np.cross(axis, point - anchor) * moves for point, moves in zip(points, moved, strict=True)]
    part = points[1] - points[0]
    return float(np.sqrt(np.mean(np.sum(np.cross(part, rates[1] - rates[0]) ** 2, axis=1) / dot(part, part) ** 2)))


def _is_roll(placement: Placement, joint: int, start: int, end: int) -> bool:
    """Whether a joint's axis is nearly along a part in all poses."""
    part = unit(placement.vertices[end] - placement.vertices[start])
    return bool(np.all(np.abs(dot(part, placement.axes[joint])) > _ROLL))


def _are_parallel(placement: Placement, joint: int, other: int) -> bool:
    return bool(np.all(np.linalg.norm(np.cross(placement.axes[joint], placement.axes[other]), axis=1) < PARALLEL))


def _wrap(arm: Embodiment, angles: np.ndarray, joints: list[int]) -> np.ndarray:
    """Angles within pi of the middle of each joint's range."""
    return wrap_angles(angles, centre=np.asarray(arm.joint_range, float)[joints].mean(axis=1))


ALL_BASELINES = {**BASELINES, "align_segments": align_segments}
