"""What JAX compiles in this process, and how many functions a quick test may compile."""

import contextlib

import jax
import pytest

BUDGET = (
    200  # functions; a single operation outside of `jax.jit` is one. Nine tenths of the tests compile fewer than 15
)

_COMPILATIONS = []  # names of JAX's events of this process; a listener cannot be removed by a public function
jax.monitoring.register_event_duration_secs_listener(lambda event, *_, **__: _COMPILATIONS.append(event))


@contextlib.contextmanager
def count_compilations():
    """A list that holds the events of tracing and compilation within the context after it."""
    before, events = len(_COMPILATIONS), []
    yield events
    events.extend(event for event in _COMPILATIONS[before:] if event.startswith("/jax/core/compile"))


@contextlib.contextmanager
def check_budget(is_slow: bool):
    """Fails a quick test that compiles more functions than the budget; those of earlier tests are compiled already."""
    with count_compilations() as events:
        yield
    count = sum(event.endswith("backend_compile_duration") for event in events)  # also where the cache has it
    if count > BUDGET and not is_slow:
        pytest.fail(
            f"compiled {count} functions, expected at most {BUDGET} in a quick test: use jax.jit for what is tested, "
            "NumPy for the rest, or mark the test slow",
            pytrace=False,
        )
