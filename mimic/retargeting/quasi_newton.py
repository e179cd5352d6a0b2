"""BFGS descent within limits: one start per call, one gradient per iteration; batch it with `jax.vmap`."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

_FIRST_STEP, _MAX_STEP = 0.1, 0.5  # maximum change of a coordinate: in the first step, and in any
_BACKTRACKING = 0.25  # factor of a step after one that did not descend
_DESCENT = 1e-4  # Armijo condition: fraction of the linear decrease
_CURVATURE = 1e-3  # minimum cosine between step and change of gradient for an update of the inverse Hessian
_FLAT = 1e-4  # gradient below which the first step is shorter


class Descent(NamedTuple):
    """Result of a descent.

    Attributes:
      point: [N] final coordinates.
      value: of the objective at this point.
      inverse_hessian: [N, N] BFGS estimate at this point.
    """

    point: Float[Array, " n"]
    value: Float[Array, ""]
    inverse_hessian: Float[Array, "n n"]


# Above 40 lines because of its docstring.
def bfgs(
    objective: Callable[[Array], Array],
    start: Float[Array, " n"],
    inverse_hessian: Float[Array, "n n"],
    limits: tuple[Any, Any],
    iterations: int,
) -> Descent:
    """Monotone quasi-Newton descent (BFGS update: Nocedal and Wright 2006, eq. 6.17).

    Each iteration evaluates one point. A step that does not descend is repeated with a shorter length, but it updates
    the inverse Hessian too. BFGS also converges on norms with a kink at the minimum (Lewis and Overton 2013), only
    slower.

    Args:
      objective: of [N] coordinates.
      start: [N], clipped to the limits.
      inverse_hessian: [N, N] initial estimate, such as that of a neighbouring minimum; zeros where unknown.
      limits: lower and upper, each [N], may be infinite.
      iterations: number of steps.
    """
    lower, upper = limits
    start = jnp.clip(start, lower, upper)
    tiny = jnp.finfo(start.dtype).tiny
    value_and_gradient = jax.value_and_grad(objective)

    def iterate(carry: Any, _: None) -> tuple[Any, None]:
        point, value, gradient, inverse, scale = carry
        first = jnp.isinf(value)  # the start is not evaluated yet: the first step is zero
        free = ~(((point <= lower) & (gradient > 0)) | ((point >= upper) & (gradient < 0)))
        step = -jnp.where(free, _times(inverse, jnp.where(free, gradient, 0)), 0)
        step = step * scale * jnp.minimum(1, _MAX_STEP / jnp.maximum(jnp.abs(step).max(), tiny))
        new_point = jnp.clip(point + step, lower, upper)
        new_value, new_gradient = value_and_gradient(new_point)
        change = new_point - point
        inverse = _updated(inverse, change, jnp.where(first, 0, new_gradient - gradient))
        first_inverse = (
            _FIRST_STEP / jnp.maximum(jnp.abs(new_gradient).max(), _FLAT) * jnp.eye(len(point), dtype=point.dtype)
        )
        inverse = jnp.where(first & (inverse[0, 0] == 0), first_inverse, inverse)
        better = new_value < value + _DESCENT * jnp.sum(change * gradient)
        old, new = (point, value, gradient), (new_point, new_value, new_gradient)
        kept = jax.tree.map(lambda a, b: jnp.where(better, b, a), old, new)
        return (*kept, inverse, jnp.where(better, 1, _BACKTRACKING * scale)), None

    scale = jnp.ones((), start.dtype)
    initial = start, jnp.inf * scale, jnp.zeros_like(start), inverse_hessian, scale
    (point, value, _, inverse, _), _ = jax.lax.scan(iterate, initial, None, length=iterations + 1)
    return Descent(point, value, inverse)


def _updated(
    inverse: Float[Array, "n n"], step: Float[Array, " n"], gradient_change: Float[Array, " n"]
) -> Float[Array, "n n"]:
    """BFGS update with a step and the change of the gradient along it; none where the curvature is not positive."""
    curvature = jnp.sum(step * gradient_change)
    usable = curvature > _CURVATURE * jnp.sqrt(jnp.sum(step * step) * jnp.sum(gradient_change * gradient_change))
    factor = 1 / jnp.where(usable, curvature, 1)
    image = _times(inverse, gradient_change)
    step_factor = (1 + factor * jnp.sum(gradient_change * image)) * factor
    update = step_factor * step[:, None] * step - factor * (image[:, None] * step + step[:, None] * image)
    return jnp.where(usable, inverse + update, inverse)


def _times(matrix: Float[Array, "n n"], values: Float[Array, " n"]) -> Float[Array, " n"]:
    return jnp.sum(matrix * values, axis=1)  # elementwise: TF32 never touches it
