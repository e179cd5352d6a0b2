"""Typed configs: frozen dataclasses as OmegaConf schemas, checks of values, and one-line error messages."""

import contextlib
import dataclasses
import os
import re
import tempfile
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Any, cast

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from mimic.base.config_files import check_references
from mimic.base.ranges import ranges

BAD_INPUT = 2  # exit code of a command whose input is rejected
_LONGEST_IN_RUN = 200  # characters of the longest path within a run directory


def schema(config_class: type) -> DictConfig:
    """Returns a typed OmegaConf node of a frozen dataclass, with its defaults."""
    node = OmegaConf.structured(config_class)
    _unfreeze(node)
    return node


def _unfreeze(node: DictConfig) -> None:
    """Makes a node writable: OmegaConf makes those of frozen dataclasses read-only, but presets set their fields."""
    OmegaConf.set_readonly(node, None)
    for key in () if node._is_none() else node:
        child = node._get_node(key)
        if isinstance(child, DictConfig):
            _unfreeze(child)
            if OmegaConf.get_type(child) is dict:  # its keys are the user's; Hydra forbids new keys elsewhere
                OmegaConf.set_struct(child, False)


def typed(config: DictConfig) -> Any:
    """Returns a config as its frozen dataclass.

    Raises:
      ValueError: a number out of range, or a ${...} other than a reference to a key. The line names the full key.
    """
    check_references(config)
    _check_ranges(config)
    return _as_object(config)


def _as_object(node: DictConfig, prefix: str = "") -> Any:
    """A node as its dataclass; the line of an error of a dataclass in it has the full key."""
    try:
        return OmegaConf.to_object(node)
    except ValueError as error:
        for key in node:
            child = node._get_node(key)
            if (
                isinstance(child, DictConfig)
                and not child._is_none()
                and not child._is_missing()
                and not child._is_interpolation()
            ):
                _as_object(child, f"{prefix}{key}.")
        if isinstance(error, OmegaConfBaseException) or str(error).partition(":")[0] not in node:
            raise
        raise ValueError(f"{prefix}{error}") from error


def _check_ranges(node: DictConfig, prefix: str = "") -> None:
    config_class = OmegaConf.get_type(node)
    limits = ranges(config_class) if config_class is not None else {}
    for key in node:
        if OmegaConf.is_missing(node, key):
            continue
        value, name = node[key], f"{prefix}{key}"
        if value is None and node._get_node(key)._metadata.optional:  # type: ignore[union-attr]
            continue
        expected = node._get_node(key)._metadata.ref_type  # type: ignore[union-attr]
        if dataclasses.is_dataclass(expected) and expected not in (OmegaConf.get_type(value) or object).__mro__:
            raise ValueError(f"{name}: expected keys and values of its own, got {value!s:.80}")  # by a reference
        if isinstance(value, DictConfig):
            _check_ranges(value, f"{name}.")
        elif key in limits:
            limits[key].check(name, value)


_SCALARS = {
    "str": "a text",
    **dict.fromkeys(("int", "Integer"), "a whole number"),
    **dict.fromkeys(("float", "Float"), "a number"),
    "bool": "true or false",
}
_WRONG_SCALAR = re.compile(r"Value '(.*)' (?:of type '\w+' could not be converted to (\w+)|is not a valid (bool) .*)")


def _as_written(value: str) -> str:
    """A value as the user should have written it, if it is a whole number with a point or an exponent."""
    with contextlib.suppress(ValueError):
        if float(value).is_integer() and not value.lstrip("-").isdigit():
            return f"{value}; write {int(float(value))}"
    return repr(value)


def explain(error: Exception) -> str:
    """Returns a config error as one line: the key, what is wrong with it, and for an unknown key the valid keys."""
    message = " ".join(str(getattr(error, "msg", None) or error).splitlines()[0].split())
    key = getattr(error, "full_key", None) or getattr(error, "key", None)
    parent = getattr(error, "parent_node", None)
    if " not in " in message and isinstance(parent, DictConfig):
        names = [str(name) for name in parent if name != "hydra"]
        return f"unknown key {str(key)!r}; valid are {', '.join(names)}{_suggested_key(str(key), parent)}"
    of_key = f"{key}: " if key else ""
    if null := re.fullmatch(r"field '(.*)' is not Optional|Incompatible value 'None' for field of type '\w+'", message):
        return f"{null[1] or key}: expected a value, got null"
    if wrong := _WRONG_SCALAR.fullmatch(message):
        value = repr(wrong[1]) if wrong[3] else _as_written(wrong[1])
        return f"{of_key}expected {_SCALARS[wrong[2] or wrong[3]]}, got {value}"
    if re.fullmatch(r"Cannot assign \w+ to Dict\[.*\]", message):
        return f"{of_key}expected names and values, as in {key}={{NAME:VALUE}}"
    if "is not a ListConfig" in message:
        return f"{of_key}expected a list, as in {key}=[VALUE]"
    if "DictConfig with ListConfig" in message:
        return f"{of_key}expected a list where it is one, as in [VALUE], and else keys of its own"
    if wrong_type := re.fullmatch(r"(?:Invalid type|Merge).* is not a subclass of (\w+)\. value: (.*)", message):
        fields = f"keys of its own, as in {key}.KEY=VALUE" if key else f"the fields of {wrong_type[1]}"
        expected = _SCALARS.get(wrong_type[1], fields)
        return f"{of_key}expected {expected}, got {'null' if wrong_type[2] == 'None' else repr(wrong_type[2])[:80]}"
    return message if str(key) in message else of_key + message


def suggestion(name: Any, valid: Iterable[str]) -> str:
    """The end of an error message about an unknown name: the valid name that is closest, if one is close."""
    close = {choice.lower(): choice for choice in valid}
    matches = get_close_matches(str(name).lower(), close, n=1)
    return f"; did you mean {close[matches[0]]}?" if matches and name else ""


def _suggested_key(key: str, parent: DictConfig) -> str:
    """The suggestion for an unknown key: one of its name anywhere in the config, else a close one beside it."""
    head, _, last = key.rpartition(".")
    siblings = [f"{head}.{name}" if head else str(name) for name in parent if name != "hydra"]
    elsewhere = dict(_keys(parent._get_root()))
    same_name = next((full for full, name in elsewhere.items() if name == last), "")
    return f"; did you mean {same_name}?" if same_name else suggestion(key, siblings)


def with_full_keys(line: str, config: DictConfig, given: Collection[str]) -> str:
    """The line of an error with the keys in front in full, as env.control: for control:, unless they are given as such.

    Args:
      line: of the error, which knows the keys of one dataclass in the config.
      config: config of a command.
      given: keys that the user wrote.
    """
    front, colon, rest = line.partition(":")
    keys, names = front.split(", "), {key for key, _ in _keys(config)}
    if not any(f"{other}.".startswith(f"{key}.") for key in keys for other in given):
        for group in config if names.isdisjoint(keys) else ():
            full = [f"{group}.{key}" for key in keys]
            if names.issuperset(full):
                return ", ".join(full) + colon + rest
    return line


def _keys(node: Any, prefix: str = "") -> Iterator[tuple[str, str]]:
    """Dotted keys of a config with the last name of each, without Hydra's own."""
    for name in node if isinstance(node, DictConfig) and not node._is_none() and not node._is_missing() else ():
        if prefix or name != "hydra":
            yield f"{prefix}{name}", str(name)
            yield from _keys(node._get_node(name), f"{prefix}{name}.")


def check_choice(name: str, value: str, choices: Sequence[str]) -> None:
    """Raises a ValueError that lists the choices if the value is none of them."""
    if value not in choices:
        raise ValueError(f"{name}: expected one of {', '.join(choices)}, got {value!r:.80}{suggestion(value, choices)}")


def check_unused(config: Any, keys: Collection[str], reason: str, prefix: str = "") -> None:
    """Raises a ValueError for the first key of a config that has another value than its default, and no effect.

    Args:
      config: a dataclass.
      keys: names of fields that have no effect.
      reason: what follows "expected none", such as "with run=DIR".
      prefix: of the keys in the message.
    """
    assert set(keys) <= {field.name for field in dataclasses.fields(config)}, keys
    for field in dataclasses.fields(config):
        factory, value = field.default_factory, getattr(config, field.name)
        default = field.default if factory is dataclasses.MISSING else factory()
        if field.name in keys and value != default:
            raise ValueError(f"{prefix}{field.name}: expected none {reason}, got {value!r:.80}")


def new_path(name: str, path: str, kind: str = "folder") -> Path:
    """Returns the path of a file that a command will write, or of a folder that it will create.

    Args:
      name: the config key, for error messages.
      path: the key's value.
      kind: "file" or "folder".

    Raises:
      ValueError: the path is empty, exists, or its folder does not exist.
    """
    if not path:
        raise ValueError(f"{name}: expected a {kind}, as in {name}={kind.upper()}")
    new = Path(path).expanduser()
    check_new(name, new, f"name a new {kind}")
    if not new.parent.is_dir():
        raise ValueError(f"{name}: {str(new)!r}: there is no folder {str(new.parent)!r}")
    check_writable(name, new)
    return new


def check_new(name: str, path: Path, advice: str) -> None:
    """Raises a ValueError with some advice if a path exists: no output is ever overwritten."""
    if os.path.lexists(path):
        raise ValueError(f"{name}: {str(path)!r} exists; {advice}")


def check_writable(name: str, path: Path) -> None:
    """Raises a ValueError if a file or folder cannot be written: a new one, or what is in an existing folder.

    Tried with a temporary folder in the nearest folder that exists: permissions alone do not tell.
    """
    folder = path.absolute()
    while not os.path.lexists(folder):
        folder = folder.parent
    try:
        longest = os.pathconf(folder, "PC_PATH_MAX") - _LONGEST_IN_RUN
        if len(os.fsencode(path.absolute())) > longest or any(
            len(os.fsencode(part)) > os.pathconf(folder, "PC_NAME_MAX") for part in path.parts
        ):
            raise ValueError(f"{name}: {str(path)[:80]!r}...: expected a shorter path")
        tempfile.TemporaryDirectory(prefix=".mimic-", dir=folder).cleanup()
    except OSError as error:
        raise ValueError(f"{name}: {str(path)!r}: cannot write in {str(folder)!r}: {error.strerror}") from error


def merged(*configs: Any) -> DictConfig:
    """Configs merged into one node; later ones replace values of earlier ones."""
    return cast(DictConfig, OmegaConf.merge(*configs))


def to_dict(config: Any) -> dict[str, Any]:
    """Returns a config as dicts and lists, for files."""
    return cast(dict[str, Any], OmegaConf.to_container(OmegaConf.structured(config)))


def flatten(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested mappings as one level with dotted keys, such as optimality_gap.train. Empty mappings stay values."""
    flat: dict[str, Any] = {}
    for key, value in values.items():
        is_nested = isinstance(value, Mapping) and value
        flat |= flatten(value, f"{prefix}{key}.") if is_nested else {f"{prefix}{key}": value}
    return flat
