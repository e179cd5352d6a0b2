"""Registration of our sweeper, launchers and reader of config files with Hydra, in this process only.

Every Hydra application of an environment imports the modules of the package `hydra_plugins`. Ours are not in it, so
that other applications do not import mimic and JAX.
"""

from pathlib import Path

from hydra._internal.core_plugins.file_config_source import FileConfigSource
from hydra._internal.sources_registry import SourcesRegistry
from hydra.core.config_store import ConfigStore
from hydra.core.plugins import Plugins
from hydra.plugins.config_source import ConfigResult
from hydra.plugins.plugin import Plugin

from mimic.base.config_files import read_config


def target(name: str) -> str:
    """The `_target_` of one of our plugins in Hydra's configs, which accept classes of one package alone."""
    return f"hydra_plugins.mimic.{name}"


def register(plugin: type[Plugin], config: type, group: str, choice: str) -> None:
    """Registers a plugin with Hydra, and its config as a choice of a config group."""
    Plugins.instance().class_name_to_class[target(plugin.__name__)] = plugin  # Hydra looks it up here; no import
    ConfigStore.instance().store(group=group, name=choice, node=config, provider="mimic")


class BoundedFileSource(FileConfigSource):
    """Hydra's reader of the YAML files in a user's `--config-dir`, which are bounded like the config of a run."""

    def load_config(self, config_path: str) -> ConfigResult:
        """See Hydra's ConfigSource.

        Raises:
          ValueError: see `read_config`.
        """
        path = Path(self.path, self._normalize_file_name(config_path))
        if path.exists():  # a missing file is reported by Hydra
            try:
                read_config(path, may_be_empty=True)
            except ValueError as error:
                raise ValueError(f"{str(path)!r} cannot be read: {error}") from error
        return super().load_config(config_path)


def bound_config_files() -> None:
    """Replaces Hydra's reader of config files by ours."""
    Plugins.instance()  # registers Hydra's own, which could not replace ours
    SourcesRegistry.instance().types[BoundedFileSource.scheme()] = BoundedFileSource
