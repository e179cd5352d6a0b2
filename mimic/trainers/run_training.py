"""`python -m mimic.train`: one training run, from its config to its report."""

import contextlib
import dataclasses
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, cast

import jax
from omegaconf import DictConfig, OmegaConf
from rich.console import Console

from mimic.base.compilation import use_compilation_cache
from mimic.base.config import check_writable, flatten, to_dict, typed
from mimic.runs.checkpoints import (
    Checkpoint,
    checkpoint_steps,
    delete_checkpoint,
    delete_partial_checkpoints,
    load_checkpoint,
    load_training,
    mark_damaged_after,
)
from mimic.runs.distributed.process_group import ProcessGroup
from mimic.runs.divergence import EXIT_CODE as DIVERGED
from mimic.runs.divergence import Diverged
from mimic.runs.files import CONFIG, reported_steps, write_report
from mimic.runs.lock import RunLock
from mimic.runs.loggers import WandbLogger, wandb_package
from mimic.runs.metrics_log import MetricsLog
from mimic.runs.parameters import has_network
from mimic.runs.provenance import hardware
from mimic.runs.signals import Interrupted, Signals, noted_signals
from mimic.runs.stopwatch import Stopwatch
from mimic.trainers.config import TrainConfig
from mimic.trainers.make import make_trainer
from mimic.trainers.progress import TrainingProgress
from mimic.trainers.report import make_report, show_report
from mimic.trainers.run_config import (
    check_new_run,
    errors_of_networks,
    how_to_continue,
    is_brax,
    load_config,
    new_run_dir,
    run_schema,
    save_config,
)
from mimic.trainers.run_models import own_arms, save_models
from mimic.trainers.trainer import Params, Trainer

FAILED, BAD_INPUT = 1, 2  # exit codes


class RunExists(Exception):
    """The run directory of a new run has been created by another process."""


# Above 40 lines because of its docstring.
def prepare_training(
    config: TrainConfig,
    started: float,
    overrides: Sequence[str] = (),
    group: ProcessGroup | None = None,
    signals: Signals | None = None,
) -> Callable[[], int]:
    """Checks the config of a new or resumed run and prepares its trainer; writes nothing.

    Args:
      config: config of the run. With `resume`, the config in the run directory replaces it, except for `overrides`.
      started: `time.perf_counter()` at the start of the process.
      overrides: command-line overrides, applied to the config of a resumed run.
      group: processes that train together. The first one also evaluates, logs and reports.
      signals: records the signals received; replaced by the group's signals where there is a group.

    Returns:
      A function that trains, evaluates and reports. It returns 0, or 128 plus the number of the signal that stopped it.

    Raises:
      ValueError: the config, the arms, the demonstrations or the checkpoint are invalid.
    """
    stopwatch = Stopwatch(started)
    use_compilation_cache(config.compilation_cache)
    resumed_dir = Path(config.resume).expanduser() if config.resume else None
    if resumed_dir:
        config = _resumed_config(resumed_dir, config, overrides)
        check_writable("resume", resumed_dir)
    if resumed_dir and is_brax(config):
        raise ValueError(
            "resume: expected a run of trainer.loop=mimic, got one of brax's loop, which saves no training state; "
            "init=RUN starts from its policy"
        )
    if group and (is_brax(config) or config.trainer.name != "ppo"):
        name = "brax" if is_brax(config) else config.trainer.name
        raise ValueError(f"distributed: expected trainer=ppo, got {name}, which trains in one process")
    is_first = group is None or group.first
    if not resumed_dir:
        config.check_used()
        if config.init and has_network(Path(config.init).expanduser()):
            raise ValueError(f"init: expected a run directory with checkpoints, got {config.init!r}, a network alone")
    if config.logger == "wandb":
        wandb_package()
    run_dir = resumed_dir or (new_run_dir(config) if is_first else Path())
    lock = RunLock(run_dir) if resumed_dir and is_first else None  # before its checkpoints are read
    own_arms(config.env)  # rejects names that the run directory could not keep
    with stopwatch.stage("build"):
        trainer = make_trainer(config, resumed_dir)
        restored = _start(config, resumed_dir, trainer, any(key.startswith("trainer.") for key in overrides))
    config = dataclasses.replace(config, env=trainer.env_config, trainer=trainer.settings)
    if group and not is_first:
        return lambda: _follow(trainer, restored, group)
    signals = group.signals if group else signals or Signals()
    return lambda: _train(config, trainer, run_dir, lock, restored, stopwatch, group, signals)


def _resumed_config(run_dir: Path, requested: TrainConfig, overrides: Sequence[str]) -> TrainConfig:
    """The config of a run directory, with the overrides of the command line that a resumed run accepts."""
    config = load_config(run_dir, "resume")
    process_keys = ("resume=", "compilation_cache=", "distributed.", "logger=")  # taken from `requested`
    own = f"trainer={config.trainer.name}"  # chooses the keys that the command line accepts
    changes = [override for override in overrides if override != own and not override.startswith(process_keys)]
    logger = {"logger": requested.logger} if any(override.startswith("logger=") for override in overrides) else {}
    fixed = ("trainer.preset=", "trainer.name=")
    rejected = [change for change in changes if not change.startswith("trainer.") or change.startswith(fixed)]
    if rejected:
        raise ValueError(
            f"resume: expected overrides of the trainer only, as in trainer.{config.trainer.length_key}=N, "
            f"got {rejected[0]!r}"
        )
    merged = OmegaConf.merge(run_schema(config.trainer.name), to_dict(config), OmegaConf.from_dotlist(changes))
    config: TrainConfig = typed(cast(DictConfig, merged))
    return dataclasses.replace(
        config, compilation_cache=requested.compilation_cache, distributed=requested.distributed, **logger
    )


def _start(config: TrainConfig, resumed_dir: Path | None, trainer: Trainer, is_changed: bool) -> Checkpoint | None:
    """The checkpoint that a resumed run continues from, or the parameters that a new run starts from, if any.

    Args:
      config: config of the run.
      resumed_dir: directory of a resumed run.
      trainer: trainer of the run.
      is_changed: whether settings of the resumed run are changed.
    """
    resolved = dataclasses.replace(config, env=trainer.env_config, trainer=trainer.settings)
    if not resumed_dir or not checkpoint_steps(resumed_dir):  # new, or ended before its first checkpoint
        if not config.init:
            return None
        init = Path(config.init).expanduser()
        with errors_of_networks(resolved, init, "init"):
            return Checkpoint(0, load_checkpoint(init, trainer.params_template())[1], None, {})
    with errors_of_networks(resolved, resumed_dir, "resume"):
        restored = load_training(resumed_dir, trainer.params_template())
    if jax.default_backend() == "gpu" and not config.compilation_cache:
        print(
            "warning: without a compilation cache, XLA may choose other matrix products than before: the numbers may "
            "differ in the last bits",
            file=sys.stderr,
        )
    is_complete = restored.step >= trainer.total_steps or not is_changed
    if is_complete and reported_steps(resumed_dir, trainer.unit) == restored.step:
        raise ValueError(
            f"resume: {str(resumed_dir)!r} has been trained for {restored.step} of {trainer.total_steps} steps; "
            f"increase trainer.{config.trainer.length_key}"
        )
    return restored


def _follow(trainer: Trainer, restored: Checkpoint | None, group: ProcessGroup) -> int:
    """Trains in lockstep with the first process, which ends this one. For the other processes of a group."""
    with noted_signals(group.signals):
        with contextlib.suppress(Diverged):  # in the first process too, which reports it
            trainer.follow(restored)
        group.wait()
    return 0


def _train(
    config: TrainConfig,
    trainer: Trainer,
    run_dir: Path,
    lock: RunLock | None,
    restored: Checkpoint | None,
    stopwatch: Stopwatch,
    group: ProcessGroup | None,
    signals: Signals,
) -> int:
    """Trains, evaluates and reports; returns the exit code."""
    console = Console()
    with noted_signals(signals):  # also during the report, where they have no effect
        try:
            inputs = config, trainer, run_dir, console, stopwatch, signals
            end = (lambda: group.end(0)) if group else None
            with _memory_errors():
                report = run_training(*inputs, lock=lock, restored=restored, on_trained=end)
        except (Interrupted, Diverged, OSError, RunExists) as error:
            exit_code = _stopped(console, run_dir, config, error)
            if group:
                group.end(exit_code)
            return exit_code
    show_report(console, report, trainer)
    console.print(f"results: {run_dir}", soft_wrap=True, highlight=False)
    return 0


@contextlib.contextmanager
def _memory_errors() -> Iterator[None]:
    """Raises an OSError of one line where XLA finds too little memory; other errors of XLA stay as they are."""
    try:
        yield
    except jax.errors.JaxRuntimeError as error:
        message = str(error).partition("\n")[0]
        if not message.startswith("RESOURCE_EXHAUSTED"):
            raise
        raise OSError(f"too little memory for this training, which smaller batches need less of: {message}") from error


# Above 40 lines because of its docstring.
def run_training(
    config: TrainConfig,
    trainer: Trainer,
    run_dir: Path,
    console: Console,
    stopwatch: Stopwatch,
    signals: Signals,
    *,
    lock: RunLock | None = None,
    restored: Checkpoint | None = None,
    on_trained: Callable[[], Any] | None = None,
) -> dict[str, Any]:
    """Trains and evaluates, and writes everything to the run directory. Returns the report.

    Args:
      config: config of the run, with the trainer's resolved settings.
      trainer: trainer of the run.
      run_dir: the run directory; created, unless there is a lock.
      console: where the progress is printed.
      stopwatch: wall time of the process, by stage.
      signals: signals of the process; after one, training ends at the next checkpoint.
      lock: the lock of a resumed run.
      restored: the checkpoint to continue from.
      on_trained: called between training and final evaluation.

    Raises:
      Interrupted: a signal was received; a checkpoint has been written.
      Diverged: a number is not finite; the checkpoints before it are kept.
      OSError: a file cannot be written.
      RunExists: another process has created the run directory.
    """
    with contextlib.closing(lock or _new_run(run_dir, trainer)):
        save_models(run_dir, config.env)
        save_config(run_dir, config)  # after the inputs: a folder without it is no run yet
        headline = f"{trainer.headline} on {hardware()['device']} (preset {trainer.settings.preset})"
        lines = filter(None, (headline, trainer.simulation, f"run directory: {run_dir}"))
        console.print("\n".join(lines), highlight=False, soft_wrap=True)
        steps, params = _train_and_log(config, trainer, run_dir, signals, restored, stopwatch, console)
        if on_trained:
            on_trained()
        last = max([steps, *checkpoint_steps(run_dir)])
        if steps < last:
            unit = trainer.unit.replace("_", " ")
            console.print(f"result: the parameters after {steps:,} {unit}; later ones were no better", highlight=False)
        trained = last - (restored.step if restored else 0)
        return _evaluate(config, trainer, run_dir, steps, params, trained, stopwatch)


def _evaluate(
    config: TrainConfig,
    trainer: Trainer,
    run_dir: Path,
    steps: int,
    params: Params,
    trained: int,
    stopwatch: Stopwatch,
) -> dict[str, Any]:
    """Evaluates the result of a training; writes plots and tables, and last the report, which completes the run."""
    with stopwatch.stage("evaluate"):
        outcome = trainer.evaluate(params)
        metrics = {**trainer.metrics(outcome), **trainer.details(outcome), **trainer.cross_check(params)}
    trainer.save_outcome(run_dir, outcome)
    report = make_report(config, trainer, metrics, stopwatch, steps, trained)
    for step in checkpoint_steps(run_dir):  # the last checkpoint is the result
        if step > steps:
            delete_checkpoint(run_dir, step)
    write_report(run_dir, report)
    return report


def _new_run(run_dir: Path, trainer: Trainer) -> RunLock:
    """Creates and locks a run directory, and writes the inputs of the run.

    Raises:
      RunExists: another process has created it since the start of this one.
    """
    run_dir.mkdir(parents=True, exist_ok=True)
    try:
        lock = RunLock(run_dir)
        check_new_run(run_dir)
    except ValueError as error:
        raise RunExists(str(error)) from error
    trainer.save_inputs(run_dir)
    return lock


def _stopped(
    console: Console, run_dir: Path, config: TrainConfig, error: Interrupted | Diverged | OSError | RunExists
) -> int:
    """Prints why a training stopped and how to continue; returns the exit code."""
    if isinstance(error, Interrupted):
        console.print(f"stopped by {error}; {how_to_continue(run_dir, config)}", soft_wrap=True)
        return error.exit_code
    if isinstance(error, Diverged):
        print(f"error: {error}; the checkpoints before it are kept in {run_dir}", file=sys.stderr)
        return DIVERGED
    if isinstance(error, RunExists):
        print(f"error: {error}", file=sys.stderr)
        return BAD_INPUT
    again = how_to_continue(run_dir, config) if (run_dir / CONFIG).is_file() else "start the run again"
    print(f"error: {error}; once this is solved, {again}", file=sys.stderr)
    return FAILED


def _train_and_log(
    config: TrainConfig,
    trainer: Trainer,
    run_dir: Path,
    signals: Signals,
    restored: Checkpoint | None,
    stopwatch: Stopwatch,
    console: Console,
) -> tuple[int, Params]:
    """Trains; evaluates and logs after each training epoch. Returns the steps and the parameters of the result."""
    resumed_step = restored.step if restored else 0
    # The restored step is evaluated again, unless its training metrics are unknown.
    first_step = resumed_step if not restored or restored.metrics else resumed_step + 1
    delete_partial_checkpoints(run_dir)
    mark_damaged_after(run_dir, resumed_step)
    with contextlib.ExitStack() as stack:
        loggers: list[MetricsLog | WandbLogger] = [MetricsLog(run_dir, first_step)]
        if config.logger == "wandb":
            loggers.append(WandbLogger(run_dir, to_dict(config)))
        for logger in loggers:
            stack.callback(logger.close)  # also where training is interrupted
        progress = stack.enter_context(TrainingProgress(console, trainer.total_steps, resumed_step))
        stack.enter_context(stopwatch.stage("train"))

        def on_evaluation(step: int, params: Params, training_metrics: Mapping[str, float]) -> None:
            with stopwatch.stage("evaluate"):
                metrics = trainer.metrics(trainer.evaluate(params))
                if training_metrics:
                    row = {f"quality/{key}": value for key, value in flatten(metrics).items()}
                    row |= {f"training/{key}": value for key, value in training_metrics.items()}
                    row["wall_time_s"] = time.perf_counter() - stopwatch.started
                    for logger in loggers:
                        logger.write(step, row)
                progress.update(step, trainer.status(metrics), training_metrics.get("sps"))

        return trainer.train(run_dir, on_evaluation, signals, restored)
