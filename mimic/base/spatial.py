"""Small SE(3) algebra on scalar components.

A vector is a tuple of three scalars; a rotation is a tuple of three such rows. No function here creates a small array,
so under `jax.vmap` every operation is elementwise over the batch: XLA fuses the whole chain into one kernel, and no
matrix product is rounded to TF32. Scalars that are Python floats are constants while JAX traces; products with 0 and 1
are then not computed. This leaves a third of the operations of a Panda's forward kinematics.
"""

import math
from collections.abc import Sequence
from types import ModuleType
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.core import Tracer
from jaxtyping import Array, Float

from mimic.base import compat

Scalar = Any  # a traced scalar, or a number
Vector = tuple[Scalar, Scalar, Scalar]
Rotation = tuple[Vector, Vector, Vector]  # rows of it, or of any 3x3 matrix

IDENTITY: Rotation = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
ZERO: Vector = (0.0, 0.0, 0.0)


def scalar(number: Any) -> Scalar:
    """A Python float where it is a NumPy number."""
    return float(number) if isinstance(number, np.generic | np.ndarray) else number


def array_library(values: Any) -> ModuleType:
    """NumPy for a NumPy array, else `jax.numpy`."""
    return np if isinstance(values, np.ndarray) else jnp


def vector(array: Float[Any, "3"]) -> Vector:
    """The components of an array; Python floats where it is a NumPy array."""
    if isinstance(array, np.ndarray):
        array = array.tolist()
    return array[0], array[1], array[2]


def rotation(array: Float[Any, "3 3"]) -> Rotation:
    """The rows of an array."""
    return vector(array[0]), vector(array[1]), vector(array[2])


def times(x: Scalar, y: Scalar) -> Scalar:
    """The product; free where one factor is the constant 0, 1 or -1."""
    for constant, other in ((x, y), (y, x)):
        if isinstance(constant, float):
            if constant == 0:
                return 0.0
            if abs(constant) == 1:
                return other if constant > 0 else lax.neg(other) if isinstance(other, Tracer) else -other
    operands = _lax_operands(x, y)
    return lax.mul(*operands) if operands else x * y


def plus(x: Scalar, y: Scalar) -> Scalar:
    """The sum; free where one summand is the constant 0."""
    if isinstance(x, float) and x == 0:
        return y
    if isinstance(y, float) and y == 0:
        return x
    operands = _lax_operands(x, y)
    return lax.add(*operands) if operands else x + y


def minus(x: Scalar, y: Scalar) -> Scalar:
    """The difference; free where x or y is the constant 0."""
    if isinstance(x, float) and x == 0:
        return times(-1.0, y)
    if isinstance(y, float) and y == 0:
        return x
    operands = _lax_operands(x, y)
    return lax.sub(*operands) if operands else x - y


def _lax_operands(x: Scalar, y: Scalar) -> tuple[Scalar, Scalar] | None:
    """Operands for `jax.lax`, which traces faster, where they are like tracers, or a tracer and a float; else None."""
    if isinstance(x, Tracer) and isinstance(y, Tracer):
        return (x, y) if x.aval.shape == y.aval.shape and x.aval.dtype == y.aval.dtype else None  # type: ignore[attr-defined]
    tracer, number = (x, y) if isinstance(x, Tracer) else (y, x)
    if not (isinstance(tracer, Tracer) and isinstance(number, float)) or tracer.dtype.kind != "f" or tracer.weak_type:
        return None
    number = tracer.dtype.type(number)
    return (tracer, number) if tracer is x else (number, tracer)


def add(a: Vector, b: Vector) -> Vector:
    """The sum a + b."""
    return plus(a[0], b[0]), plus(a[1], b[1]), plus(a[2], b[2])


def subtract(a: Vector, b: Vector) -> Vector:
    """The difference a - b."""
    return minus(a[0], b[0]), minus(a[1], b[1]), minus(a[2], b[2])


def scale(factor: Scalar, a: Vector) -> Vector:
    """The multiple of a vector."""
    return times(factor, a[0]), times(factor, a[1]), times(factor, a[2])


def dot(a: Vector, b: Vector) -> Scalar:
    """The inner product."""
    return plus(plus(times(a[0], b[0]), times(a[1], b[1])), times(a[2], b[2]))


def cross(a: Vector, b: Vector) -> Vector:
    """The cross product a x b."""

    def minor(i: int, j: int) -> Scalar:
        return minus(times(a[i], b[j]), times(a[j], b[i]))

    return minor(1, 2), minor(2, 0), minor(0, 1)


def norm(a: Vector) -> Scalar:
    """Euclidean norm whose gradient is zero, not NaN, at the origin."""
    square = dot(a, a)
    return math.sqrt(square) if isinstance(square, float) else safe_sqrt(square)


def safe_sqrt(square: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Square root whose gradient is zero, not infinite, where its argument is zero."""
    nonzero = square >= jnp.finfo(square.dtype).tiny  # a backend may flush smaller numbers to zero, and divide by it
    return jnp.where(nonzero, jnp.sqrt(jnp.where(nonzero, square, 1)), 0)


def rotate(rotation: Rotation, a: Vector) -> Vector:
    """R a."""
    return dot(rotation[0], a), dot(rotation[1], a), dot(rotation[2], a)


def transpose(rotation: Rotation) -> Rotation:
    """R^T, the inverse."""
    x, y, z = rotation
    return (x[0], y[0], z[0]), (x[1], y[1], z[1]), (x[2], y[2], z[2])


def compose(a: Rotation, b: Rotation) -> Rotation:
    """A B."""
    columns = transpose(b)
    return rotate(columns, a[0]), rotate(columns, a[1]), rotate(columns, a[2])


def add_outer(matrix: Rotation, a: Vector, b: Vector) -> Rotation:
    """M + a b^T."""
    x, y, z = matrix
    return add(x, scale(a[0], b)), add(y, scale(a[1], b)), add(z, scale(a[2], b))


def axis_rotation(axis: Vector, angle: Scalar) -> Rotation:
    """exp([axis] angle) for a unit axis (Rodrigues); computed by NumPy for a NumPy array of angles."""
    numpy = array_library(angle)
    sine, cosine = numpy.sin(angle), numpy.cos(angle)
    versine = minus(1.0, cosine)

    def entry(i: int, j: int) -> Scalar:
        square = times(axis[i], axis[j])
        if i == j:
            is_one = isinstance(square, float) and square == 1
            return 1.0 if is_one else plus(cosine, times(versine, square))
        towards_axis = times(axis[3 - i - j], sine)
        return plus(times(versine, square), towards_axis if (i - j) % 3 == 1 else times(-1.0, towards_axis))

    def row(i: int) -> Vector:
        return entry(i, 0), entry(i, 1), entry(i, 2)

    return row(0), row(1), row(2)


def stack_batches(vectors: Sequence[Vector], batch: Float[Array, " n"]) -> Float[Array, "vectors 3 n"]:
    """One array of vectors whose components are numbers or batches with the shape and type of `batch`."""
    scalars = [x for vector in vectors for x in vector]
    scalars = compat.computed_once([x if jnp.shape(x) == batch.shape else jnp.full_like(batch, x) for x in scalars])
    return jnp.stack([jnp.stack(scalars[i : i + 3]) for i in range(0, len(scalars), 3)])


def stack(vectors: Sequence[Sequence[Scalar]], dtype: Any) -> Float[Array, "n m"]:
    """One array of rows of scalars."""
    scalars = [jnp.asarray(x, dtype) for row in vectors for x in row]
    return jnp.stack(compat.computed_once(scalars)).reshape(len(vectors), -1)
