"""The config of a run: its directory, and saving and loading the config there."""

import dataclasses
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from mimic.base import registry
from mimic.base.config import check_new, check_writable, explain, flatten, merged, schema, to_dict, typed
from mimic.base.config_files import check_references, read_config
from mimic.base.files import write_atomically
from mimic.base.overrides import setting, shell_words
from mimic.runs.checkpoints import check_checkpoint
from mimic.runs.files import CONFIG, DEMONSTRATIONS
from mimic.runs.lock import LOCK
from mimic.runs.parameters import OtherParameters
from mimic.trainers.config import PPOConfig, TrainConfig, trainer_config
from mimic.trainers.pretrained import NETWORKS, pretrained_names
from mimic.trainers.run_models import MODELS, with_original_models, with_saved_models

_OF_NETWORKS = (  # keys on which the sizes of a run's networks depend
    *("env.expert.", "env.learner.", "env.arms", "env.world", "env.control", "env.preview"),
    *("env.observation.", "env.environment", "env.metric.links", "env.metric.hand_"),
    *("trainer.name", "trainer.network", "trainer.hidden_layers", "trainer.privileged_critic"),
)


def new_run_dir(config: TrainConfig) -> Path:
    """The directory of a new run, which is not created yet.

    Raises:
      ValueError: it exists and is more than a run that ended while it was created, or cannot be written.
    """
    if config.run_dir:
        path = Path(config.run_dir).expanduser()
        check_new_run(path)
        check_writable("run_dir", path)
        return path
    stem = f"{config.env.name}-{config.trainer.name}-seed{config.seed}-{time.strftime('%Y%m%d-%H%M%S')}"
    path, number = Path("runs") / stem, 1
    while path.exists():
        path, number = Path("runs") / f"{stem}-{number}", number + 1
    check_writable("run_dir", path)
    return path


def check_new_run(path: Path) -> None:
    """Raises a `ValueError` if a path exists, unless it is a folder of a run that ended before it wrote its config."""
    inputs = DEMONSTRATIONS, MODELS
    before_config = {LOCK, *inputs, *(f"{name}.partial" for name in (*inputs, CONFIG))}
    if not (os.path.isdir(path) and {file.name for file in path.iterdir()} <= before_config):
        check_new("run_dir", path, f"name a new folder, or continue the run with resume={path}")


def save_config(run_dir: Path, config: TrainConfig) -> None:
    """Writes the resolved config, with the paths of the arms that the run started from."""
    config = dataclasses.replace(config, env=with_original_models(config.env))
    write_atomically(run_dir / CONFIG, OmegaConf.to_yaml(OmegaConf.create(to_dict(config))))


def is_brax(config: TrainConfig) -> bool:
    """Whether a run trains by brax's own loop, which cannot resume."""
    return isinstance(config.trainer, PPOConfig) and config.trainer.loop == "brax"


def how_to_continue(run_dir: Path, config: TrainConfig) -> str:
    """How to continue a run, as the end of a message."""
    if is_brax(config):
        return f"brax's loop saves no training state; {setting('init', str(run_dir))} starts a run from its policy"
    return f"continue with: python -m mimic.train {shell_words([setting('resume', str(run_dir))])}"


def run_schema(trainer: str) -> DictConfig:
    """The typed OmegaConf node of a run with this trainer."""
    return merged(schema(TrainConfig), {"trainer": schema(trainer_config(trainer))})


def check_run_dir(run_dir: Path, key: str, choices: str = "") -> None:
    """Raises a ValueError with the key and the other choices unless a path is that of a run directory."""
    if not (run_dir / CONFIG).is_file():
        raise ValueError(f"{key}: expected a run directory, which has a {CONFIG},{choices} got {str(run_dir)!r}")


def load_config(run_dir: Path, key: str = "run_dir", *, saved_models: bool = True) -> TrainConfig:
    """The config of a run.

    Args:
      run_dir: the run directory.
      key: what the user set to it, for the line of an error.
      saved_models: whether its arms are those kept in the run directory, see `save_models`, instead of the files that
        the run started from.

    Raises:
      ValueError: no run directory, a config that cannot be read, a plugin that is not loaded, or model files that were
        changed.
    """
    check_run_dir(run_dir, key)
    config = _read_config(run_dir)
    return dataclasses.replace(config, env=with_saved_models(run_dir, config.env)) if saved_models else config


def _read_config(run_dir: Path) -> TrainConfig:
    try:
        content = read_config(run_dir / CONFIG)
        check_references(content)  # before anything resolves them
        for group in {"env", "trainer"}.intersection(content):
            if not OmegaConf.is_dict(content[group]):
                raise ValueError(f"{group}: expected keys and values, got {content[group]}")
        name = OmegaConf.select(content, "trainer.name")
        registry.check("trainer", str(name), "trainer.name")
        return typed(merged(run_schema(name), content)).resolve()
    except Exception as error:  # OmegaConf, YAML and our own checks each have their own types of error
        raise ValueError(f"{str(run_dir / CONFIG)!r} cannot be read: {explain(error)}") from error


def given_run(run: str, key: str = "run", kind: str = "policy") -> tuple[Path, TrainConfig]:
    """The directory and the config of the run of a command.

    Args:
      run: run directory, or the environment of a trained network of this kind that comes with mimic.
      key: see `load_config`.
      kind: "policy" or "pose_mapper".

    Raises:
      ValueError: it is neither; or see `load_config`.
    """
    run_dir, names = Path(run).expanduser(), pretrained_names(kind)
    if not run:
        raise ValueError(f"{key}: expected a run directory, as in {key}=runs/NAME, or one of {', '.join(names)}")
    if run in names and not run_dir.exists():
        run_dir = NETWORKS / f"{run}-{kind}"
    check_run_dir(run_dir, key, f" or one of {', '.join(names)},")
    return run_dir, load_config(run_dir, key)


def policy_run(run: str, checkpoint: int | None) -> tuple[Path, TrainConfig]:
    """The directory and the config of a run of PPO. Raises a ValueError for any other, or no such checkpoint."""
    run_dir, trained = given_run(run)
    if trained.trainer.name != "ppo":
        raise ValueError(f"run: expected a run of trainer=ppo, got one of {trained.trainer.name}")
    check_checkpoint(run_dir, checkpoint)
    return run_dir, trained


@contextmanager
def errors_of_networks(config: TrainConfig, run_dir: Path, key: str) -> Iterator[None]:
    """Context in which the line of an error says by which settings a checkpoint is that of other networks.

    Args:
      config: resolved config that the checkpoint should fit.
      run_dir: run directory of the checkpoint.
      key: see `load_config`.

    Raises:
      ValueError: see `load_config`; or the checkpoint's networks have other inputs, outputs or layers.
    """
    given = load_config(run_dir, key)
    try:
        yield
    except OtherParameters as error:
        new, old = _of_networks(config), _of_networks(given)
        keys = [name for name in new | old if new.get(name) != old.get(name)]
        if not keys:
            raise
        keys = ["trainer.name"] if "trainer.name" in keys else keys
        expected, got = (", ".join(setting(name, values.get(name)) for name in keys) for values in (new, old))
        raise ValueError(f"{key}: expected a run of {expected}, got one of {got}") from error


def _of_networks(config: TrainConfig) -> dict[str, Any]:
    """The settings on which the sizes of a run's networks depend, by their keys."""
    values = flatten({"env": to_dict(config.env), "trainer": to_dict(config.trainer)})
    return {key: value for key, value in values.items() if key.startswith(_OF_NETWORKS)}
