"""The figures of the metric and of pose retargeting (the paper's static imitation), as PNG and PDF.

    python -m benchmarks.figures.paper --out DIR [--only NAME ...] [--runs DIR]

"planar" and "panda" show pose mappers. Those without a run directory in --runs (default: the folder runs in --out),
under the name of their environment, are trained first: about a minute each on two cores.
"""

import time
from pathlib import Path

from benchmarks.common.parser import make_parser
from benchmarks.figures.poses import FIGURES, save_figure
from mimic.envs import env_config
from mimic.trainers import run_training
from mimic.trainers.config import PoseMapperConfig, TrainConfig
from mimic.trainers.pose_mapper.mapper import PoseMapper


def load_mapper(env: str, run_dir: Path) -> PoseMapper:
    """The pose mapper of an environment, trained in `run_dir` if that does not exist."""
    if not run_dir.exists():
        config = TrainConfig(env=env_config(env), trainer=PoseMapperConfig(), run_dir=str(run_dir))
        if exit_code := run_training.prepare_training(config, time.perf_counter())():
            raise SystemExit(exit_code)
    return PoseMapper.load(run_dir)


def main() -> None:
    """Runs the command."""
    parser = make_parser("figures.paper", __doc__, out="DIR", only=FIGURES, runs=Path)
    options = parser.parse_args()
    runs = options.runs or options.out / "runs"
    options.out.mkdir(parents=True, exist_ok=True)
    for name in options.only:
        paths = save_figure(name, options.out, lambda env: load_mapper(env, runs / env))
        print(f"{name}: {', '.join(map(str, paths))}", flush=True)


if __name__ == "__main__":
    main()
