"""Rotations about given axes that bring one direction to another, in closed form and batched by NumPy.

Subproblems 1 and 2 are Paden and Kahan's (Murray, Li, Sastry 1994, section 3.2), for directions, with the least-squares
solution where there is no exact one.
"""

import numpy as np
from jaxtyping import Float

PARALLEL = 1e-3  # sine of the angle between axes that count as parallel

Vectors = Float[np.ndarray, "poses 3"]
Angles = Float[np.ndarray, " poses"]


def rotate_onto(axis: Vectors, vector: Vectors, goal: Vectors) -> Angles:
    """Angle [rad] of the rotation about an axis that brings a vector nearest to a goal direction (subproblem 1)."""
    return np.arctan2(dot(axis, np.cross(vector, goal)), dot(vector, goal) - dot(axis, vector) * dot(axis, goal))


def rotate_onto_by_two(
    first: Vectors, second: Vectors, vector: Vectors, goal: Vectors
) -> tuple[tuple[Angles, Angles], tuple[Angles, Angles]]:
    """Both solutions (a, b) [rad] with R(first, a) R(second, b) vector nearest to the goal (subproblem 2).

    The cones of the vector about the second axis and of the goal about the first axis intersect in two directions.
    Where they do not intersect, both solutions are the nearest approach, in the plane of the axes.

    Args:
      first: unit axis of the proximal joint.
      second: unit axis of the distal joint, not parallel.
      vector: unit vector to rotate.
      goal: unit vector.
    """
    cosine = dot(first, second)
    across = np.cross(first, second)
    square = np.maximum(dot(across, across), PARALLEL**2)
    along_first, along_second = dot(first, goal), dot(second, vector)
    in_plane = ((along_first - cosine * along_second) / square)[:, None] * first + (
        (along_second - cosine * along_first) / square
    )[:, None] * second
    height = np.sqrt(np.maximum(1 - dot(in_plane, in_plane), 0) / square)[:, None] * across

    def solution(intersection: Vectors) -> tuple[Angles, Angles]:
        return -rotate_onto(first, goal, intersection), rotate_onto(second, vector, intersection)

    return solution(in_plane + height), solution(in_plane - height)


def bend_to_angle(axis: Vectors, vector: Vectors, other: Vectors, cosine: Angles) -> tuple[Angles, Angles]:
    """Both rotations [rad] about an axis that give a vector an angle to another vector, or the nearest possible one."""
    along = dot(axis, vector)[:, None] * axis
    a, b = dot(other, vector - along), dot(other, np.cross(axis, vector))
    amplitude = np.maximum(np.hypot(a, b), np.finfo(float).tiny)
    half = np.arccos(np.clip((cosine - dot(other, along)) / amplitude, -1, 1))
    return np.arctan2(b, a) + half, np.arctan2(b, a) - half


def frame_of(x: Vectors, y: Vectors) -> Float[np.ndarray, "poses 3 3"]:
    """Rotations with first column x and third column perpendicular to x and y; any such one where they are parallel."""
    across = np.cross(x, y)
    any_across = np.cross(x, np.eye(3)[np.abs(x).argmin(axis=1)])
    is_parallel = np.linalg.norm(across, axis=1, keepdims=True) < PARALLEL**2
    z = unit(np.where(is_parallel, any_across, across))
    return np.stack([x, np.cross(z, x), z], axis=2)


def rotated(axis: Vectors, angle: Angles, vector: Vectors) -> Vectors:
    """Vectors rotated about an axis (Rodrigues' formula)."""
    cosine, sine = np.cos(angle)[:, None], np.sin(angle)[:, None]
    along = dot(axis, vector)[:, None] * axis
    return along + cosine * (vector - along) + sine * np.cross(axis, vector)


def dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Inner products along the last axis."""
    return np.sum(a * b, axis=-1)


def unit(vectors: np.ndarray) -> np.ndarray:
    """Vectors divided by their length."""
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
