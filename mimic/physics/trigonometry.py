"""Cosine and sine together, without branches.

Those of CUDA's library reduce large angles exactly, in a branch. Branches keep the compiler from computing several
angles at a time, and an arm's angles are far below 1e5 rad.
"""

import math

import jax
import jax.numpy as jnp

from mimic.base.spatial import Scalar

# Pi as a sum. The first two numbers have 8 bits each, so that products with up to 16 bits are exact.
_PI = 3.140625, 0.0009670257568359375, 6.27832957178498e-07
# Least maximum errors for angles up to pi / 2: 5e-9 and 4e-10.
_SINE = -0.1666665709647155, 0.008333017290777003, -0.00019806615145773416, 2.6000546465921107e-06
_COSINE = -0.5, 0.041666655773129904, -0.0013888569161145678, 2.4769304194813876e-05, -2.619381425997269e-07


def cosine_and_sine(angle: Scalar) -> tuple[Scalar, Scalar]:
    """Cosine and sine by polynomials in single precision, to 1.2e-7 for angles up to 1e5 rad; else of the library."""
    if angle.dtype != jnp.float32:
        return jnp.cos(angle), jnp.sin(angle)
    rest, sign = _rest(angle)
    square = rest * rest
    cosine = 1.0 + square * _horner(_COSINE, square)
    sine = rest + rest * (square * _horner(_SINE, square))
    return _signed(cosine, sign), _signed(sine, sign)


def _rest(angle: Scalar) -> tuple[Scalar, Scalar]:
    """The distance to the next multiple of pi, and the sign bit of both functions there: that of an odd multiple."""
    multiple = jnp.floor(angle * (1 / math.pi) + 0.5)
    for part in _PI:
        angle = angle - multiple * part
    return angle, jax.lax.shift_left(multiple.astype(jnp.int32), jnp.int32(31))


def _signed(value: Scalar, sign: Scalar) -> Scalar:
    bits = jax.lax.bitcast_convert_type(value, jnp.int32) ^ sign
    return jax.lax.bitcast_convert_type(bits, jnp.float32)


def _horner(coefficients: tuple[float, ...], x: Scalar) -> Scalar:
    result = coefficients[-1]
    for coefficient in coefficients[-2::-1]:
        result = coefficient + x * result
    return result
