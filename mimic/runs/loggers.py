"""Services that a run's metrics are sent to, in addition to its own files: Weights & Biases, MLflow."""

import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

from mimic.base.distribution import import_extra
from mimic.base.files import read_text


class Logger(Protocol):
    """A service that metrics are sent to."""

    def write(self, step: int, metrics: Mapping[str, float]) -> None:
        """Sends one row of metrics."""
        ...

    def close(self) -> None:
        """Ends the run at the service."""
        ...


class _WandbLogger:
    """Weights & Biases; its own environment variables set project, mode and account."""

    def __init__(self, run_dir: Path, config: Mapping[str, Any]):
        self._run = _package("wandb").init(
            name=run_dir.name,
            id=run_dir.name,  # a resumed run continues its run at the service
            resume="allow",
            dir=str(run_dir),
            config=dict(config),
            **_unless_set("WANDB_PROJECT", project="mimic"),
        )

    def write(self, step: int, metrics: Mapping[str, float]) -> None:
        self._run.log(dict(metrics), step=step)

    def close(self) -> None:
        self._run.finish()


class _MlflowLogger:
    """MLflow; its own environment variables set the server."""

    def __init__(self, run_dir: Path, config: Mapping[str, Any]):
        self._mlflow = _package("mlflow")
        if experiment := _unless_set("MLFLOW_EXPERIMENT_NAME", experiment_name="mimic"):
            self._mlflow.set_experiment(**experiment)
        run_id = run_dir / "mlflow_run_id"
        self._mlflow.start_run(run_id=read_text(run_id) if run_id.exists() else None, run_name=run_dir.name)
        if not run_id.exists():
            run_id.write_text(self._mlflow.active_run().info.run_id)
            self._mlflow.log_dict(dict(config), "config.json")

    def write(self, step: int, metrics: Mapping[str, float]) -> None:
        finite = {name: float(value) for name, value in metrics.items() if math.isfinite(value)}
        self._mlflow.log_metrics(finite, step=step)

    def close(self) -> None:
        self._mlflow.end_run()


_SERVICES: dict[str, type[_WandbLogger] | type[_MlflowLogger]] = {"wandb": _WandbLogger, "mlflow": _MlflowLogger}


def check_loggers(names: Sequence[str]) -> None:
    """Raises a ValueError if a service's package is missing, or if MLflow's server is not set."""
    for name in names:
        if name in _SERVICES:
            _package(name)
    # MLflow's default is a folder next to the run directory, which needs a database that its client does not include.
    if "mlflow" in names and not os.environ.get("MLFLOW_TRACKING_URI"):
        raise ValueError("logger=mlflow: expected MLFLOW_TRACKING_URI in the environment, as in http://localhost:5000")


def make_loggers(names: Sequence[str], run_dir: Path, config: Mapping[str, Any]) -> list[Logger]:
    """Starts a run at each of the services; "local" is none."""
    return [_SERVICES[name](run_dir, config) for name in dict.fromkeys(names) if name in _SERVICES]


def _package(name: str) -> Any:
    return import_extra(name, name, f"logger={name}")


def _unless_set(variable: str, **value: str) -> dict[str, str]:
    return {} if os.environ.get(variable) else value
