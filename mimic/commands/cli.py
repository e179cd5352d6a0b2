"""Start and error handling of every command: Hydra reads the config; bad input prints one line and exits with 2."""

import contextlib
import os
import re
import sys
import threading
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import FrozenInstanceError
from pathlib import Path
from string import Template
from typing import Any, NoReturn

import hydra
from hydra._internal.utils import get_args
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig, open_dict
from omegaconf.errors import OmegaConfBaseException

from mimic.base import compat, registry
from mimic.base.config import BAD_INPUT, explain, schema, suggestion, typed, with_full_keys
from mimic.base.distribution import VERSION
from mimic.base.files import read_text
from mimic.commands.arguments import check_arguments, load_plugins, quoted
from mimic.commands.arm_keys import expand_arms
from mimic.commands.config import (
    CollectConfig,
    DatasetConfig,
    EvaluateConfig,
    InspectConfig,
    RecordingConfig,
    RenderConfig,
    RetargetConfig,
    ViewConfig,
)
from mimic.commands.key_help import key_lines
from mimic.envs import registered_preset
from mimic.envs.config import EnvConfig
from mimic.runs.signals import STOPPED_BY_SIGNAL, ended_without_reader, watched_signals
from mimic.runs.sweeps.hydra_plugins import bound_config_files
from mimic.runs.sweeps.launchers import check_launcher, register_launchers
from mimic.runs.sweeps.sweeper import FAILED, Outcome, register_sweeper
from mimic.trainers.config import TrainConfig, trainer_config, trainers
from mimic.trainers.export.config import ExportConfig

_SWITCH_INTERVAL = 5e-4  # s; with Python's 5 ms, a loop of short numpy calls starves beside threads that compile
_LONGEST_MESSAGE = 1000  # characters: Hydra repeats the argument
FIRST_KEY = {"inspect": "learner", "collect": "folder"}  # key of each command's positional argument
FIRST_KEY_OF_SUFFIX = {  # the same where the argument is a file of another kind
    "inspect": {".bvh": "clip", ".c3d": "clip", ".trc": "clip", ".csv": "clip"},
}
# Options of Hydra whose value is the next argument.
_WITH_VALUE = ("--cfg", "-c", "--package", "-p", "--config-path", "-cp", "--config-name", "-cn", "--config-dir", "-cd")
_OPTIONAL_PARTS = {  # of the config of an environment, and what has them
    "env.world": "an inner loop, as in world=ideal, nominal or hardware",
    "env.arms": "sampled arms, as in env=any_arm or panda_family",
}
_CONFIG_ERRORS = (
    FrozenInstanceError,
    HydraException,
    OmegaConfBaseException,
)  # FrozenInstanceError: a key added with "+"
_BAD_INPUT = (ValueError, OSError, *_CONFIG_ERRORS)

Work = Callable[[], int | None]  # returns the exit code, 0 for None


@ended_without_reader()
def run(prepare: Callable[[Any], Work], config_name: str) -> None:
    """Runs a command; for bad input it prints one line and exits with 2, and with 1 if files fail later (disk full).

    Args:
      prepare: checks the typed config and returns the work. Errors that it raises are user errors and print one line;
        errors of the work are bugs and keep their traceback.
      config_name: name of the command and of its config in mimic/conf.
    """
    if "--version" in sys.argv[1:]:  # Hydra would print its own
        print(f"mimic {VERSION}")
        return
    os.environ["HYDRA_FULL_ERROR"] = "1"  # Hydra raises errors instead of printing them
    given = [argument.partition("=")[0].lstrip("+") for argument in sys.argv[1:]]
    try:
        sys.argv[1:] = expand_arguments(load_plugins(sys.argv[1:]), config_name)
        register()
    except ValueError as error:  # of a plugin
        _exit_with_error(error)
    is_composed = False  # all errors before that are user errors

    @hydra.main(version_base="1.3", config_path="pkg://mimic.conf", config_name=config_name)
    def command(config: DictConfig) -> Outcome:
        nonlocal is_composed
        is_composed = True

        def prepare_typed() -> Work:
            try:
                return prepare(typed(config))
            except ValueError as error:
                if isinstance(error, OmegaConfBaseException):
                    raise
                raise ValueError(with_full_keys(str(error), config, given)) from error

        return _sweep_run(prepare_typed) if is_sweep() else _single_run(prepare_typed)

    try:
        with watched_signals():
            check_arguments(sys.argv[1:])
            if not _print_help(config_name):
                command()
    except _CONFIG_ERRORS as error:
        _exit_with_error(error)
    except OSError as error:  # of Hydra or our sweeper
        _exit_with_error(error, FAILED if is_composed else BAD_INPUT)
    except (ValueError, RecursionError) as error:
        if is_composed:
            raise
        _exit_with_error(error)
    except (AssertionError, AttributeError):  # of OmegaConf: a key of a config that is null
        if is_composed or not (message := _key_of_nothing(sys.argv[1:])):
            raise
        _exit_with_error(ValueError(message))


def _print_help(config_name: str) -> bool:
    """Prints the help if the command line asks for it; returns whether it did."""
    options = get_args(sys.argv[1:])
    if not options.help or options.config_dir or options.config_name or options.config_path:  # Hydra prints the help
        return False
    with hydra.initialize_config_module("mimic.conf", version_base="1.3"):
        loader = GlobalHydra.instance().config_loader()
        config = loader.load_configuration(config_name, options.overrides, RunMode.RUN)
    template = config.hydra.help.template
    with open_dict(config):
        del config["hydra"]
    print(Template(template).substitute(CONFIG="\n".join(key_lines(config))).rstrip())
    return True


def register() -> None:
    """Registers with Hydra what the configs in mimic/conf refer to."""
    compat.share_config_store()
    _register_schemas()
    register_sweeper()
    register_launchers()
    bound_config_files()


def _single_run(prepare: Callable[[], Work]) -> Outcome:
    """The run of a command without a sweep; ends the process where it fails."""
    try:
        check_launcher(HydraConfig.get().runtime.choices["hydra/launcher"])
        work = prepare()
    except _BAD_INPUT as error:
        _exit_with_error(error)
    try:
        exit_code = work()
    except OSError as error:  # disk full, quota, permission
        _exit_with_error(error, FAILED)
    if exit_code:
        sys.exit(exit_code)
    return Outcome()


def _sweep_run(prepare: Callable[[], Work]) -> Outcome:
    """One run of a sweep in this process. The other runs continue after a failure, but a signal ends them all."""
    try:
        work = prepare()
    except _BAD_INPUT as error:
        return Outcome(BAD_INPUT, _print_error(error))
    try:
        exit_code = work() or 0
    except OSError as error:
        return Outcome(FAILED, _print_error(error))
    except Exception as error:
        traceback.print_exc()
        return Outcome(FAILED, " ".join(f"{type(error).__name__}: {error}".split()))
    if exit_code > STOPPED_BY_SIGNAL:
        sys.exit(exit_code)
    return Outcome(exit_code, f"exit code {exit_code}" if exit_code else "")


def expand_arguments(arguments: Sequence[str], command: str) -> list[str]:
    """Returns the arguments of a command in Hydra's syntax: its positional argument, keys of arms, and texts in quotes.

    Raises:
      ValueError: two positional arguments, or what `expand_arms` rejects.
    """
    words = zip(["", *arguments], arguments, strict=False)
    keyed = [word if option in _WITH_VALUE else _with_key(word, command) for option, word in words]
    if len(given := [word for word, key in zip(arguments, keyed, strict=True) if word != key]) > 1:
        raise ValueError(f"expected one argument without a key, got {' and '.join(given)}")
    return list(map(quoted, expand_arms(keyed, command)))


def _with_key(argument: str, command: str) -> str:
    is_setting = "=" in argument and not os.path.exists(argument)
    if command not in FIRST_KEY or is_setting or argument.startswith("-"):
        return argument
    of_suffix = FIRST_KEY_OF_SUFFIX.get(command, {})
    return f"{of_suffix.get(Path(argument).suffix.lower(), FIRST_KEY[command])}={argument}"


def _key_of_nothing(arguments: Sequence[str]) -> str:
    """The error message for a key of a part that the environment does not have."""
    for argument in arguments:
        for part, advice in _OPTIONAL_PARTS.items():
            if argument.lstrip("+~").startswith((f"{part}.", f"{part}={{")):
                return f"{argument.partition('=')[0]}: expected with {advice}; {part} is null"
    return ""


def _exit_with_error(error: BaseException, exit_code: int = BAD_INPUT) -> NoReturn:
    _print_error(error)
    sys.exit(exit_code)


def _print_error(error: BaseException) -> str:
    """Prints an error as one line and returns the line, unless it is that nobody reads the output."""
    if isinstance(error, BrokenPipeError):
        raise error
    print(f"error: {(line := _one_line(error))}", file=sys.stderr)
    return line


def process_started() -> float:
    """`time.perf_counter()` at the start of this process; its present value if the system does not report it."""
    now = time.perf_counter()
    with contextlib.suppress(OSError, AttributeError, ValueError):
        ticks = int(read_text("/proc/self/stat").rpartition(")")[2].split()[19])  # since boot: see proc(5)
        return now - (time.clock_gettime(time.CLOCK_BOOTTIME) - ticks / os.sysconf("SC_CLK_TCK"))
    return now


def start_backend() -> None:
    """Initialises JAX's backend in a thread while this one imports modules: CUDA takes seconds."""
    sys.setswitchinterval(_SWITCH_INTERVAL)
    threading.Thread(target=_initialise_backend, name="backend").start()


def _initialise_backend() -> None:
    import jax

    with contextlib.suppress(RuntimeError):  # raised again by the next use of the backend
        jax.device_put(0).block_until_ready()


def overrides() -> list[str]:
    """The command-line overrides of the present run."""
    return list(HydraConfig.get().overrides.task)


def is_sweep() -> bool:
    """Whether the command line starts a sweep."""
    return HydraConfig.get().mode == RunMode.MULTIRUN


def _register_schemas() -> None:
    store = ConfigStore.instance()
    store.store(name="train_schema", node=schema(TrainConfig))
    store.store(name="collect_schema", node=schema(CollectConfig))
    store.store(name="dataset_schema", node=schema(DatasetConfig))
    store.store(name="evaluate_schema", node=schema(EvaluateConfig))
    store.store(name="export_schema", node=schema(ExportConfig))
    store.store(name="render_schema", node=schema(RenderConfig))
    store.store(name="demonstrations_schema", node=schema(RecordingConfig))
    store.store(name="inspect_schema", node=schema(InspectConfig))
    store.store(name="retarget_schema", node=schema(RetargetConfig))
    store.store(name="view_schema", node=schema(ViewConfig))
    store.store(group="env", name="schema", node=schema(EnvConfig))
    for name in trainers():
        store.store(group="trainer", name=f"{name}_schema", node=schema(trainer_config(name)))
    for name in registry.names("trainer"):
        store.store(group="trainer", name=name, node={"defaults": [f"{name}_schema", "_self_"], "name": name})
    for name in registry.names("environment"):
        store.store(group="env", name=name, node={"defaults": ["schema", "_self_"], **registered_preset(name)})


def _one_line(error: BaseException) -> str:
    """An error as one line with the valid choices; of OmegaConf's and Hydra's errors the innermost cause."""
    causes = [error]
    while causes[-1].__cause__ is not None:
        causes.append(causes[-1].__cause__)
    typed_errors = [cause for cause in causes if isinstance(cause, OmegaConfBaseException)]
    if typed_errors and isinstance(error, _CONFIG_ERRORS):
        return explain(typed_errors[-1])
    if isinstance(error, FrozenInstanceError):
        return f"unknown keys cannot be added: {error}"
    message = str(error)
    choice = re.search(r"Could not find '([\w/]+)/([^'/]*)'\s+Available options in '[\w/]+':((?:\n\t\S+)*)", message)
    if choice:
        group, name, options = choice.groups()
        valid = ", ".join(sorted(option for option in set(options.split()) if not option.endswith("schema")))
        return f"unknown {group} {name!r}; valid are {valid}{suggestion(name, valid.split(', '))}"
    return " ".join(message.split())[:_LONGEST_MESSAGE]
