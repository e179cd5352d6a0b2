"""Checkpoints of a run: a folder for each evaluation, named by its training steps.

A folder has the parameters (orbax), the rest of the training's state (training.npz) in the newest ones, and
checkpoint.json: the run that it belongs to, the metrics of its training epoch, and the checksums of its files. It gets
its name when it is complete, and is never written again.
"""

import contextlib
import json
import logging
import os
import shutil
import sys
import uuid
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jaxlib
import numpy as np
import orbax.checkpoint as ocp

from mimic.base.files import file_digest, read_json, read_text, write_atomically
from mimic.base.npz import read_arrays

FOLDER = "checkpoints"
WITH_STATE = 2  # newest checkpoints of a run that have the state of the training
STATE_UNUSED = (
    "warning: the checkpoint has no state of the training that fits the settings; optimizer and environments start anew"
)
_STATE, _CONTENT, _RUN = "training.npz", "checkpoint.json", "run_id"
_PARTIAL, _DAMAGED = ".partial", ".damaged"
_MAX_ARRAYS = 1000  # of a training's state; PPO has some 60


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
    # Orbax rejects JAX's arrays of one process among several, but not NumPy's; it takes those in plain containers.
    plain = jax.tree.map(np.asarray, ocp.tree.serialize_tree(params, keep_empty_nodes=True))
    try:
        with _no_warnings(), _checkpointer() as checkpointer:
            checkpointer.save(partial, ocp.args.PyTreeSave(plain), force=True)
        if state is not None:  # not by orbax, which takes 100 ms for the 10 MB of 4096 arms; NumPy takes 6
            np.savez(partial / _STATE, *state)
        content = {"run": _new_run_id(run_dir), "metrics": dict(metrics or {}), "made_with": _software_and_devices()}
        content["sha256"] = _checksums(partial)
        (partial / _CONTENT).write_text(json.dumps(content, indent=1))
        if path.exists():  # a damaged one, since a run never writes a step twice
            shutil.rmtree(path)
        os.replace(partial, path)
    except Exception as error:  # orbax raises many types of error where a disk is full
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
    for path in (run_dir / FOLDER).glob(f"*{_PARTIAL}*"):  # orbax appends to the name while it writes
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
    """Training steps of the checkpoints of a run, ascending."""
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
    metrics, made_with = content.get("metrics", {}), content.get("made_with", {})
    now = _software_and_devices()
    for name in made_with.keys() & now.keys():
        if made_with[name] != now[name]:
            print(
                f"warning: the run was trained with {name} {made_with[name]}, now it is {now[name]}: it continues, but "
                f"its numbers will differ in the last bits",
                file=sys.stderr,
            )
    if not (path / _STATE).is_file():
        return Checkpoint(step, params, None, metrics)
    names = [f"arr_{i}" for i in range(_MAX_ARRAYS)]  # as NumPy names them
    size = (path / _STATE).stat().st_size
    try:
        arrays = read_arrays(path / _STATE, names, max_bytes=8 * size)  # each value counts as 8 bytes at least
    except ValueError as error:  # with a checksum that fits
        raise DamagedCheckpoint(f"checkpoint {str(path)!r}: {_STATE} cannot be read: {error}") from error
    return Checkpoint(step, params, [arrays[name] for name in names if name in arrays], metrics)


def _first_undamaged(run_dir: Path, step: int | None, read: Any) -> tuple[int, Any]:
    """Training steps and content of a checkpoint, or of the newest one that can be read."""
    steps = checkpoint_steps(run_dir)
    if not steps:
        raise ValueError(f"{str(run_dir)!r} has no checkpoint")
    if step is not None and step not in steps:
        raise ValueError(f"{str(run_dir)!r} has no checkpoint {step}; it has {', '.join(map(str, steps))}")
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
    checksums = content.get("sha256", {})  # older checkpoints have none
    actual = _checksums(path)
    for name, expected in checksums.items():
        if (name in actual or name != _STATE) and actual.get(name) != expected:
            raise DamagedCheckpoint(f"checkpoint {str(path)!r} is damaged: {name} is missing or was changed")
    run = path.parent / _RUN
    if checksums and run.is_file() and content.get("run") != read_text(run):
        raise DamagedCheckpoint(f"checkpoint {str(path)!r} is that of another run")


def _content(path: Path) -> dict[str, Any]:
    try:
        content = read_json(path / _CONTENT)
    except FileNotFoundError:
        return {}
    except ValueError as error:
        raise DamagedCheckpoint(f"checkpoint {str(path)!r} is damaged: {_CONTENT} cannot be read") from error
    if not all(isinstance(content.get(name, {}), dict) for name in ("metrics", "made_with", "sha256")):
        raise DamagedCheckpoint(f"checkpoint {str(path)!r} is damaged: {_CONTENT} has other content")
    return content


def _software_and_devices() -> dict[str, str]:
    """What the bits of a training depend on, apart from its config."""
    devices = jax.devices()
    return {
        "jax": jax.__version__,
        "jaxlib": jaxlib.__version__,
        "device": f"{len(devices)} x {devices[0].device_kind}",
    }


def _checksums(path: Path) -> dict[str, str]:
    files = sorted(file for file in path.rglob("*") if file.is_file() and file.name != _CONTENT)
    return {file.relative_to(path).as_posix(): file_digest(file) for file in files}


def _read_params(path: Path, template: Any) -> Any:
    abstract = jax.tree.map(ocp.utils.to_shape_dtype_struct, template)
    expected, stored = _shapes(template), None
    try:
        with _checkpointer() as checkpointer:
            metadata = checkpointer.metadata(path).item_metadata
            stored = _shapes(metadata.tree)
            if stored == expected:  # otherwise orbax would fail in its threads, which print their own errors
                restore_args = ocp.checkpoint_utils.construct_restore_args(abstract)
                return checkpointer.restore(path, ocp.args.PyTreeRestore(abstract, restore_args=restore_args))
    except Exception as error:  # orbax raises many types of error for a damaged folder
        reason = "a file is missing" if stored is None else _reason(error)
        raise DamagedCheckpoint(f"checkpoint {str(path)!r} cannot be read: {reason}") from error
    name = next(key for key in {**expected, **stored} if expected.get(key) != stored.get(key))
    raise ValueError(
        f"checkpoint {str(path)!r} does not fit the config of its run: it has other arms or another network, or "
        f"is of another version of mimic ({name}: expected {_shape_text(expected.get(name))}, got "
        f"{_shape_text(stored.get(name))})"
    )


def _shape_text(shape: tuple[int, ...] | None) -> str:
    return "no such array" if shape is None else f"shape {shape}"


def _checkpointer() -> ocp.Checkpointer:
    """Of this process alone: orbax would wait for those that train with it, which do not write.

    It writes a file for each array: orbax's default, OCDBT, is slower and its library keeps 3 kB of memory at each
    save. It reads both.
    """
    this = jax.process_index()
    options = ocp.options.MultiprocessingOptions(primary_host=this, active_processes={this})
    handler = ocp.PyTreeCheckpointHandler(use_ocdbt=False, multiprocessing_options=options)
    return ocp.Checkpointer(handler, multiprocessing_options=options)


@contextlib.contextmanager
def _no_warnings() -> Iterator[None]:
    """Hides orbax's warnings: without OCDBT, each save warns that there is nothing to merge."""
    logger = logging.getLogger("absl")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        yield
    finally:
        logger.setLevel(level)


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


def _shapes(tree: Any) -> dict[str, tuple[int, ...]]:
    """Shape of each leaf by its path. Paths do not depend on whether a node is a tuple or list, dataclass or dict."""
    leaves = jax.tree_util.tree_leaves_with_path(tree, is_leaf=lambda node: hasattr(node, "shape"))
    return {jax.tree_util.keystr(path, simple=True, separator="."): np.shape(leaf) for path, leaf in leaves}
