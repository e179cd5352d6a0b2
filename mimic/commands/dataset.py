"""`python -m mimic.dataset`: writes rollouts or demonstrations as a LeRobot dataset or as rosbag2."""

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from rich.console import Console

from mimic.base.compilation import use_compilation_cache
from mimic.base.config import check_unused, new_path
from mimic.base.distribution import NAME, VERSION, import_extra
from mimic.commands.config import DatasetConfig
from mimic.commands.dataset_sources import file_episodes, rollout_episodes
from mimic.commands.printed import say
from mimic.evaluation.labels import SPLITS
from mimic.motions.demonstrations import load_demonstrations
from mimic.motions.formats.episodes import EXTRA, Episodes
from mimic.motions.formats.lerobot import action_of, frames_per_second, write_lerobot
from mimic.motions.formats.rosbag2 import write_rosbag2
from mimic.runs.checkpoints import load_checkpoint
from mimic.runs.files import written_atomically
from mimic.trainers.make import make_ppo_trainer
from mimic.trainers.run_config import policy_run

_PACKAGES = {"lerobot": "pyarrow", "rosbag2": "rosbags"}  # the package that writes each format


def prepare_dataset(config: DatasetConfig) -> Callable[[], int]:
    """Checks the config of a dataset, and restores the policy or loads the files.

    Raises:
      ValueError: `out` exists, the package of the format is not installed, the run or the checkpoint does not exist, a
        file cannot be read, or the format does not have the time step.
    """
    use_compilation_cache(config.compilation_cache)
    _check_keys(config)
    out = new_path("out", config.out)
    import_extra(_PACKAGES[config.format], EXTRA, f"format={config.format}")
    compute = _prepare_rollouts(config) if config.run else _prepare_files(config)

    def run() -> int:
        console = Console()
        episodes, notes = compute(console)
        if not episodes.steps:
            print("error: no episode to write: each rollout of this policy is a runaway", file=sys.stderr)
            return 1
        _write(config.format, out, episodes, console)
        say(console, *_lines(config.format, episodes), *notes, f"results: {out}")
        return 0

    return run


def _check_keys(config: DatasetConfig) -> None:
    """Rejects keys that exclude each other."""
    if bool(config.run) == bool(config.demonstrations):
        got = f"run={config.run} and demonstrations={config.demonstrations}" if config.run else "neither"
        raise ValueError(
            f"run, demonstrations: expected one of them, as in run=runs/NAME or demonstrations=FILE.npz, got {got}"
        )
    if not config.run:
        check_unused(config, ("checkpoint", "split"), "without run=DIR")


_Computed = tuple[Episodes, list[str]]  # what to write, and what to tell about it


def _prepare_rollouts(config: DatasetConfig) -> Callable[[Console], _Computed]:
    """Restores the policy of a run; the returned function computes its rollouts."""
    run_dir, trained = policy_run(config.run, config.checkpoint)
    trained.env.check_one_learner()
    _check_time_step(config.format, trained.env.control_dt)
    trainer = make_ppo_trainer(trained, run_dir)
    steps, params = load_checkpoint(run_dir, trainer.params_template(), config.checkpoint)
    splits = [config.split] if config.split else SPLITS
    facts = {
        "env": trained.env.name, "control": trained.env.control, "physics": trainer.env_config.physics,
        "checkpoint": steps, "seed": trained.seed,
    }  # fmt: skip

    def compute(console: Console) -> _Computed:
        with console.status(f"rolling out the policy of {config.run}"):
            rollouts = trainer.evaluate(params)
        provenance = _provenance("rollouts of a policy", facts)
        episodes, cut = rollout_episodes(trainer.evaluator, rollouts, splits, config.task, provenance)
        note = f"{cut} rollouts end before the step in which a joint exceeds {trained.env.speed_bound:g} rad/s"
        return episodes, [note] if cut else []

    return compute


def _prepare_files(config: DatasetConfig) -> Callable[[Console], _Computed]:
    """Loads motions; the returned function returns them."""
    demonstrations = load_demonstrations(Path(config.demonstrations).expanduser())
    _check_time_step(config.format, demonstrations.dt)
    provenance = _provenance("motions of a file", {"seed": demonstrations.seed})
    episodes = file_episodes(demonstrations, config.task, provenance)
    return lambda console: (episodes, [])


def _check_time_step(format: str, dt: float) -> None:
    if format == "lerobot":
        frames_per_second(dt)


def _provenance(kind: str, facts: dict[str, Any]) -> dict[str, Any]:
    return {"written_by": f"{NAME} {VERSION}", "source": kind, **facts}


def _write(format: str, out: Path, episodes: Episodes, console: Console) -> None:
    """Writes the dataset; its folder has its name when it is complete."""
    write = write_lerobot if format == "lerobot" else write_rosbag2
    with written_atomically(out) as folder, console.status(f"writing {len(episodes.steps)} episodes"):
        write(folder, episodes)


def _lines(format: str, episodes: Episodes) -> list[str]:
    """What a dataset has."""
    robot, expert = episodes.robot, episodes.expert
    splits = ", ".join(f"{end - first} {split}" for split, (first, end) in episodes.ranges.items())
    head = f"{len(episodes.steps)} episodes ({splits}), {sum(episodes.steps)} steps of {episodes.dt:g} s"
    arms = f"robot: {robot.arm}, {len(robot.joint_names)} joints"
    arms += f"; expert: {expert.arm}, {len(expert.joint_names)} joints" if expert else ""
    if format == "lerobot":
        _, quantity, meaning = action_of(robot)
        action = f"action: {quantity.name} [{quantity.unit}], {meaning}"
    else:
        known = robot.command is not None
        action = f"commands: {robot.quantity.name} [{robot.quantity.unit}]" if known else "commands: none are known"
    return [head, arms, action]
