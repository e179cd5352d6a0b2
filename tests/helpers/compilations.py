"""What JAX compiles in this process."""

import contextlib

import jax

_COMPILATIONS = []  # names of JAX's events of this process; a listener cannot be removed by a public function
jax.monitoring.register_event_duration_secs_listener(lambda event, *_, **__: _COMPILATIONS.append(event))


@contextlib.contextmanager
def count_compilations():
    """A list that holds the events of tracing and compilation within the context after it."""
    before, events = len(_COMPILATIONS), []
    yield events
    events.extend(event for event in _COMPILATIONS[before:] if event.startswith("/jax/core/compile"))
