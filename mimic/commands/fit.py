"""`mimic.fit`: a training from Python, with the run directory of `python -m mimic.train`."""

import dataclasses
import functools
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import numpy as np
from omegaconf.errors import OmegaConfBaseException
from rich.console import Console

from mimic.base.compilation import compilation_cache, use_compilation_cache
from mimic.base.config import explain, merged, schema, typed
from mimic.base.files import open_file
from mimic.commands.config import EvaluateConfig
from mimic.commands.evaluate import prepare_report
from mimic.envs import EnvConfig, env_config
from mimic.envs.imitation import ImitationEnv
from mimic.envs.make import make_env
from mimic.envs.many_arms import AnyArmEnv
from mimic.runs.checkpoints import load_checkpoint
from mimic.runs.files import DEMONSTRATIONS, read_report
from mimic.runs.signals import Signals
from mimic.runs.stopwatch import Stopwatch
from mimic.trainers.config import TrainConfig, TrainerConfig, trainer_config, trainers
from mimic.trainers.make import make_trainer
from mimic.trainers.report import show_report
from mimic.trainers.run_config import load_config, new_run_dir
from mimic.trainers.run_training import run_training

if TYPE_CHECKING:
    from PIL.Image import Image


class Run:
    """A training that has ended, in its run directory.

    Args:
      run_dir: the run directory.

    Attributes:
      run_dir: the run directory.
      config: config of the run.

    Raises:
      ValueError: no run directory, one that cannot be read, or a plugin of the run that is not loaded.
    """

    def __init__(self, run_dir: str | Path):
        self.run_dir = Path(run_dir).expanduser()
        self.config: TrainConfig = load_config(self.run_dir)

    def __repr__(self) -> str:
        return f"Run({str(self.run_dir)!r})"

    @functools.cached_property
    def policy(self) -> Callable[[Any], jax.Array]:
        """The trained function: observation -> action in [-1, 1]; of a pose mapper, expert's pose -> learner's [rad].

        It takes one sample and is compiled; `jax.vmap` batches it.
        """
        trainer = make_trainer(self.config, self.run_dir)
        return trainer.policy(jax.device_get(load_checkpoint(self.run_dir, trainer.params_template())[1]))

    @property
    def report(self) -> dict[str, Any]:
        """The content of `report.json`.

        Raises:
          ValueError: there is none, because the training has not ended, or it cannot be read.
        """
        return read_report(self.run_dir)

    @property
    def plots(self) -> dict[str, "Image"]:
        """The plots of the run by name, such as `quality`; a notebook shows them."""
        from PIL import Image

        return {path.stem: Image.open(open_file(path)) for path in sorted(self.run_dir.glob("*.png"))}

    def make_env(self) -> ImitationEnv:
        """The environment of the run, with its training demonstrations; an `AnyArmEnv` for a run of many arms."""
        from mimic.trainers.ppo.trainer import with_saved_demonstrations  # takes seconds to import

        has_own = (self.run_dir / DEMONSTRATIONS).is_file()
        return make_env(with_saved_demonstrations(self.config.env, self.run_dir if has_own else None))

    def evaluate(self, *, quiet: bool = False, **options: Any) -> dict[str, Any]:
        """Evaluates the run, as `python -m mimic.evaluate` does.

        Args:
          quiet: whether to print nothing.
          options: fields of `EvaluateConfig`, such as `physics="mjx"`, `mass=1.2` or `controller="pd"`.

        Returns:
          The report.

        Raises:
          ValueError: an unknown option, or one that does not fit the run.
        """
        config = _filled(EvaluateConfig, {**options, "run": str(self.run_dir)}, "evaluate")
        if compilation_cache():
            config = dataclasses.replace(config, compilation_cache="")
        return prepare_report(config, time.perf_counter(), Console(quiet=quiet))()


# Above 40 lines because of its docstring.
def fit(
    env: str | EnvConfig | ImitationEnv = "panda4dof",
    *,
    trainer: str | Mapping[str, Any] = "ppo",
    seed: int = 0,
    run_dir: str = "",
    quiet: bool = False,
    **overrides: Any,
) -> Run:
    """Trains, evaluates and writes a run directory, as `python -m mimic.train` does.

    The progress is a bar in a terminal, and one line for each evaluation in a notebook. An interrupt (Ctrl-C) raises
    KeyboardInterrupt; `python -m mimic.train resume=RUN_DIR` continues such a run from its last checkpoint.

    Args:
      env: name of an environment, its config, or an environment from `make`.
      trainer: name of a trainer, or its fields: `{"name": "ppo", "num_timesteps": 1_000_000}`.
      seed: random seed of networks, exploration and resets.
      run_dir: new folder that the run writes to; in `runs/` where empty.
      quiet: whether to print nothing.
      overrides: fields of a named environment's config, see `env_config`.

    Raises:
      ValueError: a config that cannot be trained.
      Diverged: a number is not finite; the checkpoints before it are kept.
      OSError: a file cannot be written.
    """
    stopwatch = Stopwatch(time.perf_counter())
    config = TrainConfig(_env_config(env, overrides), _trainer_config(trainer), seed=seed, run_dir=run_dir)
    if compilation_cache() is None:
        use_compilation_cache(config.compilation_cache)
    path = new_run_dir(config)
    with stopwatch.stage("build"):
        made = make_trainer(config, None)
        if isinstance(env, ImitationEnv):
            _check_demonstrations(env)
    console = Console(quiet=quiet)
    config = dataclasses.replace(config, trainer=made.settings)
    report = run_training(config, made, path, console, stopwatch, Signals())
    show_report(console, report, made)
    return Run(path)


def _env_config(env: str | EnvConfig | ImitationEnv, overrides: Mapping[str, Any]) -> EnvConfig:
    if isinstance(env, str):
        return env_config(env, **overrides)
    if overrides:
        raise ValueError(
            f"{next(iter(overrides))}: expected the name of an environment with it, got {type(env).__name__}"
        )
    if isinstance(env, EnvConfig):
        return env
    if isinstance(env, AnyArmEnv):
        raise ValueError(
            "env: expected the name or the config of an environment of many arms, as in 'panda_family', got an "
            "AnyArmEnv, whose sampler a config need not describe"
        )
    if type(env) is not ImitationEnv and not env.config.environment:
        raise ValueError(
            f"env: expected the name of {type(env).__name__}: a run makes its environment from its config; "
            "register the class with mimic.register('environment', NAME, CLASS), and fit NAME"
        )
    return env.config


def _check_demonstrations(env: ImitationEnv) -> None:
    """Raises a ValueError where an environment has other demonstrations than those of its config."""
    expected = make_env(env.config).demonstrations.qpos
    if not np.array_equal(env.demonstrations.qpos, expected):
        raise ValueError(
            "env: expected the demonstrations of its config, got others: save them, and make the environment with "
            "demonstrations={'path': FILE, 'count': N, 'held_out': M}"
        )


def _trainer_config(trainer: str | Mapping[str, Any]) -> TrainerConfig:
    fields = {"name": trainer} if isinstance(trainer, str) else {"name": "ppo", **trainer}
    if fields["name"] not in trainers():
        raise ValueError(f"trainer: expected one of {', '.join(trainers())}, got {fields['name']!r:.80}")
    return _filled(trainer_config(fields["name"]), fields, "trainer")


def _filled(config_class: type, fields: Mapping[str, Any], label: str) -> Any:
    """A config with some fields. Raises a ValueError for an unknown field or a value of the wrong type."""
    try:
        return typed(merged(schema(config_class), dict(fields)))
    except OmegaConfBaseException as error:
        raise ValueError(f"{label}: {explain(error)}") from error
