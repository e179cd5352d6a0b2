"""How every command starts and fails: Hydra reads the config, and bad input is one line and exit code 2."""

import contextlib
import os
import re
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable
from dataclasses import FrozenInstanceError
from pathlib import Path
from typing import Any, NoReturn

import hydra
from hydra.core.config_store import ConfigStore
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from mimic import compat
from mimic.commands.config import (
    CollectConfig,
    EvaluateConfig,
    ExportConfig,
    FiguresConfig,
    InspectConfig,
    RecordingConfig,
    RenderConfig,
    RetargetConfig,
    ViewConfig,
)
from mimic.config import explain, schema
from mimic.envs.config import EnvConfig
from mimic.runs.signals import STOPPED_BY_SIGNAL
from mimic.sweeps.launchers import check_launcher, register_launchers
from mimic.sweeps.sweeper import FAILED, Outcome, register_sweeper
from mimic.trainers.config import TRAINERS, TrainConfig

BAD_INPUT = 2
ARM_KEYS = {  # of each command: keys that take an arm by name or file alone
    "train": ("env.expert", "env.learner"),
    "demonstrations": ("env.expert", "env.learner"),
    "inspect": ("expert", "learner"),
}
FIRST_KEY = {"inspect": "learner.model", "collect": "folder"}  # of each command: the key that needs no name
_CONFIG_ERRORS = (FrozenInstanceError, HydraException, OmegaConfBaseException)  # the first: a key added with "+"
_BAD_INPUT = (ValueError, OSError, *_CONFIG_ERRORS)

Work = Callable[[], int | None]  # returns the exit code, 0 for None


def run(prepare: Callable[[Any], Work], config_name: str) -> None:
    """Runs a command; exits with 2 and one line for input that it cannot take.

    Args:
      prepare: takes the typed config and returns the work. What it raises is the user's to mend, and is shown as one
        line; what the work raises is ours, and is shown whole.
      config_name: in mimic/conf.
    """
    os.environ["HYDRA_FULL_ERROR"] = "1"  # Hydra raises, and the line below is all that is shown
    sys.argv[1:] = [_written_out(argument, config_name) for argument in sys.argv[1:]]
    compat.share_config_store()
    _register_schemas()
    register_sweeper()
    register_launchers()

    @hydra.main(version_base="1.3", config_path="pkg://mimic.conf", config_name=config_name)
    def command(config: DictConfig) -> Outcome:
        if is_sweep():
            return _run_of_a_sweep(prepare, config)
        try:
            check_launcher(HydraConfig.get().runtime.choices["hydra/launcher"])
            work = prepare(OmegaConf.to_object(config))
        except _BAD_INPUT as error:
            _refuse(error)
        exit_code = work()
        if exit_code:
            sys.exit(exit_code)
        return Outcome()

    try:
        command()
    except _CONFIG_ERRORS as error:
        _refuse(error)
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        sys.exit(STOPPED_BY_SIGNAL + signal.SIGINT)


def _run_of_a_sweep(prepare: Callable[[Any], Work], config: DictConfig) -> Outcome:
    """One run among several in this process: where it fails the others still run, but a signal ends them all."""
    try:
        work = prepare(OmegaConf.to_object(config))
    except _BAD_INPUT as error:
        reason = _one_line(error)
        print(f"error: {reason}", file=sys.stderr)
        return Outcome(BAD_INPUT, reason)
    try:
        exit_code = work() or 0
    except Exception as error:
        traceback.print_exc()
        return Outcome(FAILED, " ".join(f"{type(error).__name__}: {error}".split()))
    if exit_code > STOPPED_BY_SIGNAL:
        sys.exit(exit_code)
    return Outcome(exit_code, f"exit code {exit_code}" if exit_code else "")


def _written_out(argument: str, command: str) -> str:
    """An argument as Hydra takes it: env.learner=ARM.xml is short for env.learner.model=ARM.xml."""
    key, equals, value = argument.partition("=")
    if command in FIRST_KEY and not equals and not argument.startswith("-"):
        return f"{FIRST_KEY[command]}={argument}"
    is_arm = key in ARM_KEYS.get(command, ()) and not value.startswith("{")
    return f"{key}.model={value}" if equals and is_arm else argument


def _refuse(error: BaseException) -> NoReturn:
    print(f"error: {_one_line(error)}", file=sys.stderr)
    sys.exit(BAD_INPUT)


def process_started() -> float:
    """`time.perf_counter()` at the start of this process; where the system does not tell, what it is now."""
    now = time.perf_counter()
    with contextlib.suppress(OSError, AttributeError, ValueError):
        ticks = int(Path("/proc/self/stat").read_text().rpartition(")")[2].split()[19])  # since boot: see proc(5)
        return now - (time.clock_gettime(time.CLOCK_BOOTTIME) - ticks / os.sysconf("SC_CLK_TCK"))
    return now


def start_backend() -> None:
    """Lets JAX find its devices, and take their memory, while this thread goes on to import: CUDA needs seconds."""
    threading.Thread(target=_find_devices, name="backend").start()


def _find_devices() -> None:
    import jax

    with contextlib.suppress(RuntimeError):  # said by whoever asks for them next
        jax.device_put(0).block_until_ready()


def overrides() -> list[str]:
    """The overrides of the command line, of the job that runs now."""
    return list(HydraConfig.get().overrides.task)


def is_sweep() -> bool:
    """Whether the command line asks for several jobs."""
    return HydraConfig.get().mode == RunMode.MULTIRUN


def _register_schemas() -> None:
    store = ConfigStore.instance()
    store.store(name="train_schema", node=schema(TrainConfig))
    store.store(name="collect_schema", node=schema(CollectConfig))
    store.store(name="evaluate_schema", node=schema(EvaluateConfig))
    store.store(name="export_schema", node=schema(ExportConfig))
    store.store(name="figures_schema", node=schema(FiguresConfig))
    store.store(name="render_schema", node=schema(RenderConfig))
    store.store(name="demonstrations_schema", node=schema(RecordingConfig))
    store.store(name="inspect_schema", node=schema(InspectConfig))
    store.store(name="retarget_schema", node=schema(RetargetConfig))
    store.store(name="view_schema", node=schema(ViewConfig))
    store.store(group="env", name="schema", node=schema(EnvConfig))
    for name, config_class in TRAINERS.items():
        store.store(group="trainer", name=f"{name}_schema", node=schema(config_class))


def _one_line(error: BaseException) -> str:
    """The innermost reason, as one line with the valid choices."""
    causes = [error]
    while causes[-1].__cause__ is not None:
        causes.append(causes[-1].__cause__)
    typed = [cause for cause in causes if isinstance(cause, OmegaConfBaseException)]
    if typed:
        return explain(typed[-1])
    if isinstance(error, FrozenInstanceError):
        return f"a key that does not exist cannot be added: {error}"
    message = str(error)
    choice = re.search(r"Could not find '([\w/]+)/([^'/]*)'\s+Available options in '[\w/]+':((?:\n\t\S+)*)", message)
    if choice:
        group, name, options = choice.groups()
        valid = ", ".join(sorted(option for option in set(options.split()) if not option.endswith("schema")))
        return f"unknown {group} {name!r}; valid are {valid}"
    return " ".join(message.split())
