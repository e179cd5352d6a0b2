"""How every command starts and fails: Hydra reads the config, and bad input is one line and exit code 2."""

import os
import re
import sys
from collections.abc import Callable
from dataclasses import FrozenInstanceError
from typing import Any, NoReturn

import hydra
from hydra.core.config_store import ConfigStore
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from mimic.config import explain, schema
from mimic.envs.config import EnvConfig, RetargetConfig
from mimic.trainers.config import EvaluateConfig, PPOConfig, TrainConfig

BAD_INPUT = 2
# FrozenInstanceError: a key that was added with "+".
_REFUSED = (ValueError, OSError, FrozenInstanceError, HydraException, OmegaConfBaseException)


def run(main: Callable[[Any], None], config_name: str) -> None:
    """Runs a command on its typed config; exits with 2 and one line for input that it cannot take."""
    os.environ["HYDRA_FULL_ERROR"] = "1"  # Hydra raises, and the line below is all that is shown
    _register_schemas()

    @hydra.main(version_base="1.3", config_path="pkg://mimic.conf", config_name=config_name)
    def command(config: DictConfig) -> None:
        try:
            main(OmegaConf.to_object(config))
        except _REFUSED as error:
            _refuse(error)

    try:
        command()
    except _REFUSED as error:
        _refuse(error)


def _refuse(error: BaseException) -> NoReturn:
    print(f"error: {_one_line(error)}", file=sys.stderr)
    sys.exit(BAD_INPUT)


def overrides() -> list[str]:
    """The overrides of the command line, of the job that runs now."""
    return list(HydraConfig.get().overrides.task)


def _register_schemas() -> None:
    store = ConfigStore.instance()
    store.store(name="train_schema", node=schema(TrainConfig))
    store.store(name="evaluate_schema", node=schema(EvaluateConfig))
    store.store(name="retarget_schema", node=schema(RetargetConfig))
    store.store(group="env", name="schema", node=schema(EnvConfig))
    store.store(group="trainer", name="schema", node=schema(PPOConfig))


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
    choice = re.search(r"Could not find '(\w+)/([^']*)'\s+Available options in '\w+':((?:\n\t\S+)*)", message)
    if choice:
        group, name, options = choice.groups()
        valid = ", ".join(sorted(set(options.split()) - {"schema"}))
        return f"unknown {group} {name!r}; valid are {valid}"
    return " ".join(message.split())
