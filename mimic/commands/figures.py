"""`python -m mimic.figures`: trains the pose mappers that the figures need, then draws the figures."""

import time
from collections.abc import Callable
from pathlib import Path

from rich.console import Console

from benchmarks.figures.poses import FIGURES, MAPPERS, save_figure
from mimic.base.config import check_new
from mimic.commands.config import FiguresConfig
from mimic.envs import env_config
from mimic.trainers import run_training as train
from mimic.trainers.config import PoseMapperConfig, TrainConfig
from mimic.trainers.pose_mapper.model import PoseMapper


def prepare_figures(config: FiguresConfig) -> Callable[[], int]:
    """Checks the config of the figures and loads the pose mappers that exist.

    Raises:
      ValueError: a figure is unknown, `out` is missing or contains one of the figures, or a run directory has no usable
        pose mapper.
    """
    if not config.out:
        raise ValueError("out: expected a folder, as in out=figures")
    unknown = [name for name in config.only if name not in FIGURES]
    if unknown:
        raise ValueError(f"only: expected some of {', '.join(FIGURES)}, got {unknown[0]!r}")
    names = config.only or list(FIGURES)
    out = Path(config.out).expanduser()
    for name in names:
        check_new("out", out / f"{name}.png", "name another folder")
    if out.exists() and not out.is_dir():
        raise ValueError(f"out: {str(out)!r} is a file; expected a folder")
    runs = Path(config.runs).expanduser() if config.runs else out / "runs"

    mappers = {env: _load_mapper(runs / env) for name in names for env in MAPPERS.get(name, ())}

    def run() -> int:
        console = Console()
        out.mkdir(parents=True, exist_ok=True)
        for name in names:
            paths = save_figure(name, out, lambda env: mappers[env] or _train_mapper(env, runs / env, config))
            console.print(f"{name}: {', '.join(map(str, paths))}", soft_wrap=True, highlight=False)
        console.print(f"results: {out}", soft_wrap=True, highlight=False)
        return 0

    return run


def _load_mapper(run_dir: Path) -> PoseMapper | None:
    """The pose mapper of a run; None where there is no run yet."""
    return PoseMapper.load(run_dir) if run_dir.exists() else None


def _train_mapper(env: str, run_dir: Path, config: FiguresConfig) -> PoseMapper:
    """Trains a pose mapper for an environment."""
    training = TrainConfig(
        env=env_config(env),
        trainer=PoseMapperConfig(),
        seed=config.seed,
        run_dir=str(run_dir),
        compilation_cache=config.compilation_cache,
    )
    exit_code = train.prepare_training(training, time.perf_counter())()
    if exit_code:
        raise SystemExit(exit_code)
    return PoseMapper.load(run_dir)
