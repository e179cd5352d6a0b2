"""One run from config to report: what `python -m mimic.train` and `python -m mimic.evaluate` do."""

import contextlib
import dataclasses
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, cast

from omegaconf import OmegaConf
from rich.console import Console

from mimic.commands.progress import TrainingProgress
from mimic.commands.report import make_report, show_report
from mimic.compilation import use_compilation_cache
from mimic.config import to_dict
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
    """A new run, or one to go on with, ready to start; nothing is written yet.

    Args:
      config: of the run; with `resume`, what the run directory says counts, but for the overrides.
      started: `time.perf_counter()` at the start of the process.
      overrides: of the command line, applied to the config of a resumed run.
      group: of processes that train together; the first of them does all but the training by itself.
      signals: where those that come are noted; the group's, where there is one.

    Returns:
      What trains, evaluates and reports; it returns the exit code: 0, or 128 plus the number of the signal that
      stopped it.

    Raises:
      ValueError: input that cannot be trained.
    """
    stopwatch = Stopwatch(started)
    use_compilation_cache(config.compilation_cache)
    resumed = Path(config.resume).expanduser() if config.resume else None
    if resumed:
        config = _resumed_config(resumed, config, overrides)
    if group and config.trainer.name != "ppo":
        raise ValueError(f"distributed: expected trainer=ppo, got {config.trainer.name}, which trains in one process")
    leads = group is None or group.first
    check_loggers(config.loggers)
    run_dir = resumed or (new_run_dir(config) if leads else Path())
    with stopwatch.stage("build"):
        trainer = make_trainer(config, resumed)
        restore = load_checkpoint(resumed, trainer.params_template()) if resumed else None
    config = dataclasses.replace(config, trainer=trainer.settings)
    if group and not group.first:
        return lambda: _follow(trainer, restore, group)
    noted = group.signals if group else signals or Signals()
    return lambda: _train(config, trainer, run_dir, restore, stopwatch, group, noted)


def _resumed_config(run_dir: Path, given: TrainConfig, overrides: Sequence[str]) -> TrainConfig:
    config = load_config(run_dir)
    steps = check_checkpoint(run_dir)
    of_the_process = ("resume=", "compilation_cache=", "distributed.", "logger=")
    changes = [override for override in overrides if not override.startswith(of_the_process)]
    logger = {"logger": given.logger} if any(override.startswith("logger=") for override in overrides) else {}
    refused = [c for c in changes if not c.startswith("trainer.") or c.startswith(("trainer.preset=", "trainer.name="))]
    if refused:
        raise ValueError(
            f"resume: only settings of the trainer can change, as in trainer.{config.trainer.length_key}=N; "
            f"got {refused[0]!r}"
        )
    merged = OmegaConf.merge(run_schema(config.trainer.name), to_dict(config), OmegaConf.from_dotlist(changes))
    config = cast(TrainConfig, OmegaConf.to_object(merged))
    total = config.trainer.total_steps
    if steps >= total:
        raise ValueError(
            f"resume: {str(run_dir)!r} is trained for {steps} of {total} steps; "
            f"give a larger trainer.{config.trainer.length_key}"
        )
    return dataclasses.replace(
        config, compilation_cache=given.compilation_cache, distributed=given.distributed, **logger
    )


def _follow(trainer: Trainer, restore: tuple[int, Params] | None, group: ProcessGroup) -> int:
    """What a process does that is not the first: it trains in step, until that one ends it."""
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
    console = Console()
    device = hardware()["device"]
    with noted_signals(signals):  # also while the report is made: all is done then, and a signal changes nothing
        run_dir.mkdir(parents=True, exist_ok=restore is not None)
        save_config(run_dir, config)
        trainer.save_inputs(run_dir)
        console.print(
            f"{trainer.headline} on {device} (preset {trainer.settings.preset})\nrun directory: {run_dir}",
            highlight=False,
            soft_wrap=True,
        )
        try:
            steps, params = _train_and_log(config, trainer, run_dir, signals, restore, stopwatch, console)
        except Interrupted as stop:
            if group:
                group.end(stop.exit_code)
            console.print(f"stopped by {stop}; go on with: python -m mimic.train resume={run_dir}", soft_wrap=True)
            return stop.exit_code
        if group:
            group.end(0)
        with stopwatch.stage("evaluate"):
            outcome = trainer.evaluate(params)
            figures = {**trainer.figures(outcome), **trainer.details(outcome)}
        done_before = restore[0] if restore else 0
        report = make_report(config, trainer, figures, stopwatch, steps, steps - done_before)
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
    """Trains; evaluates, logs and shows the result after each stretch. Steps and parameters of the result."""
    done_before = restore[0] if restore else 0
    with contextlib.ExitStack() as stack:
        loggers = [MetricsLog(run_dir), *make_loggers(config.loggers, run_dir, to_dict(config))]
        for logger in loggers:
            stack.callback(logger.close)  # also where training is interrupted
        progress = stack.enter_context(TrainingProgress(console, trainer.total_steps, done_before))
        stack.enter_context(stopwatch.stage("train"))

        def on_evaluation(step: int, params: Params, metrics: Mapping[str, float]) -> bool:
            with stopwatch.stage("evaluate"):
                figures = trainer.figures(trainer.evaluate(params))
                if metrics:
                    row = {f"quality/{key}": value for key, value in _flat(figures).items()}
                    row |= {f"training/{key}": value for key, value in metrics.items()}
                    row["wall_time_s"] = time.perf_counter() - stopwatch.started
                    for logger in loggers:
                        logger.write(step, row)
                progress.update(step, trainer.status(figures), metrics.get("sps"))
            return trainer.good_enough(figures)

        return trainer.train(run_dir, on_evaluation, signals, restore)


def _flat(figures: Mapping[str, Any]) -> dict[str, float]:
    """Nested figures as one level, split names behind a dot."""
    flat: dict[str, float] = {}
    for key, value in figures.items():
        if isinstance(value, Mapping):
            flat |= {f"{key}.{name}": number for name, number in value.items()}
        else:
            flat[key] = value
    return flat
