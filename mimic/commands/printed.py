"""Lines that a command prints, and in them commands: complete, and quoted for a shell."""

import os
from collections.abc import Mapping
from typing import Any

from rich.console import Console

from mimic.arms.named_arms import is_arm_name, named_arms
from mimic.base.config import to_dict
from mimic.base.overrides import setting, shell_words
from mimic.commands.arm_keys import ROLES
from mimic.envs import env_config, environments
from mimic.envs.config import EnvConfig

_WORLDS = (None, "ideal", "nominal", "hardware", "unknown")


def say(console: Console, *lines: str) -> None:
    """Prints lines as they are: not wrapped, without markup and colours."""
    for line in lines:
        console.print(line, soft_wrap=True, highlight=False, markup=False)


def train_command(env: EnvConfig) -> str:
    """The command that trains in an environment: its name, the world that it is nearest to, and all other changes."""
    name = env.name if env.name in environments() else "pair"
    changes = {world: _changes(env, name, world) for world in _WORLDS if (world is None) == (env.world is None)}
    world = min(changes, key=lambda world: len(changes[world]))
    words = [f"env={name}", *([f"world={world}"] if world else [])]
    words += [_word(key, value) for key, value in changes[world].items()]
    return f"python -m mimic.train {shell_words(words)}"


def _changes(env: EnvConfig, name: str, world: str | None) -> dict[str, Any]:
    """The keys whose values are not those of a preset; an arm of another model first, then the other fields."""
    preset = _values(env_config(name, **({"world": world} if world else {})))
    return {key: value for key, value in _values(env).items() if value != preset.get(key)}


def _values(env: EnvConfig) -> dict[str, Any]:
    """All keys; the arms' mappings by joint are values, not groups of keys."""
    values = to_dict(env)
    arms = {f"env.{role}.{key}": value for role in ROLES for key, value in values.pop(role).items()}
    parts = {f"env.{key}.": values.pop(key) for key in [key for key in values if isinstance(values[key], Mapping)]}
    flat = {f"{part}{key}": value for part, fields in parts.items() for key, value in fields.items()}
    return arms | {f"env.{key}": value for key, value in values.items()} | flat


def _word(key: str, value: Any) -> str:
    return setting(key, shown_model(value) if key.endswith(".model") else value)


def shown_model(model: str) -> str:
    """The name of an arm that has one, else its file, relative to the current folder if it is inside."""
    if not os.path.isabs(model):
        return model
    names = {os.path.abspath(file): name for name, file in named_arms().items() if is_arm_name(name)}
    path = os.path.relpath(model)
    return names.get(model) or (model if path.startswith("..") else path)
