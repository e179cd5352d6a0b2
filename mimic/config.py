"""Typed configs: frozen dataclasses as OmegaConf schemas, and what is wrong with a value in one line."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf


def schema(config_class: type) -> DictConfig:
    """A typed OmegaConf node of a frozen dataclass, with its defaults."""
    node = OmegaConf.structured(config_class)
    _unfreeze(node)
    return node


def _unfreeze(node: DictConfig) -> None:
    """OmegaConf takes the nodes of frozen dataclasses for read-only; presets and overrides must fill them in."""
    OmegaConf.set_readonly(node, None)
    for key in node:
        child = node._get_node(key)
        if isinstance(child, DictConfig) and not child._is_none():
            _unfreeze(child)


def explain(error: Exception) -> str:
    """One line for a config error: what is wrong with which key, and the valid keys."""
    message = " ".join(str(getattr(error, "msg", None) or error).splitlines()[0].split())
    key = getattr(error, "full_key", None) or getattr(error, "key", None)
    parent = getattr(error, "parent_node", None)
    if " not in " in message and isinstance(parent, DictConfig):
        return f"unknown key {str(key)!r}; valid are {', '.join(str(name) for name in parent if name != 'hydra')}"
    return f"{key}: {message}" if key and str(key) not in message else message


def check_choice(name: str, value: str, choices: Sequence[str]) -> None:
    """Raises a ValueError that names the choices, unless the value is one of them."""
    if value not in choices:
        raise ValueError(f"{name}: expected one of {', '.join(choices)}, got {value!r}")


def new_file(name: str, path: str) -> Path:
    """The file that a command creates.

    Args:
      name: config key.
      path: value of the key.

    Raises:
      ValueError: the path is empty, it exists, or its parent folder does not.
    """
    if not path:
        raise ValueError(f"{name}: expected a file, as in {name}=FILE")
    return _new_path(name, path, "file")


def new_folder(name: str, path: str) -> Path:
    """The folder that a command creates.

    Args:
      name: config key.
      path: value of the key.

    Raises:
      ValueError: the path exists, or its parent folder does not.
    """
    return _new_path(name, path, "folder")


def _new_path(name: str, path: str, kind: str) -> Path:
    new = Path(path).expanduser()
    if new.exists() or not new.parent.is_dir():
        reason = f"exists; name a new {kind}" if new.exists() else f"there is no folder {str(new.parent)!r}"
        raise ValueError(f"{name}: {str(new)!r}: {reason}")
    return new


def to_dict(config: Any) -> dict[str, Any]:
    """A config as plain containers, for files."""
    return OmegaConf.to_container(OmegaConf.structured(config), resolve=True)  # type: ignore[return-value]


def flatten(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested mappings as one level with dotted keys, such as optimality_gap.train. Empty mappings stay values."""
    flat: dict[str, Any] = {}
    for key, value in values.items():
        is_nested = isinstance(value, Mapping) and value
        flat |= flatten(value, f"{prefix}{key}.") if is_nested else {f"{prefix}{key}": value}
    return flat
