"""Schedules of an optimizer that continue where an earlier training ended."""

from typing import Any

import jax.numpy as jnp
import optax


def schedules_from(state: optax.OptState, done_updates: Any) -> optax.OptState:
    """An initial optimizer state whose schedules begin after a number of updates. Adam's own count stays 0."""

    def in_schedule(path: Any, _: Any) -> bool:
        return getattr(path[-1], "tuple_name", "") == "ScaleByScheduleState"

    count = jnp.asarray(done_updates, jnp.int32)
    return optax.tree_utils.tree_set(state, in_schedule, count=count)
