"""BFGS descent within limits: one start per call, one gradient an iteration, batched by `jax.vmap`."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

_FIRST_STEP, _LONGEST_STEP = 0.1, 0.5  # largest change of a coordinate: of the first step, and of any
_SHORTER = 0.25  # factor of a step after one that did not descend
_DESCENT = 1e-4  # Armijo's condition: fraction of the descent that the slope promises
_CURVATURE = 1e-3  # least cosine between a step and the change of the gradient for an update of the inverse Hessian
_FLAT = 1e-4  # gradient below which the first step gets shorter


class Descent(NamedTuple):
    """Where a descent ended.

    Attributes:
      point: [N] the coordinates.
      value: of the objective there.
      inverse_hessian: [N, N] BFGS estimate there.
    """

    point: Float[Array, " n"]
    value: Float[Array, ""]
    inverse_hessian: Float[Array, "n n"]


def bfgs(
    objective: Callable[[Array], Array],
    start: Float[Array, " n"],
    inverse_hessian: Float[Array, "n n"],
    limits: tuple[Any, Any],
    iterations: int,
) -> Descent:
    """Quasi-Newton descent (BFGS update: Nocedal and Wright 2006, eq. 6.17) that never goes up.

    Each iteration tries one point. A step that does not descend is tried again, shorter, but still improves the inverse
    Hessian. On norms with a kink at the minimum BFGS converges too (Lewis and Overton 2013), only slower.

    Args:
      objective: of [N] coordinates.
      start: [N], clipped to the limits.
      inverse_hessian: [N, N], for instance of the descent that found a neighbouring minimum; zeros where unknown.
      limits: lower and upper, each [N], may be infinite.
      iterations: steps that are tried.
    """
    lower, upper = limits
    start = jnp.clip(start, lower, upper)
    tiny = jnp.finfo(start.dtype).tiny
    value_and_gradient = jax.value_and_grad(objective)

    def iterate(carry: Any, _: None) -> tuple[Any, None]:
        point, value, gradient, inverse, scale = carry
        first = jnp.isinf(value)  # nothing is known at the start: the first step is none
        free = ~(((point <= lower) & (gradient > 0)) | ((point >= upper) & (gradient < 0)))
        step = -jnp.where(free, _times(inverse, jnp.where(free, gradient, 0)), 0)
        step = step * scale * jnp.minimum(1, _LONGEST_STEP / jnp.maximum(jnp.abs(step).max(), tiny))
        tried = jnp.clip(point + step, lower, upper)
        new_value, new_gradient = value_and_gradient(tried)
        moved = tried - point
        turned = jnp.where(first, 0, new_gradient - gradient)
        inverse = _updated(inverse, moved, turned)
        guess = _FIRST_STEP / jnp.maximum(jnp.abs(new_gradient).max(), _FLAT) * jnp.eye(len(point), dtype=point.dtype)
        inverse = jnp.where(first & (inverse[0, 0] == 0), guess, inverse)
        better = new_value < value + _DESCENT * jnp.sum(moved * gradient)
        old, new = (point, value, gradient), (tried, new_value, new_gradient)
        kept = jax.tree.map(lambda a, b: jnp.where(better, b, a), old, new)
        return (*kept, inverse, jnp.where(better, 1, _SHORTER * scale)), None

    one = jnp.ones((), start.dtype)
    unknown = start, jnp.inf * one, jnp.zeros_like(start), inverse_hessian, one
    (point, value, _, inverse, _), _ = jax.lax.scan(iterate, unknown, None, length=iterations + 1)
    return Descent(point, value, inverse)


def _updated(inverse: Float[Array, "n n"], step: Float[Array, " n"], turned: Float[Array, " n"]) -> Float[Array, "n n"]:
    """BFGS update with a step and the change of the gradient along it; none where the curvature is not positive."""
    curvature = jnp.sum(step * turned)
    usable = curvature > _CURVATURE * jnp.sqrt(jnp.sum(step * step) * jnp.sum(turned * turned))
    factor = 1 / jnp.where(usable, curvature, 1)
    image = _times(inverse, turned)
    stretch = (1 + factor * jnp.sum(turned * image)) * factor
    update = stretch * step[:, None] * step - factor * (image[:, None] * step + step[:, None] * image)
    return jnp.where(usable, inverse + update, inverse)


def _times(matrix: Float[Array, "n n"], values: Float[Array, " n"]) -> Float[Array, " n"]:
    return jnp.sum(matrix * values, axis=1)  # elementwise: TF32 never touches it
