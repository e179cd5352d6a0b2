"""The config of a run: where a new run goes, and reading what a run directory was trained with."""

import time
from pathlib import Path

from omegaconf import DictConfig, OmegaConf

from mimic.config import explain, schema, to_dict
from mimic.runs.checkpoints import check_checkpoint
from mimic.runs.files import CONFIG, write_atomically
from mimic.trainers.config import TRAINERS, TrainConfig


def new_run_dir(config: TrainConfig) -> Path:
    """The path of a new run; nothing is made yet.

    Raises:
      ValueError: it exists.
    """
    if config.run_dir:
        path = Path(config.run_dir).expanduser()
        if path.exists():
            raise ValueError(f"run_dir: {str(path)!r} exists; name a new one, or go on with resume={path}")
        return path
    stem = f"{config.env.name}-{config.trainer.name}-seed{config.seed}-{time.strftime('%Y%m%d-%H%M%S')}"
    path, again = Path("runs") / stem, 1
    while path.exists():
        path, again = Path("runs") / f"{stem}-{again}", again + 1
    return path


def save_config(run_dir: Path, config: TrainConfig) -> None:
    """Writes the resolved config."""
    write_atomically(run_dir / CONFIG, OmegaConf.to_yaml(OmegaConf.create(to_dict(config))))


def run_schema(trainer: str) -> DictConfig:
    """The typed node of a run with a trainer."""
    return OmegaConf.merge(schema(TrainConfig), {"trainer": schema(TRAINERS[trainer])})  # type: ignore[return-value]


def load_config(run_dir: Path) -> TrainConfig:
    """The config of a run.

    Raises:
      ValueError: no run directory, or a config that cannot be read.
    """
    if not (run_dir / CONFIG).is_file():
        raise ValueError(f"{str(run_dir)!r} is not a run directory: it has no {CONFIG}")
    try:
        content = OmegaConf.load(run_dir / CONFIG)
        name = OmegaConf.select(content, "trainer.name")
        if name not in TRAINERS:
            raise ValueError(f"trainer.name: expected one of {', '.join(TRAINERS)}, got {name!r}")
        merged = OmegaConf.merge(run_schema(name), _as_it_was(content))  # type: ignore[arg-type]
        return OmegaConf.to_object(merged)  # type: ignore[return-value]
    except Exception as error:  # OmegaConf, YAML and our own checks each have their own kinds
        raise ValueError(f"{str(run_dir / CONFIG)!r} cannot be read: {explain(error)}") from error


def _as_it_was(content: DictConfig) -> DictConfig:
    """The config of a run from before links were kept: with the metric that was the default then."""
    if OmegaConf.select(content, "env.metric.links") is not None:
        return content
    was = {"translation": 0.0, "correspondence": "overlap", **(OmegaConf.select(content, "env.metric") or {})}
    correspondence = "chord_overlap" if was["correspondence"] == "overlap" else was["correspondence"]
    metric = {**was, "correspondence": correspondence, "links": "merged"}
    return OmegaConf.merge(content, {"env": {"metric": metric}})  # type: ignore[return-value]


def policy_run(run: str, checkpoint: int | None) -> tuple[Path, TrainConfig]:
    """The directory and the config of a run whose policy shall be shown.

    Raises:
      ValueError: no run directory of PPO, or no such checkpoint.
    """
    if not run:
        raise ValueError("run: expected the run directory to show, as in run=runs/NAME")
    run_dir = Path(run).expanduser()
    trained = load_config(run_dir)
    check_checkpoint(run_dir, checkpoint)
    if trained.trainer.name != "ppo":
        raise ValueError(f"run: expected a run of trainer=ppo, got one of {trained.trainer.name}")
    return run_dir, trained
