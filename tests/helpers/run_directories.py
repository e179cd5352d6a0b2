"""Run directories as training leaves them, without training."""

import csv
import functools
import json
import re
import tempfile
from pathlib import Path
from typing import Any

from mimic.base import distribution
from mimic.envs import env_config
from mimic.runs.files import CONFIG, METRICS, REPORT
from mimic.runs.provenance import versions
from mimic.trainers.config import PoseMapperConfig, PPOConfig, TrainConfig
from mimic.trainers.run_config import save_config


def write_run(
    run_dir: Path,
    gaps: list[float | None],
    env: str = "planar4dof",
    seed: int = 0,
    *,
    trainer: str = "ppo",
    version: str | None = None,
    report: bool = True,
    **settings: Any,
) -> Path:
    """A run whose gap on training data was `gaps`, one for each evaluation, and twice that on held-out data."""
    metric, unit = {"ppo": ("optimality_gap", "env_steps"), "pose_mapper": ("quality", "training_poses")}[trainer]
    run_dir.mkdir(parents=True)
    config = _config_text(env, trainer, tuple(settings.items()))
    (run_dir / CONFIG).write_text(re.sub(r"^seed: .*", f"seed: {seed}", config, flags=re.MULTILINE))
    rows = [{"step": 1000 * (i + 1), **_by_split(f"quality/{metric}.", gap)} for i, gap in enumerate(gaps)]
    with (run_dir / METRICS).open("w", newline="") as file:
        writer = csv.DictWriter(file, fieldnames=list(rows[0]))
        writer.writeheader()
        writer.writerows({key: "nan" if x is None else x for key, x in row.items()} for row in rows)
    if report:
        package_versions = {**versions(), **({distribution.NAME: version} if version else {})}
        content = {"seed": seed, metric: _by_split("", gaps[-1]), unit: 1000 * len(gaps), "versions": package_versions}
        (run_dir / REPORT).write_text(json.dumps(content))
    return run_dir


def rows_of(run_dir: Path) -> list[dict[str, str]]:
    """The rows of a run's metrics."""
    with (run_dir / METRICS).open(newline="") as file:
        return list(csv.DictReader(file))


@functools.cache
def _config_text(env: str, trainer: str, settings: tuple[tuple[str, Any], ...]) -> str:
    """The config of a run; the config of an environment takes long to write."""
    resolved = PPOConfig(**dict(settings)).resolve("cpu") if trainer == "ppo" else PoseMapperConfig().resolve()
    with tempfile.TemporaryDirectory() as folder:
        save_config(Path(folder), TrainConfig(env=env_config(env), trainer=resolved))
        return (Path(folder) / CONFIG).read_text()


def _by_split(prefix: str, gap: float | None) -> dict[str, float | None]:
    return {f"{prefix}train": gap, f"{prefix}held_out": None if gap is None else 2 * gap}
