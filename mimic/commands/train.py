"""`python -m mimic.train`: one training run, from its config to its report."""

import contextlib
import dataclasses
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import cast

from omegaconf import DictConfig, OmegaConf
from rich.console import Console

from mimic.commands.progress import TrainingProgress
from mimic.commands.report import make_report, show_report
from mimic.compilation import use_compilation_cache
from mimic.config import check_writable, flatten, to_dict, typed
from mimic.runs.checkpoints import check_checkpoint, load_checkpoint
from mimic.runs.files import write_report
from mimic.runs.loggers import check_loggers, make_loggers
from mimic.runs.metrics_log import MetricsLog
from mimic.runs.provenance import hardware
from mimic.runs.signals import Interrupted, Signals, noted_signals
from mimic.runs.stopwatch import Stopwatch
from mimic.trainers.config import TrainConfig
from mimic.trainers.distributed.process_group import ProcessGroup
from mimic.trainers.make import make_trainer
from mimic.trainers.run_config import load_config, new_run_dir, run_schema, save_config
from mimic.trainers.trainer import Params, Trainer


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
    if group and config.trainer.name != "ppo":
        raise ValueError(f"distributed: expected trainer=ppo, got {config.trainer.name}, which trains in one process")
    is_first = group is None or group.first
    check_loggers(config.loggers)
    run_dir = resumed_dir or (new_run_dir(config) if is_first else Path())
    with stopwatch.stage("build"):
        trainer = make_trainer(config, resumed_dir)
        restore = load_checkpoint(resumed_dir, trainer.params_template()) if resumed_dir else None
    config = dataclasses.replace(config, trainer=trainer.settings)
    if group and not is_first:
        return lambda: _follow(trainer, restore, group)
    signals = group.signals if group else signals or Signals()
    return lambda: _train(config, trainer, run_dir, restore, stopwatch, group, signals)


def _resumed_config(run_dir: Path, requested: TrainConfig, overrides: Sequence[str]) -> TrainConfig:
    """The config of a run directory, with the overrides of the command line that a resumed run accepts."""
    config = load_config(run_dir)
    steps = check_checkpoint(run_dir)
    process_keys = ("resume=", "compilation_cache=", "distributed.", "logger=")  # taken from `requested`
    changes = [override for override in overrides if not override.startswith(process_keys)]
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
    total = config.trainer.resolve().total_steps
    if steps >= total:
        raise ValueError(
            f"resume: {str(run_dir)!r} has been trained for {steps} of {total} steps; "
            f"increase trainer.{config.trainer.length_key}"
        )
    return dataclasses.replace(
        config, compilation_cache=requested.compilation_cache, distributed=requested.distributed, **logger
    )


def _follow(trainer: Trainer, restore: tuple[int, Params] | None, group: ProcessGroup) -> int:
    """Trains in lockstep with the first process, which ends this one. For the other processes of a group."""
    with noted_signals(group.signals):
        trainer.follow(restore)
        group.wait()
    return 0


def _train(
    config: TrainConfig,
    trainer: Trainer,
    run_dir: Path,
    restore: tuple[int, Params] | None,
    stopwatch: Stopwatch,
    group: ProcessGroup | None,
    signals: Signals,
) -> int:
    """Trains, evaluates and reports; returns the exit code."""
    console = Console()
    with noted_signals(signals):  # also during the report: training is done, so a signal has no effect
        run_dir.mkdir(parents=True, exist_ok=restore is not None)
        save_config(run_dir, config)
        trainer.save_inputs(run_dir)
        headline = f"{trainer.headline} on {hardware()['device']} (preset {trainer.settings.preset})"
        console.print(f"{headline}\nrun directory: {run_dir}", highlight=False, soft_wrap=True)
        try:
            steps, params = _train_and_log(config, trainer, run_dir, signals, restore, stopwatch, console)
        except Interrupted as interruption:
            if group:
                group.end(interruption.exit_code)
            command = f"python -m mimic.train resume={run_dir}"
            console.print(f"stopped by {interruption}; continue with: {command}", soft_wrap=True)
            return interruption.exit_code
        if group:
            group.end(0)
        with stopwatch.stage("evaluate"):
            outcome = trainer.evaluate(params)
            metrics = {**trainer.metrics(outcome), **trainer.details(outcome)}
        resumed_steps = restore[0] if restore else 0
        report = make_report(config, trainer, metrics, stopwatch, steps, steps - resumed_steps)
        write_report(run_dir, report)
        trainer.save_outcome(run_dir, outcome)
    show_report(console, report, trainer)
    console.print(f"results: {run_dir}", soft_wrap=True, highlight=False)
    return 0


def _train_and_log(
    config: TrainConfig,
    trainer: Trainer,
    run_dir: Path,
    signals: Signals,
    restore: tuple[int, Params] | None,
    stopwatch: Stopwatch,
    console: Console,
) -> tuple[int, Params]:
    """Trains; evaluates and logs after each training epoch. Returns the steps and the parameters of the result."""
    resumed_steps = restore[0] if restore else 0
    with contextlib.ExitStack() as stack:
        loggers = [MetricsLog(run_dir), *make_loggers(config.loggers, run_dir, to_dict(config))]
        for logger in loggers:
            stack.callback(logger.close)  # also where training is interrupted
        progress = stack.enter_context(TrainingProgress(console, trainer.total_steps, resumed_steps))
        stack.enter_context(stopwatch.stage("train"))

        def on_evaluation(step: int, params: Params, training_metrics: Mapping[str, float]) -> bool:
            with stopwatch.stage("evaluate"):
                metrics = trainer.metrics(trainer.evaluate(params))
                if training_metrics:
                    row = {f"quality/{key}": value for key, value in flatten(metrics).items()}
                    row |= {f"training/{key}": value for key, value in training_metrics.items()}
                    row["wall_time_s"] = time.perf_counter() - stopwatch.started
                    for logger in loggers:
                        logger.write(step, row)
                progress.update(step, trainer.status(metrics), training_metrics.get("sps"))
            return trainer.good_enough(metrics)

        return trainer.train(run_dir, on_evaluation, signals, restore)
