"""Descents from several initial guesses of each pose, of which the best continue.

All poses and guesses are lanes of one descent, the last axes of each array, because tracing a vmapped loop takes four
times as long. On a CPU there is one loop, whose body is compiled once: each of the `kept` lanes of a pose descends from
several guesses one after another with the rough objective, then from one of the best ends with the exact one. Elsewhere
the descents from all guesses run in parallel, in a loop of their own. Both give the same poses.
"""

import functools
from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mimic.base import compat
from mimic.retargeting.closed_form import ROUGH_SMOOTHING, SMOOTHING, Smoothing
from mimic.retargeting.optimizers import (
    Derivatives,
    Limits,
    NewtonState,
    Solution,
    gradient_descent,
    newton,
    newton_start,
    newton_step,
    solution_at,
)

Method = Literal["newton", "gradient_descent"]
_ROUGH_FRACTION = 0.35  # of the iterations, for descents from all initial guesses; the best ones get the others

# Derivatives at joint angles, with a `Store` and `smoothing`; see `PoseObjective.derivatives`.
SmoothedObjective = Callable[..., Derivatives]


class Descents(NamedTuple):
    """Settings of the descents to a pose: see `imitate_pose`."""

    method: Method
    iterations: int
    kept: int | None

    @property
    def rough_iterations(self) -> int:
        """Iterations from each guess, before the best ones continue."""
        return max(int(_ROUGH_FRACTION * self.iterations), 1)


def best_descent(
    objective: SmoothedObjective, guesses: Float[Array, "guesses joints poses"], limits: Limits, descents: Descents
) -> Solution:
    """The best of the descents from all guesses of each pose.

    Args:
      objective: of joint angles [lanes, poses] each.
      guesses: [rad].
      limits: of the joints [rad].
      descents: settings. The `kept` best descents continue after the rough iterations. None continues all, with the
        exact objective only.
    """
    exact = functools.partial(objective, smoothing=SMOOTHING)
    descend = newton if descents.method == "newton" else gradient_descent
    kept = None if descents.kept is None else min(descents.kept, len(guesses))
    if kept is None:
        ends = descend(exact, guesses.swapaxes(0, 1), limits, descents.iterations)
    elif descents.method == "newton" and compat.is_cpu():
        ends = _descend_in_one_loop(objective, guesses, limits, descents._replace(kept=kept))
    else:
        rough = functools.partial(objective, smoothing=ROUGH_SMOOTHING)
        ends = descend(rough, guesses.swapaxes(0, 1), limits, descents.rough_iterations)
        best = _best_lanes(ends, kept)
        ends = descend(exact, best.qpos, limits, descents.iterations - descents.rough_iterations)
    return jax.tree.map(lambda x: x[..., 0, :], _best_lanes(ends, 1))


class _Step(NamedTuple):
    """What one step of the loop does, as scalars.

    Attributes:
      begins: whether a descent begins.
      is_last: whether it is the last descent, from the best results of the others.
      round: number of the descent of each lane, as an index of the guesses.
      smoothing: of the objective.
    """

    begins: Any
    is_last: Any
    round: Any
    smoothing: Smoothing


def _schedule(rounds: int, descents: Descents, dtype: Any) -> _Step:
    """Steps of all descents in order; one more than iterations in each, which evaluates its start."""
    lengths = [descents.rough_iterations + 1] * rounds + [descents.iterations - descents.rough_iterations + 1]
    round_of_step = np.repeat(np.arange(rounds + 1), lengths)
    is_last = round_of_step == rounds
    return _Step(
        begins=np.concatenate([np.arange(length) == 0 for length in lengths]),
        is_last=is_last,
        round=np.minimum(round_of_step, rounds - 1),
        smoothing=jax.tree.map(lambda *x: np.where(is_last, *x).astype(dtype), SMOOTHING, ROUGH_SMOOTHING),
    )


def _descend_in_one_loop(
    objective: SmoothedObjective, guesses: Float[Array, "guesses joints poses"], limits: Limits, descents: Descents
) -> Solution:
    kept = descents.kept or len(guesses)
    rounds = _rounds(guesses, kept)
    repetitions = rounds.shape[0] * kept - len(guesses)  # the last lanes of the last round
    is_repeated = np.arange(kept)[:, None] >= kept - repetitions

    def begin(carry: tuple[NewtonState, Solution], step: _Step) -> tuple[NewtonState, Solution]:
        state, best = carry
        ends = solution_at(state, limits)
        ends = ends._replace(value=jnp.where(step.is_last & is_repeated, jnp.inf, ends.value))
        best = _best_lanes(jax.tree.map(lambda *x: jnp.concatenate(x, axis=-2), best, ends), kept)
        guess = jax.lax.dynamic_index_in_dim(rounds, step.round, keepdims=False)
        return newton_start(jnp.where(step.is_last, best.qpos, guess), limits), best

    def iterate(
        carry: tuple[NewtonState, Solution], index_and_step: tuple[Array, _Step]
    ) -> tuple[tuple[NewtonState, Solution], None]:
        index, step = index_and_step
        state, best = jax.lax.cond(step.begins, begin, lambda carry, _: carry, carry, step)
        of_step = functools.partial(objective, smoothing=step.smoothing)
        return (newton_step(of_step, state, limits, index), best), None

    unknown = newton_start(rounds[0], limits)
    steps = jax.tree.map(jnp.asarray, _schedule(len(rounds), descents, rounds.dtype))
    indices = jnp.arange(len(steps.begins))
    (state, _), _ = jax.lax.scan(iterate, (unknown, solution_at(unknown, limits)), (indices, steps))
    return solution_at(state, limits)


def _rounds(guesses: Float[Array, "guesses joints poses"], kept: int) -> Float[Array, "rounds joints kept poses"]:
    """The guesses from which each lane descends; the first ones are repeated where there are too few."""
    index = np.arange(-(-len(guesses) // kept) * kept) % len(guesses)
    guesses = guesses if len(index) == len(guesses) else guesses[index]
    return guesses.reshape(-1, kept, *guesses.shape[1:]).swapaxes(1, 2)


def _best_lanes(ends: Solution, kept: int) -> Solution:
    """The best of the lanes [joints, lanes, poses] of each pose."""
    if ends.value.shape[0] == kept:
        return ends
    index = jax.lax.top_k(-ends.value.T, kept)[1].T
    return jax.tree.map(
        lambda x: jnp.take_along_axis(x, jnp.broadcast_to(index, (*x.shape[:-2], *index.shape)), axis=-2), ends
    )
