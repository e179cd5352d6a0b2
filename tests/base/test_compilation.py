"""Compilation in the background, and the options of the compiler."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mimic.base import compilation
from mimic.base.compilation import Background, compiler_options


def test_background_functions_run_once():
    computed = []
    lazy, started = Background(lambda: computed.append("lazy")), Background(lambda: computed.append("started"))
    started.start()
    started.start()
    for program in (started, started, lazy, lazy):
        program()
    assert computed == ["started", "lazy"]
    failing = Background(lambda: 1 / 0)
    failing.start()
    with pytest.raises(ZeroDivisionError):
        failing()


@pytest.mark.parametrize(("a_process_for_each", "count"), [(False, 2), (True, 3)])
def test_options_for_gpus_are_known_to_jaxlib(monkeypatch, a_process_for_each, count):
    """It accepts them on CPUs too, and rejects a wrong name or value."""
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    monkeypatch.setattr(compilation, "a_process_for_each_gpu", lambda: a_process_for_each)
    options = compiler_options()
    assert len(options) == count
    assert jax.jit(lambda x: x + 1, compiler_options=options)(1.0) == 2.0


def test_compilation_in_the_background_uses_the_options(monkeypatch):
    monkeypatch.setattr(compilation, "compiler_options", lambda: {"no_option_of_xla": True})
    with pytest.raises(jax.errors.JaxRuntimeError, match="no_option_of_xla"):
        compilation.compiling(lambda x: x + 1, jnp.zeros(3))()


def test_xla_flags_of_the_user_are_kept(monkeypatch):
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    boolean, scheduling = compiler_options()
    monkeypatch.setenv("XLA_FLAGS", f"--xla_dump_to=/tmp --{scheduling}=LHS")
    assert list(compiler_options()) == [boolean]
    monkeypatch.setenv("XLA_FLAGS", f"--{boolean}")
    assert list(compiler_options()) == [scheduling]


@pytest.mark.parametrize(
    ("backend", "processes", "devices", "expected"),
    [("gpu", 4, 4, True), ("gpu", 1, 4, False), ("gpu", 1, 1, False), ("gpu", 2, 8, False), ("cpu", 2, 2, False)],
)
def test_all_reduces_overlap_with_computation_where_each_gpu_has_a_process(
    monkeypatch, backend, processes, devices, expected
):
    monkeypatch.setattr(jax, "default_backend", lambda: backend)
    monkeypatch.setattr(jax, "process_count", lambda: processes)
    monkeypatch.setattr(jax, "device_count", lambda: devices)
    assert compilation.a_process_for_each_gpu() == expected
    commands = compilation.compiler_options().get("xla_gpu_enable_command_buffer", "")
    assert ("COLLECTIVES" in commands) == expected


def test_a_cache_that_cannot_be_written_is_not_used(capsys):
    before = jax.config.values["jax_compilation_cache_dir"]
    compilation.use_compilation_cache("/dev/null/cache")
    assert jax.config.values["jax_compilation_cache_dir"] == before
    assert capsys.readouterr().err.startswith(
        "warning: compilation_cache: '/dev/null/cache': cannot write in '/dev/null'"
    )


def test_results_are_kept_by_value_and_not_for_ever():
    made = []

    @compilation.by_value
    def make(*arguments):
        made.append(arguments)
        return object()

    first = make(np.ones(2), {"a": (1.0, "x")}, functools.partial(np.sum, axis=0))
    assert make(np.ones(2), {"a": (1.0, "x")}, functools.partial(np.sum, axis=0)) is first
    for other in (np.zeros(2), np.ones(2, np.float32), np.ones((2, 1)), [1.0, 1.0], np.array([1.0, -1.0])):
        assert make(other, {"a": (1.0, "x")}, functools.partial(np.sum, axis=0)) is not first
    assert len(made) == 6
    for number in range(40):
        make(number)
    assert make(np.ones(2), {"a": (1.0, "x")}, functools.partial(np.sum, axis=0)) is not first  # dropped
