"""Registration of our sweeper and launchers as Hydra plugins, in this process only.

Hydra loads plugins only from the package `hydra_plugins`, whose modules every Hydra application in an environment
imports. Ours is not on disk there, so that other applications do not import mimic and JAX.
"""

import importlib
import sys
import types

from hydra.core.config_store import ConfigStore
from hydra.core.plugins import Plugins
from hydra.plugins.plugin import Plugin

_PACKAGE, _MODULE = "hydra_plugins", "mimic"


def target(name: str) -> str:
    """The `_target_` of one of our plugins in Hydra's configs."""
    return f"{_PACKAGE}.{_MODULE}.{name}"


def register(plugin: type[Plugin], config: type, group: str, choice: str) -> None:
    """Registers a plugin with Hydra, and its config as a choice of a config group."""
    package = _plugins()
    module = getattr(package, _MODULE, types.ModuleType(f"{_PACKAGE}.{_MODULE}"))
    setattr(package, _MODULE, module)
    setattr(module, plugin.__name__, plugin)
    plugin.__module__ = sys.modules.setdefault(module.__name__, module).__name__
    Plugins.instance().register(plugin)
    ConfigStore.instance().store(group=group, name=choice, node=config, provider="mimic")


def _plugins() -> types.ModuleType:
    """Hydra's package of plugins; it is created if none are installed."""
    try:
        return importlib.import_module(_PACKAGE)
    except ImportError:
        package = types.ModuleType(_PACKAGE)
        package.__path__ = []
        return sys.modules.setdefault(_PACKAGE, package)
