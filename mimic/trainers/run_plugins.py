"""What a run uses that plugins registered: recorded in its directory, and compared with what is registered later."""

import json
from collections.abc import Iterator
from pathlib import Path

from mimic.base import registry
from mimic.base.files import read_json, write_atomically
from mimic.trainers.config import BUILT_IN_TRAINERS, TrainConfig

PLUGINS = "plugins.json"
_ONLY_AT_THE_START = ("demonstrations",)  # kinds that an existing run does not need: it has its demonstrations


def used_plugins(config: TrainConfig) -> dict[str, str]:
    """What a run uses that is not built in: the plugin or module of each, by kind and name as `KIND:NAME`."""
    return {f"{kind}:{name}": registry.origin(kind, name) for kind, name in _used(config)}


def _used(config: TrainConfig) -> Iterator[tuple[str, str]]:
    env = config.env
    terms = [("reward_term", name) for name in env.reward.terms]
    terms += [("observation_term", name) for name in env.observation.terms]
    yield from (term for term in terms if registry.is_registered(*term))
    single = {
        "environment": env.environment,
        "correspondence": env.metric.correspondence,
        "link_distance": env.metric.link_distance,
        "demonstrations": "" if env.demonstrations.path else env.demonstrations.source,
        "trainer": config.trainer.name if config.trainer.name not in BUILT_IN_TRAINERS else "",
    }
    yield from ((kind, name) for kind, name in single.items() if name and registry.is_registered(kind, name))


def save_plugins(run_dir: Path, config: TrainConfig) -> None:
    """Writes the record of a run, if it uses any plugin."""
    used = used_plugins(config)
    if used:
        write_atomically(run_dir / PLUGINS, json.dumps(used, indent=2) + "\n")


def check_plugins(run_dir: Path) -> None:
    """Raises a ValueError that names the first plugin of a run that is not loaded. Imports nothing."""
    path = run_dir / PLUGINS
    if not path.is_file():
        return
    try:
        record = read_json(path)
    except (OSError, ValueError) as error:
        raise ValueError(f"{str(path)!r} cannot be read: {error}") from error
    for key, origin in record.items():
        kind, _, name = key.partition(":")
        if kind not in registry.KINDS or not isinstance(origin, str):
            raise ValueError(f"{str(path)!r} cannot be read: unexpected entry {key!r:.80}")
        if kind not in _ONLY_AT_THE_START and not registry.is_registered(kind, name):
            raise ValueError(
                f"{str(run_dir)!r} uses the {kind} {name!r:.80} of the plugin {origin!r:.80}, which is not loaded: "
                f"install its package, or add --plugin {origin:.80}"
            )
