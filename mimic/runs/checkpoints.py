"""Checkpoints of a run: a folder for each evaluation, named by its training steps.

A folder has the parameters (params.npz), the rest of the training's state (training.npz) in the newest ones, and
checkpoint.json: the run that it belongs to, the metrics of its training epoch, and the checksums of its files. It gets
its name when it is complete, and is never written again.
"""

import json
import os
import shutil
import sys
import uuid
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import jax
import jaxlib
import numpy as np

from mimic.base.files import file_digest, read_json, read_text, write_atomically
from mimic.base.npz import read_arrays
from mimic.runs.files import read_report
from mimic.runs.parameters import (
    OtherParameters,
    has_network,
    named_leaves,
    read_parameters,
    read_params,
    write_parameters,
)

FOLDER = "checkpoints"
WITH_STATE = 2  # newest checkpoints of a run that have the state of the training
STATE_UNUSED = (
    "warning: the checkpoint has no state of the training that fits the settings; optimizer and environments start anew"
)
_PARAMS, _STATE, _CONTENT, _RUN = "params.npz", "training.npz", "checkpoint.json", "run_id"
_PARTIAL, _DAMAGED = ".partial", ".damaged"
_UNITS = "env_steps", "training_poses"  # of training steps, in a report
_MAX_ARRAYS = 1000  # of a training's state; PPO has some 60

T = TypeVar("T")


class Checkpoint(NamedTuple):
    """What a training continues from.

    Attributes:
      step: training steps so far.
      params: the parameters, on the host.
      state: leaves of the training's whole state; None where only the parameters are known.
      metrics: training metrics of the epoch before; empty at the start of a training.
    """

    step: int
    params: Any
    state: Sequence[np.ndarray] | None
    metrics: dict[str, float]


class DamagedCheckpoint(ValueError):
    """A checkpoint that cannot be read, or that differs from what was written."""


def save_checkpoint(
    run_dir: Path,
    step: int,
    params: Any,
    state: Sequence[np.ndarray] | None = None,
    metrics: Mapping[str, float] | None = None,
) -> Path:
    """Writes a checkpoint; see `Checkpoint`.

    Raises:
      OSError: it cannot be written; nothing that existed is changed.
    """
    path = _path(run_dir, step)
    partial = path.with_name(path.name + _PARTIAL)
    shutil.rmtree(partial, ignore_errors=True)
    try:
        partial.mkdir(parents=True)
        write_parameters(partial / _PARAMS, {name: _array(leaf) for name, leaf in named_leaves(params).items()})
        if state is not None:
            np.savez(partial / _STATE, *state)
        content = {"run": _new_run_id(run_dir), "metrics": dict(metrics or {}), "made_with": _software_and_devices()}
        content["sha256"] = {file.name: file_digest(file) for file in partial.iterdir()}
        (partial / _CONTENT).write_text(json.dumps(content, indent=1))
        if path.exists():  # a damaged one, since a run never writes a step twice
            shutil.rmtree(path)
        os.replace(partial, path)
    except OSError as error:
        shutil.rmtree(partial, ignore_errors=True)
        raise OSError(f"checkpoint {str(path)!r} cannot be written: {_reason(error)}") from error
    return path


def thin_checkpoints(run_dir: Path, keep: int, best: int | None = None) -> None:
    """Keeps the newest checkpoints of a run, and the training's state in the last two of them and in the best one.

    Args:
      run_dir: the run directory.
      keep: number of checkpoints.
      best: training steps of a checkpoint that is kept in any case.
    """
    steps = checkpoint_steps(run_dir)
    for step in steps[:-keep]:
        if step != best:
            delete_checkpoint(run_dir, step)
    for step in steps[-keep:-WITH_STATE]:
        if step != best:
            (_path(run_dir, step) / _STATE).unlink(missing_ok=True)


def delete_checkpoint(run_dir: Path, step: int) -> None:
    """Removes a checkpoint."""
    path = _path(run_dir, step)
    partial = path.with_name(path.name + _PARTIAL)
    shutil.rmtree(partial, ignore_errors=True)
    os.replace(path, partial)  # never a checkpoint with some of its files
    shutil.rmtree(partial, ignore_errors=True)  # NFS keeps files that others read


def delete_partial_checkpoints(run_dir: Path) -> None:
    """Removes the remains of checkpoints that were being written or removed when a process ended."""
    for path in (run_dir / FOLDER).glob(f"*{_PARTIAL}"):
        shutil.rmtree(path, ignore_errors=True)


def mark_damaged_after(run_dir: Path, step: int) -> None:
    """Renames the damaged checkpoints of a run, those after a step: no longer used, and the steps are written again."""
    for later in checkpoint_steps(run_dir):
        if later > step:
            path = _path(run_dir, later)
            damaged = path.with_name(path.name + _DAMAGED)
            shutil.rmtree(damaged, ignore_errors=True)
            os.replace(path, damaged)


def checkpoint_steps(run_dir: Path) -> list[int]:
    """Training steps of the checkpoints of a run, ascending; of a network of the package, its own alone."""
    if has_network(run_dir):
        report = read_report(run_dir)
        return [report[unit] for unit in _UNITS if unit in report]
    folder = run_dir / FOLDER
    return sorted(int(path.name) for path in folder.iterdir() if path.name.isdigit()) if folder.is_dir() else []


def check_checkpoint(run_dir: Path, step: int | None = None) -> int:
    """Returns the training steps of a checkpoint of a run; those of the last undamaged one where None.

    Raises:
      ValueError: the run has no such checkpoint, or it is damaged.
    """
    return _first_undamaged(run_dir, step, lambda path: None)[0]


def run_id(run_dir: Path) -> str:
    """The random name of a run in its checkpoints; empty for a run without any."""
    try:
        return read_text(run_dir / FOLDER / _RUN)
    except FileNotFoundError:
        return ""


def load_checkpoint(run_dir: Path, template: Any, step: int | None = None) -> tuple[int, Any]:
    """Reads the parameters of a checkpoint; returns its training steps and a pytree with the template's structure.

    Args:
      run_dir: the run directory.
      template: arrays or shapes with the structure of the checkpoint.
      step: training steps of the checkpoint; the last undamaged one where None, with a warning if there are later ones.

    Raises:
      ValueError: no such checkpoint, a damaged checkpoint, or one of other arms or another network.
    """
    return _first_undamaged(run_dir, step, lambda path: _read_params(path, template))


def load_training(run_dir: Path, template: Any) -> Checkpoint:
    """Reads what a training continues from: the last undamaged checkpoint. See `load_checkpoint`."""
    step, params = load_checkpoint(run_dir, template)
    path = _path(run_dir, step)
    content = _content(path)
    metrics, made_with = content["metrics"], content["made_with"]
    now = _software_and_devices()
    for name in made_with.keys() & now.keys():
        if made_with[name] != now[name]:
            print(
                f"warning: the run was trained with {name} {made_with[name]}, now it is {now[name]}: it continues, but "
                f"its numbers will differ in the last bits",
                file=sys.stderr,
            )
    if not (path / _STATE).is_file():
        print(
            f"warning: checkpoint {str(path)!r} has no {_STATE}: training continues from its parameters alone",
            file=sys.stderr,
        )
        return Checkpoint(step, params, None, metrics)
    names = [f"arr_{i}" for i in range(_MAX_ARRAYS)]  # as NumPy names them
    try:
        arrays = read_arrays(path / _STATE, names, _max_bytes(path / _STATE))
    except ValueError as error:  # with a checksum that fits
        raise DamagedCheckpoint(f"checkpoint {str(path)!r}: {_STATE} cannot be read: {error}") from error
    return Checkpoint(step, params, [arrays[name] for name in names if name in arrays], metrics)


def _first_undamaged(run_dir: Path, step: int | None, read: Callable[[Path], T]) -> tuple[int, T]:
    """Training steps and content of a checkpoint, or of the newest one that can be read."""
    steps = checkpoint_steps(run_dir)
    if not steps:
        raise ValueError(f"{str(run_dir)!r} has no checkpoint")
    if step is not None and step not in steps:
        valid = ", ".join(map(str, steps))
        raise ValueError(f"checkpoint: expected one of {valid}, the steps that {str(run_dir)!r} has, got {step}")
    if has_network(run_dir):
        return steps[0], read(run_dir)
    candidates = steps[::-1] if step is None else [step]
    for candidate in candidates:
        path = _path(run_dir, candidate)
        try:
            _verify(path)
            return candidate, read(path)
        except DamagedCheckpoint as error:
            if candidate == candidates[-1]:
                raise
            print(f"warning: {error}; the checkpoint before it is used", file=sys.stderr, flush=True)
    raise AssertionError


def _verify(path: Path) -> None:
    """Raises a `DamagedCheckpoint` for files that were changed, and for a checkpoint of another run."""
    content = _content(path)
    for name in (_PARAMS, _STATE):
        file, expected = path / name, content["sha256"].get(name)
        if not file.is_file():
            if name == _PARAMS:
                raise DamagedCheckpoint(f"checkpoint {str(path)!r} is damaged: {name} is missing")
        elif file_digest(file) != expected:
            raise DamagedCheckpoint(f"checkpoint {str(path)!r} is damaged: {name} was changed")
    run = path.parent / _RUN
    if run.is_file() and content["run"] != read_text(run):
        raise DamagedCheckpoint(f"checkpoint {str(path)!r} is that of another run")


def _content(path: Path) -> dict[str, Any]:
    """What checkpoint.json says: the run, its metrics, and names and texts of what made it and of its checksums."""
    try:
        content = read_json(path / _CONTENT)
        for name, kind in (("run", str), ("metrics", int | float), ("made_with", str), ("sha256", str)):
            values = [content[name]] if name == "run" else content[name].values()
            if not all(isinstance(value, kind) for value in values):
                raise ValueError(f"{name}: unexpected value in {content[name]!r:.80}")
    except (OSError, ValueError, LookupError, AttributeError) as error:
        reason = "is missing" if isinstance(error, FileNotFoundError) else f"cannot be read: {_reason(error)}"
        raise DamagedCheckpoint(f"checkpoint {str(path)!r} is damaged: {_CONTENT} {reason}") from error
    return content


def _software_and_devices() -> dict[str, str]:
    """What the bits of a training depend on, apart from its config."""
    devices = jax.devices()
    return {
        "jax": jax.__version__,
        "jaxlib": jaxlib.__version__,
        "device": f"{len(devices)} x {devices[0].device_kind}",
    }


def _array(leaf: Any) -> np.ndarray:
    """A leaf as an array; a number of Python has the type that JAX gives it."""
    return np.asarray(leaf, getattr(leaf, "dtype", None) or jax.dtypes.result_type(leaf))


def _max_bytes(file: Path) -> int:
    """Of the arrays in a file that is not compressed; each value counts as 8 bytes at least."""
    return 8 * file.stat().st_size


def _read_params(path: Path, template: Any) -> Any:
    if has_network(path):
        return read_params(path, template)
    file = path / _PARAMS
    try:
        return read_parameters(file, template, max_bytes=_max_bytes(file))
    except OtherParameters as error:
        raise OtherParameters(
            f"checkpoint {str(path)!r} does not fit the config of its run: it has other arms or another network "
            f"({error})"
        ) from error
    except ValueError as error:
        raise DamagedCheckpoint(f"checkpoint {str(path)!r}: {_PARAMS} cannot be read: {error}") from error


def _path(run_dir: Path, step: int) -> Path:
    return (run_dir / FOLDER / f"{step:012d}").absolute()


def _new_run_id(run_dir: Path) -> str:
    """A random name of the run, created with its first checkpoint."""
    if not run_id(run_dir):
        path = run_dir / FOLDER / _RUN
        path.parent.mkdir(exist_ok=True)
        write_atomically(path, uuid.uuid4().hex)
    return run_id(run_dir)


def _reason(error: Exception) -> str:
    return " ".join(str(error).split())[:200]
