"""What packages and notebooks add to mimic: things by kind and name, which configs then refer to.

A package declares a function in the entry-point group `mimic.plugins`; the function calls `register`. Entry points are
loaded when a name is looked up that mimic itself does not have. A config never imports code.
"""

import importlib
import importlib.metadata
import os
import re
import sys
from collections.abc import Callable, Collection, Mapping
from typing import Any, NamedTuple

GROUP = "mimic.plugins"  # of entry points
VARIABLE = "MIMIC_PLUGINS"  # modules to load, separated by commas: for processes that a command starts
KINDS = {
    "correspondence": "a function (expert, learner) -> W, or -> a function of the link distances that returns W",
    "demonstrations": "a function (expert, config) -> Demonstrations",
    "environment": "a mapping with fields of EnvConfig, or a subclass of ImitationEnv",
    "link_distance": "a function (expert link, learner link) -> distance",
    "observation_term": "a function (env, state) -> vector",
    "reward_term": "a function (env, transition) -> number",
    "trainer": "a subclass of Trainer with the attribute config_class",
}
_NAME = re.compile(r"[A-Za-z_][\w-]*")


class _Entry(NamedTuple):
    thing: Any
    origin: str  # the plugin or module that it is from


_registered: dict[str, dict[str, _Entry]] = {kind: {} for kind in KINDS}
_built_in: dict[str, tuple[str, ...]] = dict.fromkeys(KINDS, ())
_loading: list[str] = []  # the plugin that registers at present
_is_loaded = False


def register(kind: str, name: str, thing: Any = None, *, replace: bool = False) -> Any:
    """Adds a thing to mimic, for configs to refer to by its name.

    Without a thing, it returns a decorator: `@mimic.register("reward_term", "lift")`.

    Args:
      kind: "environment", "reward_term", "observation_term", "correspondence", "link_distance", "demonstrations" or
        "trainer".
      name: letters, digits, "_" and "-".
      thing: a function or class, or for an environment a mapping; see `mimic.base.registry.KINDS`.
      replace: whether to replace what is registered under this name, as when a notebook's cell runs again.

    Returns:
      The thing.

    Raises:
      ValueError: an unknown kind, an invalid or existing name, or a thing of another type.
    """
    if thing is None:
        return lambda thing: register(kind, name, thing, replace=replace)
    _check_kind(kind)
    if not _NAME.fullmatch(name):
        raise ValueError(f"{kind}: expected a name of letters, digits, '_' and '-', got {name!r:.80}")
    if name in _built_in[kind]:
        raise ValueError(f"{kind} {name!r} is built in; choose another name")
    if name in _registered[kind] and not replace:
        origin = _registered[kind][name].origin
        raise ValueError(f"{kind} {name!r} is registered already, by {origin}; replace=True replaces it")
    if not (callable(thing) or (kind == "environment" and isinstance(thing, Mapping))):
        raise ValueError(f"{kind} {name!r}: expected {KINDS[kind]}, got {thing!r:.80}")
    origin = _loading[-1] if _loading else getattr(thing, "__module__", None) or "this process"
    _registered[kind][name] = _Entry(thing, origin)
    return thing


def reserve(kind: str, names: Collection[str]) -> None:
    """Declares the names that mimic itself has for a kind."""
    clash = sorted(_registered[kind].keys() & set(names))
    if clash:
        raise ValueError(f"{kind} {clash[0]!r} is built in, but {_registered[kind][clash[0]].origin} registers it")
    _built_in[kind] = tuple(names)


def names(kind: str) -> tuple[str, ...]:
    """The registered names of a kind, sorted, without those of mimic itself."""
    _check_kind(kind)
    load_plugins()
    return tuple(sorted(_registered[kind]))


def find(kind: str, name: str, key: str) -> Any:
    """The thing with a registered name.

    Args:
      kind: see `register`.
      name: the name.
      key: the config key that has the name, for messages.

    Raises:
      ValueError: an unknown name.
    """
    check(kind, name, key)
    return _registered[kind][name].thing


def check(kind: str, name: str, key: str) -> None:
    """Raises a ValueError that lists the valid names unless a name is built in or registered."""
    if name in _built_in[kind] or name in names(kind):
        return
    known = ", ".join((*_built_in[kind], *names(kind))) or "none"
    raise ValueError(
        f"{key}: expected one of {known}, got {name!r:.80}; others are registered by a package with the entry point "
        f"{GROUP}, by --plugin MODULE, or by mimic.register"
    )


def load_plugin(plugin: str) -> None:
    """Imports a module, which registers things. Processes started later do the same.

    Raises:
      ValueError: the module cannot be imported.
    """
    if os.getcwd() not in sys.path and "" not in sys.path:
        sys.path.append(os.getcwd())
    _run(plugin, lambda: importlib.import_module(plugin), f"--plugin {plugin}")
    known = [name for name in os.environ.get(VARIABLE, "").split(",") if name]
    os.environ[VARIABLE] = ",".join(dict.fromkeys([*known, plugin]))


def load_plugins() -> None:
    """Loads the plugins of installed packages and those of the environment variable, at the first call."""
    global _is_loaded
    if _is_loaded:
        return
    _is_loaded = True  # first: a plugin that looks a name up does not start again
    for plugin in filter(None, os.environ.get(VARIABLE, "").split(",")):
        load_plugin(plugin)
    for entry in importlib.metadata.entry_points(group=GROUP):
        package = entry.dist.name if entry.dist else entry.module
        try:
            _run(package, lambda entry=entry: entry.load()(), f"plugin {entry.name!r} of {package}")
        except ValueError as error:  # the commands still work without what it registers
            print(f"warning: {error}", file=sys.stderr)


def _run(name: str, load: Callable[[], Any], label: str) -> None:
    _loading.append(name)
    try:
        load()
    except Exception as error:  # code of others
        raise ValueError(f"{label} failed: {' '.join(f'{type(error).__name__}: {error}'.split())}") from error
    finally:
        _loading.pop()


def _check_kind(kind: str) -> None:
    if kind not in KINDS:
        raise ValueError(f"kind: expected one of {', '.join(KINDS)}, got {kind!r:.80}")
