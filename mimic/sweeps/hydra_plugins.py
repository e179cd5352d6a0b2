"""How our sweeper and launchers become Hydra's plugins, in this process alone.

Hydra takes these from the package `hydra_plugins` alone, whose modules every Hydra program in an environment imports.
So ours is none of them on disk: other programs need not import mimic, and with it JAX.
"""

import importlib
import sys
import types

from hydra.core.config_store import ConfigStore
from hydra.core.plugins import Plugins
from hydra.plugins.plugin import Plugin

_PACKAGE, _MODULE = "hydra_plugins", "mimic"


def target(name: str) -> str:
    """What Hydra's configs call a plugin of ours."""
    return f"{_PACKAGE}.{_MODULE}.{name}"


def register(plugin: type[Plugin], config: type, group: str, choice: str) -> None:
    """Makes a plugin known to Hydra, and its config a choice of a group."""
    package = _plugins()
    module = getattr(package, _MODULE, types.ModuleType(f"{_PACKAGE}.{_MODULE}"))
    setattr(package, _MODULE, module)
    setattr(module, plugin.__name__, plugin)
    plugin.__module__ = sys.modules.setdefault(module.__name__, module).__name__
    Plugins.instance().register(plugin)
    ConfigStore.instance().store(group=group, name=choice, node=config, provider="mimic")


def _plugins() -> types.ModuleType:
    """Hydra's package of plugins, which is there only where some are installed."""
    try:
        return importlib.import_module(_PACKAGE)
    except ImportError:
        package = types.ModuleType(_PACKAGE)
        package.__path__ = []
        return sys.modules.setdefault(_PACKAGE, package)
