"""Typed configs: frozen dataclasses as OmegaConf schemas, and their errors in one line."""

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


def to_dict(config: Any) -> dict[str, Any]:
    """A config as plain containers, for files."""
    return OmegaConf.to_container(OmegaConf.structured(config), resolve=True)  # type: ignore[return-value]
