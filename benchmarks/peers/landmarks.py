"""Shoulder, elbow, wrist and hand of an arm: vertices of its centre line, with the parts of an arm between them."""

import itertools
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from mimic.arms.embodiment import Embodiment
from mimic.metric.kinematics import joint_frames

_RIGID = 0.1  # maximum change of the length of an upper arm or forearm by joint motion, as a fraction of it
_MIN_FRACTION = 0.5  # of the arm's length from the shoulder on, for upper arm and forearm together
_GENERIC_POSES = 32  # random poses in which the effect of each joint is measured
_PARALLEL = 1e-3  # sine of the angle between axes that count as parallel


class Landmarks(NamedTuple):
    """Vertices of the centre line, by number from the base (0) to the tip."""

    shoulder: int
    elbow: int
    wrist: int
    hand: int


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
    spans = _spans(_vertices(arm, _generic_poses(arm)))
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
    vertices = _vertices(arm, np.asarray(qpos, float))
    return np.stack([_unit(vertices[end] - vertices[start]) for start, end in zip(marks[:-1], marks[1:], strict=True)])


def _generic_poses(arm: Embodiment) -> Float[np.ndarray, "poses joints"]:
    lower, upper = np.asarray(arm.joint_range, float).T
    return np.random.default_rng(0).uniform(lower, upper, (_GENERIC_POSES, arm.num_joints))


def _spans(vertices: Float[np.ndarray, "vertices poses 3"]) -> Float[np.ndarray, "vertices vertices"]:
    """Range of the distance between each pair of vertices over the poses [m]."""
    distances = np.linalg.norm(vertices[:, None] - vertices[None], axis=-1)
    return distances.max(axis=-1) - distances.min(axis=-1)


def _vertices(arm: Embodiment, qpos: Float[np.ndarray, "poses joints"]) -> Float[np.ndarray, "vertices poses 3"]:
    """The vertices of the centre line in some poses, in the base frame [m]."""
    frames = joint_frames(arm, list(qpos.T), None)

    def rows(vector: tuple) -> np.ndarray:
        return np.stack(np.broadcast_arrays(*vector, qpos[:, 0])[:3], axis=1)

    rotations = [np.stack([rows(row) for row in frame.rotation], axis=1) for frame in frames]
    anchors = [np.broadcast_to(rows(frame.anchor), (len(qpos), 3)) for frame in frames]
    zero_anchors = np.concatenate([np.zeros((1, 3)), np.asarray(arm.joint_anchor)])
    return np.stack(
        [
            anchors[mover + 1] + rotations[mover + 1] @ (point - zero_anchors[mover + 1])
            for mover, point in zip(_movers(arm), _zero_vertices(arm), strict=True)
        ]
    )


def _movers(arm: Embodiment) -> list[int]:
    """Last joint that moves each vertex of the centre line; -1 for none."""
    return [-1, *(arm.link_joint[link] for link in arm.segment_link)]


def _zero_vertices(arm: Embodiment) -> Float[np.ndarray, "vertices 3"]:
    return np.concatenate([np.asarray(arm.segment_start)[:1], np.asarray(arm.segment_end)])


def _is_rotated(arm: Embodiment, segment: int) -> bool:
    """Whether a joint changes the direction of a segment; rotation about the segment itself does not."""
    direction = _unit(np.asarray(arm.segment_end[segment] - arm.segment_start[segment]))
    axes = np.asarray(arm.joint_axis)[: _movers(arm)[segment + 1] + 1]
    return bool(np.any(np.linalg.norm(np.cross(axes, direction), axis=-1) > _PARALLEL))


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
