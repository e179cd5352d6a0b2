"""Registration of our sweeper and launchers with Hydra, in this process only.

Every Hydra application of an environment imports the modules of the package `hydra_plugins`. Ours are not in it, so
that other applications do not import mimic and JAX.
"""

from hydra.core.config_store import ConfigStore
from hydra.core.plugins import Plugins
from hydra.plugins.plugin import Plugin


def target(name: str) -> str:
    """The `_target_` of one of our plugins in Hydra's configs, which accept classes of one package alone."""
    return f"hydra_plugins.mimic.{name}"


def register(plugin: type[Plugin], config: type, group: str, choice: str) -> None:
    """Registers a plugin with Hydra, and its config as a choice of a config group."""
    Plugins.instance().class_name_to_class[target(plugin.__name__)] = plugin  # Hydra looks it up here; no import
    ConfigStore.instance().store(group=group, name=choice, node=config, provider="mimic")
