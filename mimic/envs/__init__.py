"""The imitation environments: `environments` lists their names, `env_config` is the config of one."""

import importlib.resources
import os
from collections.abc import Mapping
from typing import Any

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from mimic.arms.arm import ArmConfig
from mimic.base import registry
from mimic.base.config import check_choice, explain, merged, schema, suggestion, to_dict, typed
from mimic.base.lazy import modules_of
from mimic.envs.config import EnvConfig

__getattr__ = modules_of(__name__, __path__)

_PRESETS = importlib.resources.files("mimic") / "conf" / "env"
_GROUPS = ("metric", "world")  # groups of presets, in folders of that name


_BUILT_IN = tuple(sorted(path.name.removesuffix(".yaml") for path in _PRESETS.iterdir() if path.name.endswith(".yaml")))
registry.reserve("environment", _BUILT_IN)


def environments() -> tuple[str, ...]:
    """The names of the environments, those of mimic first and then those that are registered."""
    return (*_BUILT_IN, *registry.names("environment"))


def registered_preset(name: str) -> dict[str, Any]:
    """The fields that a registered environment sets, with its name.

    Raises:
      ValueError: no such environment.
    """
    thing = registry.find("environment", name, "env")
    if isinstance(thing, Mapping):
        return {**with_arm_configs(thing), "name": name}
    if isinstance(thing, EnvConfig):
        return {**to_dict(thing), "name": name}
    return {**with_arm_configs(getattr(thing, "preset", {})), "name": name, "environment": name}


def with_arm_configs(fields: Mapping[str, Any]) -> dict[str, Any]:
    """The fields of an environment, where an arm given by its name or file is a config of its own."""
    given = {key: fields[key] for key in ("expert", "learner") if key in fields}
    for key, arm in given.items():
        if not isinstance(arm, str | os.PathLike | Mapping | ArmConfig):
            raise ValueError(f"{key}: expected an arm's name, its file or an ArmConfig, got {arm!r:.80}")
    arms = {key: {"model": os.fspath(arm)} for key, arm in given.items() if isinstance(arm, str | os.PathLike)}
    return {**fields, **arms}


def env_config(name: str, **overrides: Any) -> EnvConfig:
    """Returns the config of an environment.

    Args:
      name: one of `environments()`.
      overrides: fields of `EnvConfig`. A nested config is a dict, as in `demonstrations={"count": 1}`. An arm may also
        be its name or file, as in `learner="arm.xml"`, and metric and world the name of a preset, as in
        `metric="paper"` and `world="hardware"`, which sets other fields too.

    Raises:
      ValueError: an unknown name or field, or a value of the wrong type or out of range.
    """
    valid = environments()
    if name not in valid:
        raise ValueError(f"unknown environment {name!r}; valid are {', '.join(valid)}{suggestion(name, valid)}")
    preset = _built_in_preset(name) if name in _BUILT_IN else registered_preset(name)
    named = {group: overrides[group] for group in _GROUPS if isinstance(overrides.get(group), str)}
    overrides = {key: value for key, value in overrides.items() if key not in named}
    presets = [_preset_of_group(group, preset) for group, preset in named.items()]
    try:
        return typed(merged(schema(EnvConfig), preset, *presets, with_arm_configs(overrides)))
    except OmegaConfBaseException as error:
        raise ValueError(explain(error)) from error


def _built_in_preset(name: str) -> DictConfig:
    preset = OmegaConf.load(str(_PRESETS / f"{name}.yaml"))
    assert isinstance(preset, DictConfig)
    del preset["defaults"]  # Hydra's defaults list; the schema is merged with it
    return preset


def _preset_of_group(group: str, name: str) -> DictConfig:
    """The fields of `EnvConfig` that a preset of a group sets."""
    folder = importlib.resources.files("mimic") / "conf" / group
    names = sorted(path.name.removesuffix(".yaml") for path in folder.iterdir() if path.name.endswith(".yaml"))
    check_choice(group, name, names)
    preset = OmegaConf.load(str(folder / f"{name}.yaml"))
    assert isinstance(preset, DictConfig)
    return OmegaConf.create({"metric": preset}) if group == "metric" else preset


__all__ = ["EnvConfig", "env_config", "environments"]
