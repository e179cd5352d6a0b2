"""One run from config to report: what `python -m mimic.train` and `python -m mimic.evaluate` do."""

import dataclasses
import json
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
from omegaconf import OmegaConf
from rich.console import Console

from mimic.config import schema, to_dict
from mimic.envs.config import EnvConfig
from mimic.envs.demonstrations import Demonstrations, concatenate
from mimic.envs.imitation import ImitationEnv, training_and_held_out
from mimic.trainers import ppo, runs
from mimic.trainers.checkpoints import check_checkpoint, load_checkpoint
from mimic.trainers.config import EvaluateConfig, PPOConfig, TrainConfig
from mimic.trainers.evaluation import Evaluator, Rollouts
from mimic.trainers.plots import plot_quality, plot_training
from mimic.trainers.progress import TrainingProgress, report_table

_STOPPED_BY_SIGNAL = 128  # plus the signal's number: the exit code by convention


def train(config: TrainConfig, started: float, overrides: Sequence[str] = ()) -> int:
    """Trains a new run, or goes on with one.

    Args:
      config: of the run; with `resume`, what the run directory says counts, but for the overrides.
      started: `time.perf_counter()` at the start of the process.
      overrides: of the command line, applied to the config of a resumed run.

    Returns:
      The exit code: 0, or 128 plus the number of the signal that stopped it.

    Raises:
      ValueError: input that cannot be trained; nothing is trained or written then.
    """
    console, stopwatch = Console(), runs.Stopwatch(started)
    use_compilation_cache(config.compilation_cache)
    resumed = Path(config.resume).expanduser() if config.resume else None
    if resumed:
        config = _resumed_config(resumed, overrides)
    run_dir = resumed or runs.new_run_dir(config)
    with stopwatch.stage("build"):
        settings = config.trainer.resolve(jax.default_backend())
        env, held_out = _environment(config.env, run_dir if resumed else None)
        restore = _restored(run_dir, settings, env) if resumed else None
        run_dir.mkdir(parents=True, exist_ok=bool(resumed))
        runs.save_config(run_dir, dataclasses.replace(config, trainer=settings))
        concatenate(env.demonstrations, held_out).save(run_dir / runs.DEMONSTRATIONS)
        console.print(
            f"{config.env.name}: {env.demonstrations.count} demonstrations, {settings.num_envs} arms at once on "
            f"{runs.hardware()['device']} (preset {settings.preset})\nrun directory: {run_dir}",
            highlight=False,
            soft_wrap=True,
        )
        evaluator = Evaluator(env, held_out)
    evaluate_params = _evaluation_program(evaluator, settings, env)
    try:
        params, steps = _train(config, settings, run_dir, evaluator, evaluate_params, restore, stopwatch, console)
    except ppo.Interrupted as stop:
        console.print(f"stopped by {stop}; go on with: python -m mimic.train resume={run_dir}", soft_wrap=True)
        return _STOPPED_BY_SIGNAL + stop.signal_number
    with stopwatch.stage("evaluate"):
        rollouts = evaluate_params(params)
    report = _report(config, evaluator, rollouts, stopwatch, steps, steps - (restore[0] if restore else 0))
    runs.write_report(run_dir, report)
    plot_training(run_dir / runs.METRICS, run_dir / "training.png", title=config.env.name)
    plot_quality(evaluator, rollouts, run_dir / "quality.png", title=config.env.name)
    console.print(report_table(report))
    console.print(f"results: {run_dir}", soft_wrap=True, highlight=False)
    return 0


def evaluate(config: EvaluateConfig, started: float) -> dict[str, Any]:
    """Repeats the report of a run from a checkpoint alone.

    Raises:
      ValueError: no run directory, or no such checkpoint.
    """
    console, stopwatch = Console(), runs.Stopwatch(started)
    use_compilation_cache(config.compilation_cache)
    if not config.run:
        raise ValueError("run: expected the run directory to evaluate, as in run=runs/NAME")
    run_dir = Path(config.run).expanduser()
    trained = runs.load_config(run_dir)
    check_checkpoint(run_dir, config.checkpoint or None)
    out = Path(config.out).expanduser() if config.out else None
    if out and not out.parent.is_dir():
        raise ValueError(f"out: there is no folder {str(out.parent)!r}")
    with stopwatch.stage("build"):
        settings = trained.trainer.resolve(jax.default_backend())  # saved resolved: the machine does not matter
        env, held_out = _environment(trained.env, run_dir)
        template = ppo.params_template(settings, env.observation_size, env.action_size)
        steps, params = load_checkpoint(run_dir, template, config.checkpoint or None)
        evaluator = Evaluator(env, held_out)
    with stopwatch.stage("evaluate"):
        rollouts = _evaluation_program(evaluator, settings, env)(params)
    report = _report(trained, evaluator, rollouts, stopwatch, steps, 0)
    console.print(report_table(report))
    if out:
        runs.write_atomically(out, json.dumps(report, indent=2) + "\n")
        console.print(f"results: {config.out}", soft_wrap=True, highlight=False)
    return report


def use_compilation_cache(folder: str) -> None:
    """Lets JAX keep compiled programs in a folder, so that the same run starts faster the next time."""
    if folder:
        jax.config.update("jax_compilation_cache_dir", str(Path(folder).expanduser()))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)


def _environment(config: EnvConfig, run_dir: Path | None) -> tuple[ImitationEnv, Demonstrations]:
    """The environment on its training demonstrations, and the held-out ones; those of a run where there is one."""
    if run_dir is not None:
        path = str(run_dir / runs.DEMONSTRATIONS)
        stored = dataclasses.replace(config.demonstrations, path=path)
        config = dataclasses.replace(config, demonstrations=stored)
    training, held_out = training_and_held_out(config)
    return ImitationEnv(config, training), held_out


def _resumed_config(run_dir: Path, overrides: Sequence[str]) -> TrainConfig:
    config = runs.load_config(run_dir)
    check_checkpoint(run_dir)
    changes = [override for override in overrides if not override.startswith("resume=")]
    refused = [change for change in changes if not change.startswith("trainer.")]
    if refused:
        raise ValueError(
            f"resume: only keys of the trainer can change, as in trainer.num_timesteps=N; got {refused[0]!r}"
        )
    merged = OmegaConf.merge(schema(TrainConfig), to_dict(config), OmegaConf.from_dotlist(changes))
    return OmegaConf.to_object(merged)  # type: ignore[return-value]


def _restored(run_dir: Path, settings: PPOConfig, env: ImitationEnv) -> tuple[int, ppo.Params]:
    template = ppo.params_template(settings, env.observation_size, env.action_size)
    steps, params = load_checkpoint(run_dir, template)
    if steps >= settings.num_timesteps:  # type: ignore[operator]
        raise ValueError(
            f"resume: {str(run_dir)!r} is trained for {steps} of {settings.num_timesteps} steps; "
            "give a larger trainer.num_timesteps"
        )
    return steps, params


def _evaluation_program(
    evaluator: Evaluator, settings: PPOConfig, env: ImitationEnv
) -> Callable[[ppo.Params], Rollouts]:
    controller = ppo.make_controller(settings, env.observation_size, env.action_size)

    @jax.jit
    def program(params: ppo.Params) -> Rollouts:
        return evaluator.rollout(controller(params))

    # From the host: how brax or orbax spread the parameters over devices would each ask for a program of its own.
    return lambda params: program(jax.device_get(params))


def _train(
    config: TrainConfig,
    settings: PPOConfig,
    run_dir: Path,
    evaluator: Evaluator,
    evaluate_params: Callable[[ppo.Params], Rollouts],
    restore: tuple[int, ppo.Params] | None,
    stopwatch: runs.Stopwatch,
    console: Console,
) -> tuple[ppo.Params, int]:
    """Trains; evaluates, logs and shows the policy after each stretch. Parameters and steps at the end."""
    log = runs.MetricsLog(run_dir)
    reached = {"step": restore[0] if restore else 0}
    total: int = settings.num_timesteps  # type: ignore[assignment]
    with TrainingProgress(console, total, reached["step"]) as progress, stopwatch.stage("train"):

        def on_evaluation(step: int, params: ppo.Params, metrics: Mapping[str, float]) -> bool:
            with stopwatch.stage("evaluate"):
                quality = evaluator.summary(evaluate_params(params))
                if metrics:
                    row = {f"quality/{key}": value for key, value in _flat(quality).items()}
                    row |= {f"training/{key}": value for key, value in metrics.items()}
                    log.write(step, {**row, "wall_time_s": time.perf_counter() - stopwatch.started})
                progress.update(step, quality, metrics.get("sps"))
                reached["step"] = step
            return quality["optimality_gap"]["train"] <= settings.target_gap

        params = ppo.train(
            evaluator.training_env,
            settings,
            run_dir,
            seed=config.seed,
            on_evaluation=on_evaluation,
            restore=restore,
        )
    log.close()
    return params, reached["step"]


def _flat(quality: Mapping[str, Any]) -> dict[str, float]:
    """Nested figures as one level, split names behind a dot."""
    flat: dict[str, float] = {}
    for key, value in quality.items():
        if isinstance(value, Mapping):
            flat |= {f"{key}.{name}": number for name, number in value.items()}
        else:
            flat[key] = value
    return flat


def _report(
    config: TrainConfig, evaluator: Evaluator, rollouts: Rollouts, stopwatch: runs.Stopwatch, steps: int, trained: int
) -> dict[str, Any]:
    wall_time = stopwatch.report()
    return {
        "env": config.env.name,
        "trainer": config.trainer.name,
        "seed": config.seed,
        **evaluator.summary(rollouts),
        "wall_time_s": wall_time,
        "env_steps": steps,
        "steps_per_second": trained / wall_time["train"] if wall_time["train"] else 0.0,
        "hardware": runs.hardware(),
        "versions": runs.versions(),
    }
