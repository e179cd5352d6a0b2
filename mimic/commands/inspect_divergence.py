"""`python -m mimic.inspect RUN/divergence.npz`: replays the batch at which a training diverged."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
from omegaconf import OmegaConf
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from mimic.base.compilation import use_compilation_cache
from mimic.base.config import to_dict
from mimic.commands.config import InspectConfig
from mimic.runs.checkpoints import run_id
from mimic.runs.files import CONFIG
from mimic.runs.provenance import hardware
from mimic.trainers.config import TrainConfig
from mimic.trainers.make import make_ppo_trainer
from mimic.trainers.ppo.divergence import Divergence, Finding, arm_values, load_divergence, replay_batch
from mimic.trainers.ppo.programs import BatchRecord
from mimic.trainers.ppo.updates import TRACED
from mimic.trainers.run_config import load_config

_UNITS = {"qpos": "[rad]", "qvel": "[rad/s]"}
_SETTINGS = (  # whose values the table shows
    "trainer.learning_rate", "trainer.final_learning_rate", "trainer.max_grad_norm", "trainer.reward_scaling",
    "trainer.entropy_cost", "trainer.clipping_epsilon", "env.action_scale", "env.control_dt", "env.substeps",
)  # fmt: skip


def prepare_replay(config: InspectConfig) -> Callable[[], None]:
    """Reads a divergence file and the run that it belongs to.

    Raises:
      ValueError: other keys of the config, no divergence file, or one without its run or of another run.
    """
    path = Path(config.divergence).expanduser()
    if config != InspectConfig(divergence=config.divergence):
        raise ValueError(f"divergence: expected no other keys, since its run has them; got some with {str(path)!r}")
    divergence = load_divergence(path)
    run_dir = path.absolute().parent
    trained = _config_of_its_run(path, run_dir, divergence)
    use_compilation_cache(trained.compilation_cache)
    trainer = make_ppo_trainer(trained, run_dir)
    replay = trainer.replay()
    state = replay.restore(divergence.state)
    if state is None:
        raise ValueError(f"{str(path)!r} does not fit the config of its run: it has other arms or another network")

    def run() -> None:
        _, record, finding = replay_batch(replay, state)
        record = jax.device_get(record)
        steps = divergence.env_steps + (divergence.batch - 1) * trainer.settings.steps_per_batch
        lines = [
            f"first not finite: {_described(divergence.finding, divergence.num_bad_arms, record)}",
            f"in batch {divergence.batch} of {divergence.batches} of a training epoch, after {steps} steps",
            f"replay on {hardware()['device']}: {_outcome(divergence, record, finding)}",
        ]
        console = Console()
        console.print("\n".join(lines), highlight=False, soft_wrap=True, markup=False)
        for table in (
            _metrics_table(divergence, record.trace.metrics),
            _magnitudes_table(record, finding),
            _settings_table(dataclasses.replace(trained, trainer=trainer.settings)),
        ):
            console.print(table)

    return run


def _config_of_its_run(path: Path, run_dir: Path, divergence: Divergence) -> TrainConfig:
    """The config of the run of a divergence file, which must be in its run directory."""
    if not (run_dir / CONFIG).is_file():
        raise ValueError(f"{str(path)!r}: expected a file in its run directory; {str(run_dir)!r} has no {CONFIG}")
    if run_id(run_dir) != divergence.run:
        raise ValueError(f"{str(path)!r} is of another run than {str(run_dir)!r}, where it is")
    trained = load_config(run_dir)
    if trained.trainer.name != "ppo":
        raise ValueError(f"{str(path)!r}: expected a run of trainer=ppo, got one of {trained.trainer.name}")
    return trained


def _described(finding: Finding, num_bad_arms: int, record: BatchRecord) -> str:
    return f"{finding}, of {num_bad_arms} of {record.qpos.shape[2]} arms" if num_bad_arms else str(finding)


def _outcome(divergence: Divergence, record: BatchRecord, finding: Finding | None) -> str:
    """Whether the replay reproduces the divergence."""
    devices = f"; the training had {divergence.devices} devices, and other random numbers on each"
    note = devices if divergence.devices != jax.device_count() else ""
    if finding is None:
        return f"does not reproduce it, all is finite{note}"
    if (finding.what, finding.index) != (divergence.finding.what, divergence.finding.index):
        return f"does not reproduce it, first not finite is {_described(finding, len(finding.arms), record)}{note}"
    equal = np.array_equal(record.trace.metrics, divergence.metrics, equal_nan=True)
    return f"reproduces it{', with the same metrics to the bit' if equal else ''}{note}"


def _metrics_table(divergence: Divergence, replayed: np.ndarray) -> Table:
    """Training metrics of the last update that is finite, and of the first one that is not."""
    recorded, finding = divergence.metrics, divergence.finding
    bad = 0 if finding.in_unrolls else finding.index
    columns = {"recorded": recorded[bad], "replayed": replayed[bad] if len(replayed) > bad else None}
    if bad:
        columns = {"update before": recorded[bad - 1], **columns}
    table = _table(f"training metrics of update {bad + 1} of {len(recorded)}", "metric", *columns)
    for index, name in enumerate(TRACED):
        values = ("-" if column is None else f"{column[index]:.4g}" for column in columns.values())
        table.add_row(name.replace("_", " "), *values)
    return table


def _magnitudes_table(record: BatchRecord, finding: Finding | None) -> Table:
    """Maximum magnitudes in the replay, up to the step where a value is not finite; nan where one of them is."""
    values, last = arm_values(record), None
    groups: dict[str, Any] = {"all arms": slice(None)}
    if finding and finding.in_unrolls:
        groups, last = {"arms at fault": finding.arms, **groups}, finding.index + 1
    table = _table("maximum magnitudes in the replay", "value", *groups)
    for name in ("qpos", "qvel", "action", "reward"):
        maxima = (np.abs(values[name][:last, arms]).max(initial=0.0) for arms in groups.values())
        table.add_row(escape(f"{name} {_UNITS.get(name, '')}".strip()), *(f"{value:.4g}" for value in maxima))
    return table


def _settings_table(config: TrainConfig) -> Table:
    values = OmegaConf.create(to_dict(config))
    table = _table("settings", "key", "value")
    for key in _SETTINGS:
        table.add_row(key, f"{OmegaConf.select(values, key):g}")
    return table


def _table(title: str, *columns: str) -> Table:
    table = Table(title=title, title_justify="left")
    for index, column in enumerate(columns):
        table.add_column(column, justify="right" if index else "left")
    return table
