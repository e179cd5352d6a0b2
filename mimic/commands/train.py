"""One run from config to report: what `python -m mimic.train` and `python -m mimic.evaluate` do."""

import contextlib
import dataclasses
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
from omegaconf import OmegaConf
from rich.console import Console

from mimic import compat
from mimic.commands.progress import TrainingProgress, report_table, similarity_table
from mimic.config import to_dict
from mimic.envs.demonstrations import load_demonstrations
from mimic.runs.checkpoints import check_checkpoint, load_checkpoint
from mimic.runs.files import write_report
from mimic.runs.loggers import check_loggers, make_loggers
from mimic.runs.metrics_log import MetricsLog
from mimic.runs.provenance import hardware, versions
from mimic.runs.signals import Interrupted, Signals, noted_signals
from mimic.runs.stopwatch import Stopwatch
from mimic.trainers.config import EvaluateConfig, PoseMapperConfig, TrainConfig
from mimic.trainers.distributed.process_group import Group
from mimic.trainers.run_config import load_config, new_run_dir, run_schema, save_config
from mimic.trainers.trainer import Job, Params


def prepare_training(
    config: TrainConfig,
    started: float,
    overrides: Sequence[str] = (),
    group: Group | None = None,
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
        job = make_job(config, resumed)
        restore = load_checkpoint(resumed, job.params_template()) if resumed else None
    config = dataclasses.replace(config, trainer=job.settings)
    if group and not group.first:
        return lambda: _follow(job, restore, group)
    noted = group.signals if group else signals or Signals()
    return lambda: _train(config, job, run_dir, restore, stopwatch, group, noted)


def prepare_evaluation(config: EvaluateConfig, started: float) -> Callable[[], None]:
    """An evaluation of a run from a checkpoint alone, ready to start.

    Raises:
      ValueError: no run directory, no such checkpoint, an `out` that exists, or what only a policy can be asked for.
    """
    stopwatch = Stopwatch(started)
    use_compilation_cache(config.compilation_cache)
    if not config.run:
        raise ValueError("run: expected the run directory to evaluate, as in run=runs/NAME")
    run_dir = Path(config.run).expanduser()
    trained = load_config(run_dir)  # saved resolved: the machine does not matter
    check_checkpoint(run_dir, config.checkpoint)
    out = Path(config.out).expanduser() if config.out else None
    if out and (out.exists() or not out.parent.is_dir()):
        reason = "exists; name a new folder" if out.exists() else f"there is no folder {str(out.parent)!r}"
        raise ValueError(f"out: {str(out)!r}: {reason}")
    with stopwatch.stage("build"):
        trained, job = _job_to_evaluate(trained, run_dir, config)
        steps, params = load_checkpoint(run_dir, job.params_template(), config.checkpoint)

    def run() -> None:
        console = Console()
        with stopwatch.stage("evaluate"):
            outcome, controller = _outcome(job, params, config, console)
            figures = {**job.figures(outcome), **job.details(outcome, config.controller)}
        report = _report(trained, job, figures, stopwatch, steps, 0)
        report |= {**controller, "evaluated": _conditions(trained, config)}
        _show(console, report, job)
        if out:
            out.mkdir()
            job.save_outcome(out, outcome, config.controller)
            write_report(out, report)
            console.print(f"results: {config.out}", soft_wrap=True, highlight=False)

    return run


def _job_to_evaluate(trained: TrainConfig, run_dir: Path, config: EvaluateConfig) -> tuple[TrainConfig, Job]:
    """A run as it was, or with other demonstrations, physics or loads."""
    factors = {"mass": config.mass, "damping": config.damping}
    changes: dict[str, Any] = {key: [value, value] for key, value in factors.items() if value is not None}
    if config.torque_noise is not None:
        changes["torque_noise"] = config.torque_noise
    if trained.trainer.name != "ppo":
        if changes or config.physics or config.demonstrations or config.controller != "policy":
            raise ValueError(
                "controller, demonstrations, physics, mass, damping and torque_noise: expected a run of trainer=ppo, "
                f"got one of {trained.trainer.name}"
            )
        return trained, make_job(trained, run_dir)
    env = dataclasses.replace(
        trained.env,
        physics=config.physics or trained.env.physics,
        randomization=dataclasses.replace(trained.env.randomization, **changes),
    )
    trained = dataclasses.replace(trained, env=env)
    compat.import_mjx()
    from mimic.trainers.ppo.trainer import PPOJob

    unseen = load_demonstrations(Path(config.demonstrations).expanduser()) if config.demonstrations else None
    return trained, PPOJob(trained, run_dir, unseen)


def _conditions(trained: TrainConfig, config: EvaluateConfig) -> dict[str, Any]:
    """What an evaluation was made under."""
    env = trained.env
    return {
        "run": config.run,
        "demonstrations": config.demonstrations,
        "physics": env.physics,
        **dataclasses.asdict(env.randomization),
    }


def _outcome(job: Job, params: Params, config: EvaluateConfig, console: Console) -> tuple[Any, dict[str, Any]]:
    """What a controller did, and what the report says of the controller."""
    if config.controller == "policy":
        return job.evaluate(params), {}
    from mimic.trainers.ppo.trainer import PPOJob

    assert isinstance(job, PPOJob)
    if config.controller == "searched":
        from mimic.evaluation.searched_torques import search_torques

        policy = job.controller(params)
        outcome, starts = search_torques(job.evaluator, policy, config.search, console)
        return outcome, {"trainer": "searched", "search": dataclasses.asdict(config.search), "starts": starts}
    from mimic.evaluation.tracking_controllers import run_controller

    outcome, frequency = run_controller(job.evaluator, config.controller)
    return outcome, {"trainer": config.controller, "frequency_rad_s": frequency}


def make_job(config: TrainConfig, run_dir: Path | None) -> Job:
    """What the trainer of a config does; with the inputs of a run directory where there is one.

    Raises:
      ValueError: a config that cannot be trained.
    """
    if isinstance(config.trainer, PoseMapperConfig):
        from mimic.trainers.pose_mapper.trainer import MapperJob

        return MapperJob(config, run_dir)
    compat.import_mjx()
    from mimic.trainers.ppo.trainer import PPOJob  # brax and MJX, which take seconds to import

    return PPOJob(config, run_dir)


def use_compilation_cache(folder: str) -> None:
    """Lets JAX keep compiled programs in a folder, so that the same run starts faster the next time.

    The small ones too: on a GPU each takes a tenth of a second, and there are dozens.
    """
    if folder:
        jax.config.update("jax_compilation_cache_dir", str(Path(folder).expanduser()))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)


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
    config: TrainConfig = OmegaConf.to_object(merged)  # type: ignore[assignment]
    total = config.trainer.total_steps
    if steps >= total:
        raise ValueError(
            f"resume: {str(run_dir)!r} is trained for {steps} of {total} steps; "
            f"give a larger trainer.{config.trainer.length_key}"
        )
    return dataclasses.replace(
        config, compilation_cache=given.compilation_cache, distributed=given.distributed, **logger
    )


def _follow(job: Job, restore: tuple[int, Params] | None, group: Group) -> int:
    """What a process does that is not the first: it trains in step, until that one ends it."""
    with noted_signals(group.signals):
        job.follow(restore)
        group.wait()
    return 0


def _train(
    config: TrainConfig,
    job: Job,
    run_dir: Path,
    restore: tuple[int, Params] | None,
    stopwatch: Stopwatch,
    group: Group | None,
    signals: Signals,
) -> int:
    console = Console()
    device = hardware()["device"]
    with noted_signals(signals):  # also while the report is made: all is done then, and a signal changes nothing
        run_dir.mkdir(parents=True, exist_ok=restore is not None)
        save_config(run_dir, config)
        job.save_inputs(run_dir)
        console.print(
            f"{job.headline} on {device} (preset {job.settings.preset})\nrun directory: {run_dir}",
            highlight=False,
            soft_wrap=True,
        )
        try:
            steps, params = _train_and_log(config, job, run_dir, signals, restore, stopwatch, console)
        except Interrupted as stop:
            if group:
                group.end(stop.exit_code)
            console.print(f"stopped by {stop}; go on with: python -m mimic.train resume={run_dir}", soft_wrap=True)
            return stop.exit_code
        if group:
            group.end(0)
        with stopwatch.stage("evaluate"):
            outcome = job.evaluate(params)
            figures = {**job.figures(outcome), **job.details(outcome)}
        done_before = restore[0] if restore else 0
        report = _report(config, job, figures, stopwatch, steps, steps - done_before)
        write_report(run_dir, report)
        job.save_outcome(run_dir, outcome)
    _show(console, report, job)
    console.print(f"results: {run_dir}", soft_wrap=True, highlight=False)
    return 0


def _train_and_log(
    config: TrainConfig,
    job: Job,
    run_dir: Path,
    signals: Signals,
    restore: tuple[int, Params] | None,
    stopwatch: Stopwatch,
    console: Console,
) -> tuple[int, Params]:
    """Trains; evaluates, logs and shows the result after each stretch. Steps and parameters of the result."""
    done_before = restore[0] if restore else 0
    with contextlib.ExitStack() as stack:
        loggers = [MetricsLog(run_dir), *make_loggers(config.loggers, run_dir, config)]
        for logger in loggers:
            stack.callback(logger.close)  # also where training is interrupted
        progress = stack.enter_context(TrainingProgress(console, job.total_steps, done_before))
        stack.enter_context(stopwatch.stage("train"))

        def on_evaluation(step: int, params: Params, metrics: Mapping[str, float]) -> bool:
            with stopwatch.stage("evaluate"):
                figures = job.figures(job.evaluate(params))
                if metrics:
                    row = {f"quality/{key}": value for key, value in _flat(figures).items()}
                    row |= {f"training/{key}": value for key, value in metrics.items()}
                    row["wall_time_s"] = time.perf_counter() - stopwatch.started
                    for logger in loggers:
                        logger.write(step, row)
                progress.update(step, job.status(figures), metrics.get("sps"))
            return job.good_enough(figures)

        return job.train(run_dir, on_evaluation, signals, restore)


def _flat(figures: Mapping[str, Any]) -> dict[str, float]:
    """Nested figures as one level, split names behind a dot."""
    flat: dict[str, float] = {}
    for key, value in figures.items():
        if isinstance(value, Mapping):
            flat |= {f"{key}.{name}": number for name, number in value.items()}
        else:
            flat[key] = value
    return flat


def _show(console: Console, report: Mapping[str, Any], job: Job) -> None:
    console.print(report_table(report, job))
    if "similarity" in report:
        console.print(similarity_table(report["similarity"]))


def _report(
    config: TrainConfig, job: Job, figures: Mapping[str, Any], stopwatch: Stopwatch, steps: int, trained: int
) -> dict[str, Any]:
    wall_time = stopwatch.report()
    return {
        "env": config.env.name,
        "trainer": config.trainer.name,
        "seed": config.seed,
        **figures,
        "wall_time_s": wall_time,
        job.unit: steps,
        "steps_per_second": trained / wall_time["train"] if wall_time["train"] else 0.0,
        "hardware": hardware(),
        "versions": versions(),
    }
