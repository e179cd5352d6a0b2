"""What `python -m mimic.figures` does: trains the mappers that the figures need, then draws."""

import time
from collections.abc import Callable
from pathlib import Path

from rich.console import Console

from mimic.commands import train
from mimic.commands.config import FiguresConfig
from mimic.config import check_new
from mimic.envs import env_config
from mimic.paper_figures.poses import FIGURES, save_figure
from mimic.runs.checkpoints import checkpoint_steps
from mimic.trainers.config import PoseMapperConfig, TrainConfig
from mimic.trainers.pose_mapper.model import PoseMapper


def prepare_figures(config: FiguresConfig) -> Callable[[], int]:
    """What draws the figures.

    Raises:
      ValueError: an unknown figure, no `out`, or one that holds files of theirs already.
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

    def run() -> int:
        console = Console()
        out.mkdir(parents=True, exist_ok=True)
        for name in names:
            paths = save_figure(name, out, lambda env: _mapper(env, runs, config))
            console.print(f"{name}: {', '.join(map(str, paths))}", soft_wrap=True, highlight=False)
        console.print(f"results: {out}", soft_wrap=True, highlight=False)
        return 0

    return run


def _mapper(env: str, runs: Path, config: FiguresConfig) -> PoseMapper:
    """The mapper of an environment: the one in the folder of runs, trained first where there is none."""
    run_dir = runs / env
    if not checkpoint_steps(run_dir):
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
