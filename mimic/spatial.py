"""Small SE(3) algebra on scalar components.

A vector is a tuple of three scalars and a rotation a tuple of three such rows. Nothing here builds a small array, so under
`jax.vmap` every operation is elementwise over the batch: XLA fuses the whole chain into one program, and no matrix product
is left for TF32 to round.
"""

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

Scalar = Any  # a traced scalar, or a number
Vector = tuple[Scalar, Scalar, Scalar]
Rotation = tuple[Vector, Vector, Vector]  # rows

IDENTITY: Rotation = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
ZERO: Vector = (0.0, 0.0, 0.0)


def vector(array: Float[Array, "3"]) -> Vector:
    """The components of an array."""
    return array[0], array[1], array[2]


def add(a: Vector, b: Vector) -> Vector:
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


def subtract(a: Vector, b: Vector) -> Vector:
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


def scale(factor: Scalar, a: Vector) -> Vector:
    return factor * a[0], factor * a[1], factor * a[2]


def dot(a: Vector, b: Vector) -> Scalar:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a: Vector, b: Vector) -> Vector:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def norm(a: Vector) -> Scalar:
    """Euclidean norm whose gradient is zero, not NaN, at the origin."""
    square = dot(a, a)
    nonzero = square > 0
    return jnp.where(nonzero, jnp.sqrt(jnp.where(nonzero, square, 1)), 0)


def rotate(rotation: Rotation, a: Vector) -> Vector:
    """R a."""
    return dot(rotation[0], a), dot(rotation[1], a), dot(rotation[2], a)


def transpose(rotation: Rotation) -> Rotation:
    x, y, z = rotation
    return (x[0], y[0], z[0]), (x[1], y[1], z[1]), (x[2], y[2], z[2])


def compose(a: Rotation, b: Rotation) -> Rotation:
    """A B."""
    columns = transpose(b)
    return rotate(columns, a[0]), rotate(columns, a[1]), rotate(columns, a[2])


def axis_rotation(axis: Vector, angle: Scalar) -> Rotation:
    """exp([axis] angle) for a unit axis (Rodrigues)."""
    x, y, z = axis
    sine, cosine = jnp.sin(angle), jnp.cos(angle)
    versine = 1 - cosine
    return (
        (cosine + versine * x * x, versine * x * y - sine * z, versine * x * z + sine * y),
        (versine * x * y + sine * z, cosine + versine * y * y, versine * y * z - sine * x),
        (versine * x * z - sine * y, versine * y * z + sine * x, cosine + versine * z * z),
    )


def stack(vectors: Sequence[Vector], dtype: Any) -> Float[Array, "n 3"]:
    """Vectors as the rows of an array."""
    return jnp.stack([jnp.stack([jnp.asarray(x, dtype) for x in row]) for row in vectors])
