"""Reading config files that others wrote: bounded size, aliases and references, and no resolvers.

A YAML alias and a reference ${key} repeat what they name, and repeated repetitions grow exponentially. A resolver, as
${oc.env:NAME}, would copy the value of an environment variable into a config that is saved with the results.
"""

import itertools
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import yaml
from omegaconf import DictConfig, OmegaConf
from omegaconf._utils import get_yaml_loader
from omegaconf.errors import OmegaConfBaseException

MAX_BYTES = 50_000  # a run's config has some 3 kB
MAX_VALUES = 5000  # with those that aliases repeat; a run's config has some 100
MAX_REPEATS = 8  # aliases or references; nested ones then repeat a value at most 18 times
_REFERENCE = re.compile(r"(?<!\\)\$\{\.*[A-Za-z_][\w.]*(?:\[\w+\][\w.]*)*\}")  # as ${seed} or ${..metric.xi}


class _BoundedLoader(get_yaml_loader()):
    """OmegaConf's loader, which constructs plain values only; counts aliases."""

    aliases = 0

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.AliasEvent):
            self.aliases += 1
            if self.aliases > MAX_REPEATS:
                raise ValueError(f"expected at most {MAX_REPEATS} aliases")
        return super().compose_node(parent, index)


def read_config(path: Path, *, may_be_empty: bool = False) -> DictConfig:
    """Reads a YAML file that holds a mapping, or nothing if it may be empty.

    Raises:
      ValueError: no regular file, too large, not YAML or no mapping, or with too many aliases. The message does not
        name the file.
    """
    if not path.is_file():
        raise ValueError("expected a regular file")
    with path.open("rb") as file:
        text = file.read(MAX_BYTES + 1)
    if len(text) > MAX_BYTES:
        raise ValueError(f"expected at most {MAX_BYTES:,} bytes, got {path.stat().st_size:,}")
    try:
        content = yaml.load(text.decode(), _BoundedLoader)
        if content is None and may_be_empty:
            content = {}
        if not isinstance(content, dict):
            raise ValueError(f"expected keys and values, got {content!r:.80}")
        if sum(1 for _ in itertools.islice(_values(content), MAX_VALUES + 1)) > MAX_VALUES:
            raise ValueError(f"expected at most {MAX_VALUES:,} values")
        return OmegaConf.create(content)
    except RecursionError as error:  # also for an alias of a value that it is in
        raise ValueError("expected values that are not nested as deeply") from error
    except (TypeError, yaml.YAMLError, OmegaConfBaseException) as error:  # TypeError: a key that is a mapping
        reason = getattr(error, "problem", None) or str(error)
        raise ValueError(" ".join(reason.split())) from error


def check_references(config: DictConfig) -> None:
    """Raises a ValueError where a text has a ${...} other than a reference to a key, or if there are too many."""
    texts = [(key, value) for key, value in _values(OmegaConf.to_container(config)) if isinstance(value, str)]
    for key, text in texts:
        if "${" in _REFERENCE.sub("", text):
            raise ValueError(
                f"{key}: expected no ${{...}} other than a reference to a key, as ${{seed}}, got {text!r:.80}"
            )
    references = sum(len(_REFERENCE.findall(text)) for _, text in texts)
    if references > MAX_REPEATS:
        raise ValueError(f"expected at most {MAX_REPEATS} references ${{...}} to keys, got {references}")


def _values(value: Any, key: str = "") -> Iterator[tuple[str, Any]]:
    """All values in nested mappings and lists, with their dotted keys."""
    yield key, value
    if isinstance(value, Mapping):
        for name, entry in value.items():
            yield from _values(entry, f"{key}.{name}" if key else str(name))
    elif isinstance(value, list):
        for index, entry in enumerate(value):
            yield from _values(entry, f"{key}[{index}]")
