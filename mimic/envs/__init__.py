"""The imitation environments: `environments` lists their names, `make` makes one by its name."""

import importlib.resources
from typing import TYPE_CHECKING, Any

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from mimic import compat
from mimic.config import check_choice, explain, merged, schema, suggestion, typed
from mimic.envs.config import EnvConfig

if TYPE_CHECKING:
    from mimic.envs.imitation import ImitationEnv

_PRESETS = importlib.resources.files("mimic") / "conf" / "env"
_METRICS = importlib.resources.files("mimic") / "conf" / "metric"


def environments() -> tuple[str, ...]:
    """The names of the environments."""
    return tuple(sorted(path.name.removesuffix(".yaml") for path in _PRESETS.iterdir() if path.name.endswith(".yaml")))


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
    preset = OmegaConf.load(str(_PRESETS / f"{name}.yaml"))
    assert isinstance(preset, DictConfig)
    del preset["defaults"]  # Hydra's defaults list; the schema is merged below
    presets = {"metric": _metric_preset(overrides["metric"])} if isinstance(overrides.get("metric"), str) else {}
    arms = {key: {"model": overrides[key]} for key in ("expert", "learner") if isinstance(overrides.get(key), str)}
    try:
        return typed(merged(schema(EnvConfig), preset, {**overrides, **arms, **presets}))
    except OmegaConfBaseException as error:
        raise ValueError(explain(error)) from error


def _metric_preset(name: str) -> DictConfig:
    names = sorted(path.name.removesuffix(".yaml") for path in _METRICS.iterdir() if path.name.endswith(".yaml"))
    check_choice("metric", name, names)
    preset = OmegaConf.load(str(_METRICS / f"{name}.yaml"))
    assert isinstance(preset, DictConfig)
    return preset


def make(name: str, **overrides: Any) -> "ImitationEnv":
    """Makes an environment with its training demonstrations.

    Args:
      name: one of `environments()`.
      overrides: fields of the config, see `env_config`.

    Raises:
      ValueError: an unknown name or field, a value of the wrong type or out of range, demonstrations that do not fit.
    """
    compat.import_mjx()
    from mimic.envs.imitation import ImitationEnv  # imports brax and MJX, which takes seconds

    return ImitationEnv(env_config(name, **overrides))


__all__ = ["EnvConfig", "env_config", "environments", "make"]
