"""Shared by all tests: run-time checks of shapes, the compilation cache, both precisions."""

import functools
import importlib
import importlib.util
import os
import signal
import sys
import typing

import jax
import pytest
from jaxtyping import config as jaxtyping_config
from jaxtyping import install_import_hook

from tests.helpers.compilations import check_budget
from tests.helpers.repository import CACHE, share_compilations

# Not mimic.base.spatial: its scalars have no shape to check, and it is called thousands of times for each arm.
CORE = (
    "arms.chain",
    "arms.embodiment",
    "arms.mujoco_chain",
    "metric.correspondence",
    "metric.distance",
    "metric.kinematics",
    "metric.motion_distance",
    "metric.similarity",
    "retargeting.closed_form",
    "retargeting.kinematic_bound",
    "retargeting.optimizers",
    "retargeting.pose",
    "retargeting.initial_guesses",
    "retargeting.pose_objective",
    "retargeting.trajectory",
)


def pytest_configure(config: pytest.Config) -> None:
    marks = config.getoption("markexpr") or ""
    if "gpu" not in marks or "not gpu" in marks:
        jax.config.update("jax_platforms", "cpu")
    share_compilations()  # in the environment, for processes that tests start; here JAX is imported already
    jax.config.update("jax_compilation_cache_dir", str(CACHE))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_traceback_in_locations_limit", 0)
    if importlib.util.find_spec("beartype") is not None:
        from tests.helpers import typechecking  # here already: the hook itself imports no more than `tests`

        install_import_hook([f"mimic.{module}" for module in CORE], f"{typechecking.__name__}.check")

    signal.signal(signal.SIGHUP, signal.SIG_DFL)  # under nohup it is ignored, by the commands that tests start too

    importlib.import_module("absl.logging")  # now: Hydra closes the stderr that this module finds
    from mimic.base import compat  # importing mimic after the hook is in place, and before JAX starts

    compat.prepare_cpu()


@pytest.hookimpl(tryfirst=True)  # before pytest selects by marks
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Marks the parameters that `slow_for` names as slow; quicker ones of the same test run in `make test`."""
    for item in items:
        if any(item.callspec.id in mark.args for mark in item.iter_markers("slow_for")):  # type: ignore[attr-defined]
            item.add_marker(pytest.mark.slow)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item):
    with check_budget(is_slow=any(item.iter_markers("slow"))):
        return (yield)


@pytest.fixture
def x64():
    """Double precision."""
    with jax.enable_x64(True):
        yield


@pytest.fixture(params=["float64", "float32"])
def dtype(request: pytest.FixtureRequest):
    """Runs a test in both precisions."""
    with jax.enable_x64(request.param == "float64"):
        yield jax.numpy.dtype(request.param)


@pytest.fixture
def interpreted(monkeypatch: pytest.MonkeyPatch):
    """Runs GPU kernels on the CPU, step by step."""
    from mimic.base import fused_kernel

    monkeypatch.setattr(fused_kernel.pl, "pallas_call", functools.partial(fused_kernel.pl.pallas_call, interpret=True))


@pytest.fixture
def gpu_kernels(interpreted, monkeypatch: pytest.MonkeyPatch):
    """Makes batched functions use their GPU kernels, interpreted on the CPU; returns the list of kernels used."""
    taken = []

    def choose(*rows, cuda, default):
        taken.append(cuda)
        return cuda(*rows)

    monkeypatch.setattr(jax.lax, "platform_dependent", choose)
    return taken


@pytest.fixture
def unchecked():
    """Turns the shape checks off, so that the error messages are those that users see."""
    jaxtyping_config.update("jaxtyping_disable", True)
    yield
    jaxtyping_config.update("jaxtyping_disable", False)


@pytest.fixture
def own_registry(monkeypatch: pytest.MonkeyPatch):
    """An empty registry for one test; installed plugins are not loaded."""
    from mimic.base import registry

    monkeypatch.setattr(registry, "_registered", {kind: {} for kind in registry.KINDS})
    monkeypatch.setattr(registry, "_is_loaded", True)
    monkeypatch.setenv(registry.VARIABLE, "")
    monkeypatch.setattr(sys, "path", [*sys.path])
    yield registry
    for plugin in os.environ[registry.VARIABLE].split(","):
        sys.modules.pop(plugin, None)


@pytest.fixture
def in_time():
    """Ends a reader that waits."""

    def stop(*_):
        raise TimeoutError("a reader waits")

    previous = signal.signal(signal.SIGALRM, stop)
    signal.alarm(100)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, previous)


@pytest.fixture(scope="session")
def schemas():
    """`mimic.base.config.schema`, once for each class."""
    from tests.helpers import commands

    return commands.schemas


@pytest.fixture
def rejected(monkeypatch, capsys, tmp_path, schemas):
    """A function that runs a command in an empty folder and returns the line that it is rejected with."""

    def run(name, *arguments):
        from mimic.commands import cli

        monkeypatch.setattr(cli, "schema", schemas)
        folder = tmp_path / "empty"
        folder.mkdir()
        monkeypatch.chdir(folder)
        monkeypatch.setattr(sys, "argv", [f"mimic.{name}", *map(str, arguments)])
        with pytest.raises(SystemExit) as stop:
            cli.run(importlib.import_module(f"mimic.{name}").prepare, name)
        error = capsys.readouterr().err
        assert stop.value.code == 2, error
        assert error.startswith("error: ") and error.count("\n") == 1
        assert not list(folder.iterdir())
        return error

    return run


@pytest.fixture
def reason(monkeypatch, tmp_path, schemas):
    """A function that prepares a command in an empty folder and returns why it is rejected.

    Twenty times as fast as `rejected`, which also composes the config; each command has cases of both.
    """

    def run(name, *arguments):
        from omegaconf import DictConfig, OmegaConf

        from mimic.base.config import to_dict, typed
        from mimic.commands import cli
        from mimic.envs import env_config
        from mimic.trainers.config import trainer_config

        prepare = importlib.import_module(f"mimic.{name}").prepare
        monkeypatch.setattr(cli, "overrides", lambda: list(arguments))
        (folder := tmp_path / "empty").mkdir()
        monkeypatch.chdir(folder)
        with pytest.raises(ValueError) as error:
            keys = cli.expand_arguments(list(map(str, arguments)), name)
            settings = {key: value or "''" for key, _, value in (key.partition("=") for key in keys)}
            preset: dict[str, typing.Any] = {}
            if "env" in settings:
                preset["env"] = to_dict(env_config(settings.pop("env")))
            if name == "train":
                trainer = settings.pop("trainer", "ppo")
                preset["trainer"] = OmegaConf.merge(schemas(trainer_config(trainer)), {"name": trainer})
            schema = schemas(typing.get_type_hints(prepare)["config"])
            given = OmegaConf.from_dotlist([f"{key}={value}" for key, value in settings.items()])
            prepare(typed(DictConfig(OmegaConf.merge(schema, preset, given))))
        assert not list(folder.iterdir())
        return str(error.value)

    return run
