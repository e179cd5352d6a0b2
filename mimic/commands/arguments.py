"""Checks of a command line before Hydra composes the config: Hydra would answer with a traceback or a usage text.

Hydra also composes what nobody means: an environment without a preset for `~env` or `env=[]`, an unchanged one for
`env={}`.
"""

import os
import re
from typing import Any, NoReturn

from hydra._internal.utils import get_args_parser
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException

from mimic.base import registry
from mimic.base.overrides import setting

_SPECIAL = re.compile(r"[^\w./:@+-]|[^\x00-\x7f]")  # characters that Hydra does not take as text, or not always
GROUPS = {"env": "panda4dof", "trainer": "ppo", "metric": "paper"}  # config groups, with the example of messages


def load_plugins(arguments: list[str]) -> list[str]:
    """Loads what `--plugin MODULE` names, and returns the other arguments.

    Raises:
      ValueError: a plugin that cannot be imported, or the option without a module.
    """
    others, rest = [], iter(arguments)
    for argument in rest:
        option, equals, plugin = argument.partition("=")
        if option == "--plugin":
            plugin = plugin if equals else next(rest, "")
            if not plugin:
                raise ValueError("--plugin: expected a module, as in --plugin my_terms")
            registry.load_plugin(plugin)
        else:
            others.append(argument)
    return others


def quoted(argument: str) -> str:
    """A setting with its value in quotes, where that is a file or text that is no Hydra syntax: `arm (1).urdf`."""
    key, equals, value = argument.partition("=")
    if not equals or argument.startswith("-") or not _SPECIAL.search(value) or value.startswith(("[", "{")):
        return argument
    text = setting(key, value)
    is_text = os.path.exists(os.path.expanduser(value)) or (not _is_hydra(argument) and _is_hydra(text))
    return text if is_text else argument


def _is_hydra(argument: str) -> bool:
    try:
        OverridesParser.create().parse_override(argument)
    except HydraException:
        return False
    return True


def check_arguments(arguments: list[str]) -> None:
    """Raises a ValueError for the first argument that is invalid in every command.

    Args:
      arguments: those of the command line, in Hydra's syntax.

    Raises:
      ValueError: an unknown option, no KEY=VALUE, a removed key, an empty value, or a config group without the name of
        a preset.
      HydraException: an argument that is not in Hydra's syntax.
    """
    parser = get_args_parser()
    parser.error = _raise_value_error  # type: ignore[method-assign]  # in place of a usage text
    options = parser.parse_args(arguments)
    if options.experimental_rerun:
        raise ValueError("--experimental-rerun: not supported, because it loads a pickle")
    for argument in options.overrides:
        if "=" not in argument and not argument.startswith("~"):
            raise ValueError(f"expected KEY=VALUE, got {argument!r}")
    for override in OverridesParser.create().parse_overrides(options.overrides):
        _check(override)


def _check(override: Override) -> None:
    key = override.key_or_group
    if not key:
        raise ValueError(f"expected KEY=VALUE, got {override.input_line!r}")
    if key.replace("/", ".").partition(".")[0] == "hydra":
        return
    if override.is_delete():
        raise ValueError(f"{override.input_line}: keys cannot be removed; expected KEY=VALUE")
    if override.is_sweep_override():
        return
    value = override.value()
    if value == {}:
        raise ValueError(f"{key}: expected a value, got {{}}")
    if key in GROUPS and not _is_preset(key, value):
        raise ValueError(f"{key}: expected the name of a preset, as in {key}={GROUPS[key]}, got {value!r}")


def _is_preset(group: str, value: Any) -> bool:
    """Whether the value of a group may name a preset; a mapping changes keys in the group."""
    if isinstance(value, str):
        return "$" not in value and not value.endswith("schema")
    return isinstance(value, dict) or (value is None and group == "metric")  # none is the default


def _raise_value_error(message: str) -> NoReturn:
    raise ValueError(message)
