"""Newton's method for a smooth function of joint angles within limits, from one start or from a batch of them.

It computes on scalar components (see `mimic.base.spatial`), so that a batch of descents is elementwise: its lanes
are the last axes of the start, and the objective gets joint angles of the shape of the lanes.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mimic.base.compat import stored
from mimic.base.spatial import Scalar, minus, plus, times

_MAX_STEP = 1.0  # rad, of a joint in one Newton step
_FIRST_DAMPING, _LESS, _MORE = 1e-2, 0.2, 8.0  # of the Hessian: initial value, factors after a success and a failure

Scalars = Sequence[Scalar]
Limits = tuple[Any, Any]  # lower, upper [rad]; constant infinite limits cost nothing


class Derivatives(NamedTuple):
    """A function of joint angles at one point, as scalar components.

    Attributes:
      value: of the function.
      gradient: with respect to each joint.
      hessian: rows of the second derivative, at least up to the diagonal.
    """

    value: Scalar
    gradient: Scalars
    hessian: Sequence[Scalars]


class Solution(NamedTuple):
    """Result of a descent.

    Attributes:
      qpos: [joints, *lanes] [rad].
      value: [*lanes] of the objective at this pose.
      gradient_norm: [*lanes] maximum absolute derivative with respect to a joint that no limit holds.
    """

    qpos: Float[Array, "joints *lanes"]
    value: Float[Array, "*lanes"]
    gradient_norm: Float[Array, "*lanes"]


Objective = Callable[[Scalars], Derivatives]  # derivatives at joint angles


class NewtonState(NamedTuple):
    """State of a Newton descent.

    Attributes:
      qpos: joint angles [rad], as scalar components.
      here: derivatives at these; a value of infinity before the first evaluation.
      damping: of the Hessian.
    """

    qpos: tuple[Scalar, ...]
    here: Derivatives
    damping: Scalar


def newton(
    objective: Objective,
    start: Float[Array, "joints *lanes"],
    limits: Limits,
    iterations: int,
    damping: Scalar = _FIRST_DAMPING,
) -> Solution:
    """Damped Newton descent with the exact second derivative and negative curvature flipped (saddle-free Newton)."""

    def iterate(state: NewtonState, _: None) -> tuple[NewtonState, None]:
        return newton_step(objective, state, limits), None

    state, _ = jax.lax.scan(iterate, newton_start(start, limits, damping), None, length=iterations + 1)
    return solution_at(state, limits)


def newton_start(start: Float[Array, "joints *lanes"], limits: Limits, damping: Scalar = _FIRST_DAMPING) -> NewtonState:
    """The state before the first step, which is zero and evaluates the start, whose value is below infinity."""
    joints = start.shape[0]
    zero = jnp.zeros_like(start[0])
    unevaluated = Derivatives(zero + jnp.inf, (zero,) * joints, tuple((zero,) * (k + 1) for k in range(joints)))
    return NewtonState(_within(list(start), _bounds(limits, joints)), unevaluated, zero + damping / _LESS)


def newton_step(objective: Objective, state: NewtonState, limits: Limits) -> NewtonState:
    """One step, which is undone where the objective does not get smaller.

    Args:
      objective: to minimise.
      state: before the step.
      limits: of the joints [rad].
    """
    qpos, here, damping = state
    bounds = _bounds(limits, len(qpos))
    free = _free(qpos, here.gradient, bounds)
    step = _descent_step(here, free, damping)
    scale = 1 / jnp.maximum(_max_abs(step) / _MAX_STEP, 1.0)
    new_qpos = stored(_within([q + s * scale for q, s in zip(qpos, step, strict=True)], bounds))
    there = _symmetric(objective(new_qpos))
    better = there.value < here.value
    best_qpos, best = jax.tree.map(lambda new, old: jnp.where(better, new, old), (new_qpos, there), (qpos, here))
    return stored(NewtonState(best_qpos, best, damping * jnp.where(better, _LESS, _MORE)))


def _descent_step(here: Derivatives, free: Scalars, damping: Scalar) -> Scalars:
    """-(L |D| L^T)^-1 g for the damped Hessian L D L^T of the free joints: downhill, whatever the curvature."""
    joints, eps = len(here.gradient), jnp.finfo(jnp.result_type(here.value)).eps
    scale = _max_abs([row[-1] for row in here.hessian])
    unit = 1 / (scale + jnp.finfo(jnp.result_type(here.value)).tiny)
    matrix = [[times(times(free[i], free[j]), here.hessian[i][j] * unit) for j in range(i + 1)] for i in range(joints)]
    for i in range(joints):
        matrix[i][i] = plus(matrix[i][i] + damping * jnp.maximum(jnp.abs(matrix[i][i]), 0.01), 1.0 - free[i])
    step = [times(free[i], -here.gradient[i] * unit) for i in range(joints)]
    inverses = []  # of the pivots: quotients would be kernels of their own
    for k in range(joints):
        inverses.append(1 / jnp.where(jnp.abs(matrix[k][k]) < eps, eps, matrix[k][k]))
        below = [matrix[i][k] for i in range(joints) if i > k]
        for i in range(k + 1, joints):
            matrix[i][k] = times(matrix[i][k], inverses[k])  # from now on an entry of L
            step[i] = minus(step[i], times(matrix[i][k], step[k]))
            for j in range(k + 1, i + 1):
                matrix[i][j] = minus(matrix[i][j], times(matrix[i][k], below[j - k - 1]))
    step = [times(s, jnp.abs(inverse)) for s, inverse in zip(step, inverses, strict=True)]
    for k in reversed(range(joints)):
        for i in range(k + 1, joints):
            step[k] = minus(step[k], times(matrix[i][k], step[i]))
    return step


def _symmetric(derivatives: Derivatives) -> Derivatives:
    """Derivatives with the lower triangle of the Hessian only."""
    lower = tuple(tuple(row[: i + 1]) for i, row in enumerate(derivatives.hessian))
    return Derivatives(derivatives.value, tuple(derivatives.gradient), lower)


def _bounds(limits: Limits, joints: int) -> list[tuple[Scalar, Scalar] | None]:
    """Lower and upper limit of each joint; None for constant infinite limits."""
    is_constant = all(isinstance(limit, np.ndarray) for limit in limits)
    lower, upper = limits
    return [
        None if is_constant and np.isinf(lower[k]) and np.isinf(upper[k]) else (lower[k], upper[k])
        for k in range(joints)
    ]


def _within(qpos: Scalars, bounds: Sequence[tuple[Scalar, Scalar] | None]) -> tuple[Scalar, ...]:
    return tuple(q if bound is None else jnp.clip(q, *bound) for q, bound in zip(qpos, bounds, strict=True))


def _free(qpos: Scalars, gradient: Scalars, bounds: Sequence[tuple[Scalar, Scalar] | None]) -> Scalars:
    """1 for joints that can move downhill, 0 for joints held by a limit."""
    return [
        1.0 if bound is None else _is_free(q, derivative, *bound)
        for q, derivative, bound in zip(qpos, gradient, bounds, strict=True)
    ]


def _is_free(qpos: Scalar, derivative: Scalar, lower: Scalar, upper: Scalar) -> Scalar:
    held = ((qpos <= lower) & (derivative > 0)) | ((qpos >= upper) & (derivative < 0))
    return jnp.where(held, 0, 1).astype(jnp.result_type(qpos))


def _max_abs(values: Scalars) -> Scalar:
    maximum = jnp.abs(values[0])
    for value in values[1:]:
        maximum = jnp.maximum(maximum, jnp.abs(value))
    return maximum


def solution_at(state: NewtonState, limits: Limits) -> Solution:
    """The result of a descent that ends in this state."""
    gradient = state.here.gradient
    free = _free(state.qpos, gradient, _bounds(limits, len(state.qpos)))
    gradient_norm = _max_abs([times(f, g) for f, g in zip(free, gradient, strict=True)])
    return Solution(jnp.stack(state.qpos), state.here.value, gradient_norm)
