"""Weights & Biases, which a run's metrics are sent to in addition to its own files."""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mimic.base.distribution import import_extra


class WandbLogger:
    """A run at Weights & Biases, whose own environment variables set project, mode and account.

    Args:
      run_dir: the run directory.
      config: of the run.
    """

    def __init__(self, run_dir: Path, config: Mapping[str, Any]):
        self._run = wandb_package().init(
            name=run_dir.name,
            id=run_dir.name,  # a resumed run continues its run at the service
            resume="allow",
            dir=str(run_dir),
            config=dict(config),
            **({} if os.environ.get("WANDB_PROJECT") else {"project": "mimic"}),
        )

    def write(self, step: int, metrics: Mapping[str, float]) -> None:
        """Sends one row of metrics."""
        self._run.log(dict(metrics), step=step)

    def close(self) -> None:
        """Ends the run at the service."""
        self._run.finish()


def wandb_package() -> Any:
    """The package wandb. Raises a ValueError if it is not installed."""
    return import_extra("wandb", "wandb", "logger=wandb")
