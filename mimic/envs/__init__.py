"""The imitation environments: `environments` lists their names, `make` makes one by its name."""

import importlib.resources
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from mimic import compat, registry
from mimic.config import check_choice, explain, merged, schema, suggestion, to_dict, typed
from mimic.envs.config import EnvConfig

if TYPE_CHECKING:
    from mimic.envs.imitation import ImitationEnv

_PRESETS = importlib.resources.files("mimic") / "conf" / "env"
_METRICS = importlib.resources.files("mimic") / "conf" / "metric"


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
    arms = {key: {"model": fields[key]} for key in ("expert", "learner") if isinstance(fields.get(key), str)}
    return {**fields, **arms}


def env_config(name: str, **overrides: Any) -> EnvConfig:
    """Returns the config of an environment.

    Args:
      name: one of `environments()`.
      overrides: fields of `EnvConfig`. A nested config is a dict, as in `demonstrations={"count": 1}`. An arm may also
        be its name or file, as in `learner="arm.xml"`, and the metric the name of a preset, as in `metric="paper"`.

    Raises:
      ValueError: an unknown name or field, or a value of the wrong type or out of range.
    """
    valid = environments()
    if name not in valid:
        raise ValueError(f"unknown environment {name!r}; valid are {', '.join(valid)}{suggestion(name, valid)}")
    preset = _built_in_preset(name) if name in _BUILT_IN else registered_preset(name)
    presets = {"metric": _metric_preset(overrides["metric"])} if isinstance(overrides.get("metric"), str) else {}
    try:
        return typed(merged(schema(EnvConfig), preset, {**with_arm_configs(overrides), **presets}))
    except OmegaConfBaseException as error:
        raise ValueError(explain(error)) from error


def _built_in_preset(name: str) -> DictConfig:
    preset = OmegaConf.load(str(_PRESETS / f"{name}.yaml"))
    assert isinstance(preset, DictConfig)
    del preset["defaults"]  # Hydra's defaults list; the schema is merged with it
    return preset


def _metric_preset(name: str) -> DictConfig:
    names = sorted(path.name.removesuffix(".yaml") for path in _METRICS.iterdir() if path.name.endswith(".yaml"))
    check_choice("metric", name, names)
    preset = OmegaConf.load(str(_METRICS / f"{name}.yaml"))
    assert isinstance(preset, DictConfig)
    return preset


def make(name: str, **overrides: Any) -> "ImitationEnv":
    """Makes an environment of one learner with its training demonstrations; `mimic.make` makes those of many too.

    Args:
      name: one of `environments()`.
      overrides: fields of the config, see `env_config`.

    Raises:
      ValueError: an unknown name or field, a value of the wrong type or out of range, demonstrations that do not fit.
    """
    config = env_config(name, **overrides)
    config.check_one_learner()
    compat.import_mjx()
    from mimic.envs.imitation import make_env  # imports brax and MJX, which takes seconds

    return make_env(config)


__all__ = ["EnvConfig", "env_config", "environments", "make"]
