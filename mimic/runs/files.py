"""Run directories: all that is needed to understand and repeat a run, and nothing outside them."""

import contextlib
import csv
import importlib.metadata
import json
import math
import os
import platform
import threading
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import jax
from omegaconf import DictConfig, OmegaConf

from mimic import compat
from mimic.compilation import WAITED
from mimic.config import explain, schema, to_dict
from mimic.trainers.config import TRAINERS, TrainConfig

CONFIG, REPORT, METRICS, DEMONSTRATIONS = "config.yaml", "report.json", "metrics.csv", "demonstrations.npz"
_PACKAGES = ("mimic-mjx", "jax", "jaxlib", "mujoco", "mujoco-mjx", "brax", "flax", "optax", "orbax-checkpoint", "numpy")


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


def write_atomically(path: Path, text: str) -> None:
    """Replaces a file only when the new one is whole."""
    partial = path.with_name(path.name + ".partial")
    partial.write_text(text)
    os.replace(partial, path)


def write_report(run_dir: Path, report: Mapping[str, Any]) -> None:
    """Writes report.json; what is not a number, as after a divergence, is null there."""
    write_atomically(run_dir / REPORT, json.dumps(_finite(report), indent=2, allow_nan=False) + "\n")


def _finite(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _finite(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def versions() -> dict[str, str]:
    """Versions of Python and of the packages that results depend on."""
    found = {"python": platform.python_version()}
    for package in _PACKAGES:
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            found[package] = importlib.metadata.version(package)
    return found


def hardware() -> dict[str, Any]:
    """What the run computed on."""
    devices = jax.devices()
    return {
        "backend": jax.default_backend(),
        "device": devices[0].device_kind,
        "devices": len(devices),
        "processes": jax.process_count(),
        "cpu": _cpu_name(),
        "cpu_cores": os.cpu_count(),
    }


def _cpu_name() -> str:
    with contextlib.suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()


class MetricsLog:
    """Metrics over training, as one CSV file and as TensorBoard events; goes on where a run is resumed."""

    def __init__(self, run_dir: Path):
        self._path = run_dir / METRICS
        self._writer = compat.import_tensorboard().SummaryWriter(str(run_dir / "tensorboard"))
        self._columns: list[str] = []  # of the file, once it is known

    def write(self, step: int, metrics: Mapping[str, float]) -> None:
        """Appends one row; what it does not have of the columns is empty."""
        row = {"step": step, **metrics}
        if not set(row) <= set(self._columns):
            self._add_columns(row)
        with self._path.open("a", newline="") as file:
            csv.DictWriter(file, self._columns).writerow(row)
        for name, value in metrics.items():
            self._writer.add_scalar(name, value, step)

    def _add_columns(self, row: Mapping[str, float]) -> None:
        """Gives the file those that it lacks: all in a new run, some where another version began it, else none."""
        rows: list[dict[str, str]] = []
        if self._path.exists():
            with self._path.open(newline="") as file:
                reader = csv.DictReader(file)
                self._columns, rows = list(reader.fieldnames or ()), list(reader)
        missing = [name for name in row if name not in self._columns]
        if missing:
            self._columns += missing
            new = self._path.with_suffix(".new")
            with new.open("w", newline="") as file:
                writer = csv.DictWriter(file, self._columns)
                writer.writeheader()
                writer.writerows(rows)
            new.replace(self._path)

    def close(self) -> None:
        """Writes what is buffered."""
        self._writer.close()


class Stopwatch:
    """Wall time by stage, with the time that JAX traces and compiles kept apart. Stages may lie within stages.

    What compiles in other threads counts as far as this one waits for it.
    """

    _COMPILE_EVENTS = ("/jax/core/compile/", WAITED)

    def __init__(self, started: float):
        """`started`: `time.perf_counter()` at the start of the process."""
        self.started = started
        self._compiling = 0.0
        self._thread = threading.get_ident()
        self.seconds: dict[str, float] = {"import": time.perf_counter() - started, "compile": 0.0}
        jax.monitoring.register_event_duration_secs_listener(self._count)

    def _count(self, event: str, duration_secs: float, **_: Any) -> None:
        if event.startswith(self._COMPILE_EVENTS) and threading.get_ident() == self._thread:
            self._compiling += duration_secs

    @contextlib.contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Times a stage, less what it compiles and less the stages within it."""
        began, counted = time.perf_counter(), sum(self.seconds.values())
        compiling = self._compiling
        try:
            yield
        finally:
            within = sum(self.seconds.values()) - counted  # stages inside this one, with what they compiled
            elapsed = time.perf_counter() - began - within
            compiled = min(self._compiling - compiling, elapsed)
            self._compiling = compiling
            self.seconds["compile"] += compiled
            self.seconds[name] = self.seconds.get(name, 0.0) + elapsed - compiled

    def report(self) -> dict[str, float]:
        """Seconds by stage, and the total since the start of the process."""
        order = ("import", "build", "compile", "train", "evaluate")
        seconds = {name: round(self.seconds.get(name, 0.0), 3) for name in order}
        return {**seconds, "total": round(time.perf_counter() - self.started, 3)}
