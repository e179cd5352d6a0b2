"""Typed configs: frozen dataclasses as OmegaConf schemas, checks of values, and one-line error messages."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf


def schema(config_class: type) -> DictConfig:
    """Returns a typed OmegaConf node of a frozen dataclass, with its defaults."""
    node = OmegaConf.structured(config_class)
    _unfreeze(node)
    return node


def _unfreeze(node: DictConfig) -> None:
    """Makes a node writable: OmegaConf makes those of frozen dataclasses read-only, but presets set their fields."""
    OmegaConf.set_readonly(node, None)
    for key in node:
        child = node._get_node(key)
        if isinstance(child, DictConfig) and not child._is_none():
            _unfreeze(child)


def explain(error: Exception) -> str:
    """Returns a config error as one line: the key, what is wrong with it, and for an unknown key the valid keys."""
    message = " ".join(str(getattr(error, "msg", None) or error).splitlines()[0].split())
    key = getattr(error, "full_key", None) or getattr(error, "key", None)
    parent = getattr(error, "parent_node", None)
    if " not in " in message and isinstance(parent, DictConfig):
        return f"unknown key {str(key)!r}; valid are {', '.join(str(name) for name in parent if name != 'hydra')}"
    return f"{key}: {message}" if key and str(key) not in message else message


def check_choice(name: str, value: str, choices: Sequence[str]) -> None:
    """Raises a ValueError that lists the choices if the value is none of them."""
    if value not in choices:
        raise ValueError(f"{name}: expected one of {', '.join(choices)}, got {value!r}")


def new_file(name: str, path: str) -> Path:
    """Returns the path of a file that a command will write.

    Args:
      name: the config key, for error messages.
      path: the key's value.

    Raises:
      ValueError: the path is empty, exists, or its folder does not exist.
    """
    return _new_path(name, path, "file")


def new_folder(name: str, path: str) -> Path:
    """Returns the path of a folder that a command will create and write into; see `new_file`."""
    return _new_path(name, path, "folder")


def _new_path(name: str, path: str, kind: str) -> Path:
    if not path:
        raise ValueError(f"{name}: expected a {kind}, as in {name}={kind.upper()}")
    new = Path(path).expanduser()
    check_new(name, new, f"name a new {kind}")
    if not new.parent.is_dir():
        raise ValueError(f"{name}: {str(new)!r}: there is no folder {str(new.parent)!r}")
    return new


def check_new(name: str, path: Path, advice: str) -> None:
    """Raises a ValueError with some advice if a path exists: no output is ever overwritten."""
    if path.exists():
        raise ValueError(f"{name}: {str(path)!r} exists; {advice}")


def to_dict(config: Any) -> dict[str, Any]:
    """Returns a config as dicts and lists, for files."""
    return OmegaConf.to_container(OmegaConf.structured(config), resolve=True)  # type: ignore[return-value]


def flatten(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested mappings as one level with dotted keys, such as optimality_gap.train. Empty mappings stay values."""
    flat: dict[str, Any] = {}
    for key, value in values.items():
        is_nested = isinstance(value, Mapping) and value
        flat |= flatten(value, f"{prefix}{key}.") if is_nested else {f"{prefix}{key}": value}
    return flat
