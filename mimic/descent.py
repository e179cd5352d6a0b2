"""Descents of a smooth function of joint angles, within limits; each from one start, batched by `jax.vmap`."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

_LARGEST_STEP = 1.0  # rad, of a joint in one Newton step
_FIRST_DAMPING, _LESS, _MORE = 1e-2, 0.2, 8.0  # of the Hessian: at the start, after a success, after a failure
# rad per unit of gradient, of plain descent: stable for the static rotational measure (2 over its largest curvature is
# 0.46 for planar arms of 4 and 7 links, 0.64 for two Pandas).
_GRADIENT_STEP = 0.4

Objective = Callable[[Array], Array]
Limits = tuple[Any, Any]  # lower, upper [rad]


class End(NamedTuple):
    """Where a descent came to.

    Attributes:
      qpos: [joints] [rad].
      value: of the objective there.
      slope: largest derivative by a joint that no limit holds.
    """

    qpos: Float[Array, " joints"]
    value: Float[Array, ""]
    slope: Float[Array, ""]


def newton(objective: Objective, start: Array, limits: Limits, iterations: int) -> End:
    """Damped Newton descent: the exact second derivative, with its concave directions turned round."""
    lower, upper = limits

    def gradient_and_value(qpos: Array) -> tuple[Array, tuple[Array, Array]]:
        value, gradient = jax.value_and_grad(objective)(qpos)
        return gradient, (value, gradient)

    def derivatives(qpos: Array) -> tuple[Array, Array, Array]:
        hessian, (value, gradient) = jax.jacfwd(gradient_and_value, has_aux=True)(qpos)
        return value, gradient, hessian

    def iterate(carry: Any, _: None) -> tuple[Any, None]:
        qpos, (value, gradient, hessian), damping = carry
        free = _free(qpos, gradient, lower, upper)
        step = _descent_step(hessian, gradient, free, damping)
        step = step / jnp.maximum(jnp.abs(step).max() / _LARGEST_STEP, 1.0)
        tried = jnp.clip(qpos + step, lower, upper)
        there = derivatives(tried)
        better = there[0] < value
        kept = jax.tree.map(lambda new, old: jnp.where(better, new, old), (tried, there), (qpos, carry[1]))
        return (*kept, damping * jnp.where(better, _LESS, _MORE)), None

    start = jnp.clip(start, lower, upper)
    # Nothing is known at the start: the first step is none, and what it finds is better than infinity.
    unknown = jnp.full_like(start[0], jnp.inf), jnp.zeros_like(start), jnp.zeros_like(start, shape=2 * start.shape)
    first = start, unknown, jnp.asarray(_FIRST_DAMPING / _LESS, start.dtype)
    (qpos, (value, gradient, _), _), _ = jax.lax.scan(iterate, first, None, length=iterations + 1)
    return End(qpos, value, jnp.abs(_free(qpos, gradient, lower, upper) * gradient).max())


def gradient_descent(objective: Objective, start: Array, limits: Limits, iterations: int) -> End:
    """Plain descent (paper): each step is the slope times a constant."""
    lower, upper = limits

    def iterate(qpos: Array, _: None) -> tuple[Array, None]:
        slope = jax.grad(objective)(qpos)
        return jnp.clip(qpos - _GRADIENT_STEP * slope, lower, upper), None

    qpos, _ = jax.lax.scan(iterate, jnp.clip(start, lower, upper), None, length=iterations)
    value, gradient = jax.value_and_grad(objective)(qpos)
    return End(qpos, value, jnp.abs(_free(qpos, gradient, lower, upper) * gradient).max())


def _descent_step(hessian: Array, gradient: Array, free: Array, damping: Array) -> Array:
    """-(L |D| L^T)^-1 g for the damped Hessian L D L^T of the free joints: downhill, whatever the curvature."""
    joints = gradient.shape[0]
    scale = jnp.abs(jnp.diagonal(hessian)).max() + jnp.finfo(gradient.dtype).tiny
    matrix = hessian * free[:, None] * free[None, :] / scale
    matrix = matrix + jnp.diag(damping + (1 - free))
    least = jnp.finfo(gradient.dtype).eps
    right, pivots, factors = -gradient * free / scale, [], []
    for k in range(joints):
        pivot = matrix[k, k]
        pivot = jnp.where(jnp.abs(pivot) < least, least, pivot)
        factor = jnp.where(jnp.arange(joints) > k, matrix[:, k] / pivot, 0)
        matrix = matrix - factor[:, None] * matrix[k][None, :]
        right = right - factor * right[k]
        pivots.append(jnp.abs(pivot))
        factors.append(factor)
    step = right / jnp.stack(pivots)
    for k in reversed(range(joints)):
        step = step - jnp.where(jnp.arange(joints) == k, jnp.sum(factors[k] * step), 0)
    return step


def _free(qpos: Array, gradient: Array, lower: Any, upper: Any) -> Array:
    """1 for the joints that may move, 0 for those that a limit holds against the descent."""
    held = ((qpos <= lower) & (gradient > 0)) | ((qpos >= upper) & (gradient < 0))
    return jnp.where(held, 0, 1).astype(qpos.dtype)
