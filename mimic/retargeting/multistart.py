"""Descents from several initial guesses of each pose, of which the best continue.

All poses and guesses are lanes of one descent, the last axes of each array, because tracing a vmapped loop takes four
times as long. On a CPU there is one loop, whose body is compiled once: each of the `kept` lanes of a pose descends from
several guesses one after another with the rough objective, then from one of the best ends with the exact one. Elsewhere
the descents from all guesses run in parallel, in a loop of their own. Both give the same poses.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from mimic.base import compat
from mimic.retargeting.closed_form import ROUGH_SMOOTHING, SMOOTHING
from mimic.retargeting.optimizers import (
    Derivatives,
    Limits,
    NewtonState,
    Solution,
    newton,
    newton_start,
    newton_step,
    solution_at,
)

_ROUGH_FRACTION = 0.35  # of the iterations, for descents from all initial guesses; the best ones get the others

# Derivatives at joint angles, with `smoothing`; see `PoseObjective.derivatives`.
SmoothedObjective = Callable[..., Derivatives]


class Descents(NamedTuple):
    """Settings of the descents to a pose: see `imitate_pose`."""

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
    if descents.kept is None:
        exact = functools.partial(objective, smoothing=SMOOTHING)
        ends = newton(exact, guesses.swapaxes(0, 1), limits, descents.iterations)
    else:
        ends = kept_descents(objective, guesses, limits, descents)
    return jax.tree.map(lambda x: x[..., 0, :], _best_lanes(ends, 1))


def kept_descents(
    objective: SmoothedObjective,
    guesses: Float[Array, "guesses joints poses"],
    limits: Limits,
    descents: Descents,
    settings: tuple[Any, Any] = (ROUGH_SMOOTHING, SMOOTHING),
    apart: float = 0.0,
) -> Solution:
    """The ends [kept, poses] of the descents that are kept.

    Args:
      objective: of joint angles [lanes, poses] each.
      guesses: [rad].
      limits: of the joints [rad].
      descents: settings.
      settings: the argument `smoothing` of the objective, in the rough iterations and in the others.
      apart: of poses that differ less, the maximum over the joints [rad], only the best one is kept.
    """
    kept = min(descents.kept or len(guesses), len(guesses))
    if compat.is_cpu():
        return _descend_in_one_loop(objective, guesses, limits, descents._replace(kept=kept), settings, apart)
    rough, last = (functools.partial(objective, smoothing=setting) for setting in settings)
    ends = newton(rough, guesses.swapaxes(0, 1), limits, descents.rough_iterations)
    best = _best_lanes(ends, kept, apart)
    return newton(last, best.qpos, limits, descents.iterations - descents.rough_iterations)


class _Step(NamedTuple):
    """What one step of the loop does, as scalars.

    Attributes:
      begins: whether a descent begins.
      is_last: whether it is the last descent, from the best results of the others.
      round: number of the descent of each lane, as an index of the guesses.
      smoothing: of the objective, or other settings.
    """

    begins: Any
    is_last: Any
    round: Any
    smoothing: Any


def _schedule(rounds: int, descents: Descents, settings: tuple[Any, Any], dtype: Any) -> _Step:
    """Steps of all descents in order; one more than iterations in each, which evaluates its start."""
    lengths = [descents.rough_iterations + 1] * rounds + [descents.iterations - descents.rough_iterations + 1]
    round_of_step = np.repeat(np.arange(rounds + 1), lengths)
    is_last = round_of_step == rounds
    return _Step(
        begins=np.concatenate([np.arange(length) == 0 for length in lengths]),
        is_last=is_last,
        round=np.minimum(round_of_step, rounds - 1),
        smoothing=jax.tree.map(lambda rough, last: np.where(is_last, last, rough).astype(dtype), *settings),
    )


def _descend_in_one_loop(
    objective: SmoothedObjective,
    guesses: Float[Array, "guesses joints poses"],
    limits: Limits,
    descents: Descents,
    settings: tuple[Any, Any],
    apart: float,
) -> Solution:
    kept = descents.kept or len(guesses)
    rounds = _rounds(guesses, kept)
    repetitions = rounds.shape[0] * kept - len(guesses)  # the last lanes of the last round
    is_repeated = np.arange(kept)[:, None] >= kept - repetitions

    def begin(carry: tuple[NewtonState, Solution], step: _Step) -> tuple[NewtonState, Solution]:
        state, best = carry
        ends = solution_at(state, limits)
        ends = ends._replace(value=jnp.where(step.is_last & is_repeated, jnp.inf, ends.value))
        best = _best_lanes(jax.tree.map(lambda *x: jnp.concatenate(x, axis=-2), best, ends), kept, apart)
        guess = jax.lax.dynamic_index_in_dim(rounds, step.round, keepdims=False)
        return newton_start(jnp.where(step.is_last, best.qpos, guess), limits), best

    def iterate(carry: tuple[NewtonState, Solution], step: _Step) -> tuple[tuple[NewtonState, Solution], None]:
        state, best = jax.lax.cond(step.begins, begin, lambda carry, _: carry, carry, step)
        of_step = functools.partial(objective, smoothing=step.smoothing)
        return (newton_step(of_step, state, limits), best), None

    unknown = newton_start(rounds[0], limits)
    steps = jax.tree.map(jnp.asarray, _schedule(len(rounds), descents, settings, rounds.dtype))
    (state, _), _ = jax.lax.scan(iterate, (unknown, solution_at(unknown, limits)), steps)
    return solution_at(state, limits)


def _rounds(guesses: Float[Array, "guesses joints poses"], kept: int) -> Float[Array, "rounds joints kept poses"]:
    """The guesses from which each lane descends; the first ones are repeated where there are too few."""
    index = np.arange(-(-len(guesses) // kept) * kept) % len(guesses)
    guesses = guesses if len(index) == len(guesses) else guesses[index]
    return guesses.reshape(-1, kept, *guesses.shape[1:]).swapaxes(1, 2)


def _best_lanes(ends: Solution, kept: int, apart: float = 0.0) -> Solution:
    """The best of the lanes [joints, lanes, poses] of each pose."""
    if ends.value.shape[0] == kept:
        return ends
    if apart:
        ends = ends._replace(value=jnp.where(_repeats(ends, apart), jnp.inf, ends.value))
    index = jax.lax.top_k(-ends.value.T, kept)[1].T
    return jax.tree.map(
        lambda x: jnp.take_along_axis(x, jnp.broadcast_to(index, (*x.shape[:-2], *index.shape)), axis=-2), ends
    )


def _repeats(ends: Solution, apart: float) -> Bool[Array, "lanes poses"]:
    """Whether a better lane has nearly the same pose."""
    lanes, differs = len(ends.value), False
    for angle in ends.qpos:  # differences of angles, up to full revolutions
        differs = differs | (jnp.cos(angle[:, None] - angle[None]) < np.cos(apart))
    order = jnp.arange(lanes)[:, None, None]
    better = (ends.value[None] < ends.value[:, None]) | (
        (ends.value[None] == ends.value[:, None]) & (order > order.swapaxes(0, 1))
    )
    return jnp.any(better & ~differs, axis=1)
