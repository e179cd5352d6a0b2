"""Where the metrics of a run go beside its own files, which are always written: Weights & Biases, MLflow."""

import importlib
import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol


class Logger(Protocol):
    """A service that metrics are sent to."""

    def write(self, step: int, metrics: Mapping[str, float]) -> None:
        """Sends one row of metrics."""
        ...

    def close(self) -> None:
        """Ends the run there."""
        ...


class _WandbLogger:
    """Weights & Biases; its project, mode and account are what its own environment variables say."""

    def __init__(self, run_dir: Path, config: Mapping[str, Any]):
        self._run = _package("wandb").init(
            name=run_dir.name,
            id=run_dir.name,  # a resumed run goes on there too
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
    """MLflow; where to, is what its own environment variables say."""

    def __init__(self, run_dir: Path, config: Mapping[str, Any]):
        self._mlflow = _package("mlflow")
        if wanted := _unless_set("MLFLOW_EXPERIMENT_NAME", experiment_name="mimic"):
            self._mlflow.set_experiment(**wanted)
        known = run_dir / "mlflow_run_id"
        self._mlflow.start_run(run_id=known.read_text() if known.exists() else None, run_name=run_dir.name)
        if not known.exists():
            known.write_text(self._mlflow.active_run().info.run_id)
            self._mlflow.log_dict(dict(config), "config.json")

    def write(self, step: int, metrics: Mapping[str, float]) -> None:
        finite = {name: float(value) for name, value in metrics.items() if math.isfinite(value)}
        self._mlflow.log_metrics(finite, step=step)

    def close(self) -> None:
        self._mlflow.end_run()


_SERVICES: dict[str, type[_WandbLogger] | type[_MlflowLogger]] = {"wandb": _WandbLogger, "mlflow": _MlflowLogger}


def check_loggers(names: Sequence[str]) -> None:
    """Raises a ValueError where a package is missing, or nobody says where MLflow shall write."""
    for name in names:
        if name in _SERVICES:
            _package(name)
    # MLflow's own default lies beside the run directory, and needs a database that its client does not bring.
    if "mlflow" in names and not os.environ.get("MLFLOW_TRACKING_URI"):
        raise ValueError("logger=mlflow: expected MLFLOW_TRACKING_URI in the environment, as in http://localhost:5000")


def make_loggers(names: Sequence[str], run_dir: Path, config: Mapping[str, Any]) -> list[Logger]:
    """A run at each of the services; "local" is none of them."""
    return [_SERVICES[name](run_dir, config) for name in dict.fromkeys(names) if name in _SERVICES]


def _package(name: str) -> Any:
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise ValueError(
            f"logger={name} needs the package {name}: pip install 'mimic-mjx[{name}]'; logger=local needs none"
        ) from error


def _unless_set(variable: str, **value: str) -> dict[str, str]:
    return {} if os.environ.get(variable) else value
