"""Reads config files that others wrote, without what repeats a value or reads the environment.

A YAML alias and a reference ${key} repeat what they name, and repeated repetitions grow exponentially. A resolver, as
${oc.env:NAME}, would copy the value of an environment variable into a config that is saved with the results.
"""

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import yaml
from omegaconf import DictConfig, OmegaConf
from omegaconf._utils import get_yaml_loader
from omegaconf.errors import OmegaConfBaseException

from mimic.base.files import read_text

MAX_BYTES = 50_000  # a run's config has some 3 kB
MAX_REFERENCES = 8
_REFERENCE = re.compile(r"(?<!\\)\$\{\.*[A-Za-z_][\w.]*(?:\[\w+\][\w.]*)*\}")  # as ${seed} or ${..metric.rotation}


class _Loader(get_yaml_loader()):
    """OmegaConf's loader, which constructs plain values only; without aliases."""

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.AliasEvent):
            raise ValueError(f"expected no aliases, got *{self.peek_event().anchor:.40}")
        return super().compose_node(parent, index)


def read_config(path: Path, *, may_be_empty: bool = False) -> DictConfig:
    """Reads a YAML file that holds a mapping, or nothing if it may be empty.

    Raises:
      ValueError: see `read_text`; or it is not YAML or no mapping, or has an alias. The message does not name the file.
    """
    try:
        content = yaml.load(read_text(path, MAX_BYTES), _Loader)
        if content is None and may_be_empty:
            content = {}
        if not isinstance(content, dict):
            raise ValueError(f"expected keys and values, got {content!r:.80}")
        return OmegaConf.create(content)
    except RecursionError as error:
        raise ValueError("expected values that are not nested as deeply") from error
    except (TypeError, yaml.YAMLError, OmegaConfBaseException) as error:  # TypeError: a key that is a mapping
        reason = getattr(error, "problem", None) or str(error)
        raise ValueError(" ".join(reason.split())) from error


def check_references(config: DictConfig) -> None:
    """Raises a ValueError where a text has a ${...} other than a reference to a key, or if there are too many."""
    references = 0
    for key, text in _texts(OmegaConf.to_container(config)):
        if "${" in _REFERENCE.sub("", text):
            raise ValueError(
                f"{key}: expected no ${{...}} other than a reference to a key, as ${{seed}}, got {text!r:.80}"
            )
        references += len(_REFERENCE.findall(text))
    if references > MAX_REFERENCES:
        raise ValueError(f"expected at most {MAX_REFERENCES} references ${{...}} to keys, got {references}")


def _texts(value: Any, key: str = "") -> Iterator[tuple[str, str]]:
    """All texts in nested mappings and lists, with their dotted keys."""
    if isinstance(value, str):
        yield key, value
    elif isinstance(value, Mapping):
        for name, entry in value.items():
            yield from _texts(entry, f"{key}.{name}" if key else str(name))
    elif isinstance(value, list):
        for index, entry in enumerate(value):
            yield from _texts(entry, f"{key}[{index}]")
