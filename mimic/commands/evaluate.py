"""`python -m mimic.evaluate`: evaluates a run from a checkpoint, or another controller in place of its policy."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

from rich.console import Console

from mimic.base.compilation import use_compilation_cache
from mimic.base.config import new_path
from mimic.base.distribution import import_extra
from mimic.commands.config import CONTROLLERS, EvaluateConfig
from mimic.commands.printed import say
from mimic.envs.config import EnvConfig
from mimic.envs.family import with_one_learner
from mimic.motions.demonstrations import Demonstrations, load_demonstrations
from mimic.runs.checkpoints import check_checkpoint, load_checkpoint
from mimic.runs.files import write_report
from mimic.runs.stopwatch import Stopwatch
from mimic.trainers.config import TrainConfig
from mimic.trainers.make import make_ppo_trainer, make_trainer
from mimic.trainers.report import make_report, show_report
from mimic.trainers.run_config import given_run, save_config
from mimic.trainers.trainer import Trainer

CONTROLLERS_OF_MANY = ("policy", "nearest_pose")
# For actions that are torques, and for those that are other targets of an inner loop.
TORQUE_CONTROLLERS = ("copy_joints", "pd", "computed_torque", "one_step", "nearest_pose", "mpc")
TARGET_CONTROLLERS = ("tracking",)


def prepare_evaluation(config: EvaluateConfig, started: float) -> Callable[[], None]:
    """Checks the config of an evaluation and restores the run from its checkpoint.

    Raises:
      ValueError: the run directory or the checkpoint is missing, `out` exists, or the options need a policy and the
        run has none.
    """
    if config.robot:
        return _robot_evaluation(config)
    evaluate = prepare_report(config, started, Console())

    def run() -> None:
        evaluate()

    return run


def _robot_evaluation(config: EvaluateConfig) -> Callable[[], None]:
    """An evaluation on virtual robots, see `prepare_robot_evaluation`."""
    for package in ("jax2onnx", "onnxruntime"):
        import_extra(package, "deploy,export", "robot:")
    from mimic.commands.evaluate_robot import prepare_robot_evaluation  # brax and MJX, which take seconds to import

    use_compilation_cache(config.compilation_cache)
    run_dir, trained = given_run(config.run)
    trained, trainer = _trainer_to_evaluate(trained, run_dir, config)
    return prepare_robot_evaluation(config, trained, trainer, run_dir)


def prepare_report(config: EvaluateConfig, started: float, console: Console) -> Callable[[], dict[str, Any]]:
    """The same as `prepare_evaluation`, as a function that returns the report."""
    stopwatch = Stopwatch(started)
    use_compilation_cache(config.compilation_cache)
    run_dir, trained = given_run(config.run)
    out = new_path("out", config.out) if config.out else None
    with stopwatch.stage("build"):
        trained, trainer = _trainer_to_evaluate(trained, run_dir, config)
        steps, params = load_checkpoint(run_dir, trainer.params_template(), config.checkpoint)

    def run() -> dict[str, Any]:
        with stopwatch.stage("evaluate"):
            outcome, controller = trainer.run_controller(config.controller, params)
            metrics = {**trainer.metrics(outcome), **trainer.details(outcome, config.controller)}
            if config.controller == "policy" and not config.physics:
                metrics |= trainer.cross_check(params)
        report = make_report(trained, trainer, metrics, stopwatch, steps, 0)
        report |= {**controller, "evaluated": _conditions(trained, config)}
        show_report(console, report, trainer)
        if out:
            out.mkdir()
            save_config(out, trained)  # what the report is of, for `mimic.collect`
            trainer.save_outcome(out, outcome, config.controller)
            write_report(out, report)
            say(console, f"results: {config.out}")
        return report

    return run


def _trainer_to_evaluate(trained: TrainConfig, run_dir: Path, config: EvaluateConfig) -> tuple[TrainConfig, Trainer]:
    """The trainer of a run, with the demonstrations and the physics of the evaluation."""
    check_checkpoint(run_dir, config.checkpoint)
    if trained.trainer.name != "ppo":
        others = config.physics, config.demonstrations, config.split, config.learner
        if any(others) or config.controller != "policy":
            raise ValueError(
                "controller, learner, demonstrations, split, physics: expected a run of trainer=ppo, got one of "
                f"{trained.trainer.name}"
            )
        return trained, make_trainer(trained, run_dir)
    _check_arms(trained.env, config)
    _check_commands(trained.env, config.controller)
    base = with_one_learner(trained.env, config.learner, config.locked) if config.learner else trained.env
    env = dataclasses.replace(base, physics=config.physics or base.physics)
    evaluated = dataclasses.replace(trained, env=env)
    unseen = _unseen(config, env)
    shared = make_ppo_trainer(trained, run_dir) if config.learner else None
    trainer = make_ppo_trainer(evaluated, run_dir, unseen, shared)
    return dataclasses.replace(evaluated, env=trainer.env_config), trainer


def _unseen(config: EvaluateConfig, env: EnvConfig) -> Demonstrations | None:
    """The demonstrations that replace the held-out ones; None where nothing does."""
    if config.split:
        from mimic.envs.imitation import test_demonstrations  # imports MJX, which takes seconds

        Console().print("recording the test set; its kinematic bound takes minutes on a CPU", highlight=False)
        return test_demonstrations(env)
    return load_demonstrations(Path(config.demonstrations).expanduser()) if config.demonstrations else None


def _check_commands(env: EnvConfig, controller: str) -> None:
    """Rejects controllers whose commands are not those of the run."""
    has_loop, has_targets = env.kind == "inner_loop", env.control != "torque"
    unfit = [*(TORQUE_CONTROLLERS if has_loop else ()), *(() if has_targets else TARGET_CONTROLLERS)]
    if controller in unfit:
        valid = [name for name in CONTROLLERS if name not in unfit]
        loop = f"an inner loop and control={env.control}" if has_loop else "no inner loop"
        raise ValueError(f"controller: expected {', '.join(valid[:-1])} or {valid[-1]} for a run with {loop}, got "
                         f"{controller}")  # fmt: skip


def _check_arms(env: EnvConfig, config: EvaluateConfig) -> None:
    """Rejects what a run of one learner, or the report of many arms, does not have."""
    if config.learner and env.kind != "sampled_arms":
        raise ValueError(f"learner: expected a run of many arms, got one of env={env.name}, whose learner is evaluated")
    if env.kind == "sampled_arms" and not config.learner and config.controller not in CONTROLLERS_OF_MANY:
        raise ValueError(
            f"controller: expected {' or '.join(CONTROLLERS_OF_MANY)} for all arms of a run of many, got "
            f"{config.controller}; choose one arm with learner=NAME"
        )


def _conditions(trained: TrainConfig, config: EvaluateConfig) -> dict[str, Any]:
    """The conditions of an evaluation, for its report."""
    env = trained.env
    return {
        "run": config.run,
        **({"learner": config.learner, "locked": config.locked} if config.learner else {}),
        "demonstrations": config.demonstrations or config.split,
        "physics": env.physics,
    }
