"""Rotations about given axes that take one direction onto another, in closed form and batched by NumPy.

Subproblems 1 and 2 are Paden and Kahan's (Murray, Li, Sastry 1994, section 3.2), for directions, with the least-squares
solution where there is no exact one.
"""

import numpy as np
from jaxtyping import Float

PARALLEL = 1e-3  # sine between axes that are taken for one axis

Vectors = Float[np.ndarray, "poses 3"]
Angles = Float[np.ndarray, " poses"]


def rotate_onto(axis: Vectors, vector: Vectors, goal: Vectors) -> Angles:
    """Angle [rad] about an axis that brings a vector nearest to the direction of another (subproblem 1)."""
    return np.arctan2(dot(axis, np.cross(vector, goal)), dot(vector, goal) - dot(axis, vector) * dot(axis, goal))


def rotate_onto_by_two(
    first: Vectors, second: Vectors, vector: Vectors, goal: Vectors
) -> tuple[tuple[Angles, Angles], tuple[Angles, Angles]]:
    """Angles [rad] so that R(first, a) R(second, b) vector is nearest to the goal (subproblem 2): both solutions.

    Both cones, of the vector about the second axis and of the goal about the first, meet in two directions. Where they
    do not, both solutions are the one that brings them nearest: in the plane of the axes.

    Args:
      first: unit axis of the proximal joint.
      second: unit axis of the distal joint, not parallel.
      vector: unit vector that is turned.
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
    meets = in_plane + height, in_plane - height
    return tuple((-rotate_onto(first, goal, meet), rotate_onto(second, vector, meet)) for meet in meets)  # type: ignore[return-value]


def bend_to_angle(axis: Vectors, vector: Vectors, other: Vectors, cosine: Angles) -> tuple[Angles, Angles]:
    """Angles [rad] about an axis that give a vector an angle to another, or the nearest to it: both solutions."""
    along = dot(axis, vector)[:, None] * axis
    a, b = dot(other, vector - along), dot(other, np.cross(axis, vector))
    amplitude = np.maximum(np.hypot(a, b), np.finfo(float).tiny)
    apart = np.arccos(np.clip((cosine - dot(other, along)) / amplitude, -1, 1))
    return np.arctan2(b, a) + apart, np.arctan2(b, a) - apart


def frame_of(x: Vectors, y: Vectors) -> Float[np.ndarray, "poses 3 3"]:
    """Rotations whose first column is x and whose third is across x and y; any that is, where they are parallel."""
    across = np.cross(x, y)
    any_across = np.cross(x, np.eye(3)[np.abs(x).argmin(axis=1)])
    is_parallel = np.linalg.norm(across, axis=1, keepdims=True) < PARALLEL**2
    z = unit(np.where(is_parallel, any_across, across))
    return np.stack([x, np.cross(z, x), z], axis=2)


def rotated(axis: Vectors, angle: Angles, vector: Vectors) -> Vectors:
    """Rodrigues' formula."""
    cosine, sine = np.cos(angle)[:, None], np.sin(angle)[:, None]
    along = dot(axis, vector)[:, None] * axis
    return along + cosine * (vector - along) + sine * np.cross(axis, vector)


def dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Inner products along the last axis."""
    return np.sum(a * b, axis=-1)


def unit(vectors: np.ndarray) -> np.ndarray:
    """Vectors divided by their length."""
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
