"""Policies on disk: orbax checkpoints, one folder for each evaluation, named by its environment steps."""

import shutil
from pathlib import Path
from typing import Any

import jax
import orbax.checkpoint as ocp

FOLDER = "checkpoints"


def save_checkpoint(run_dir: Path, step: int, params: Any) -> Path:
    """Writes a pytree; the folder has its final name only when it is whole."""
    path = (run_dir / FOLDER / f"{step:012d}").absolute()
    with ocp.StandardCheckpointer() as checkpointer:
        checkpointer.save(path, params, force=True)
    return path


def delete_checkpoint(run_dir: Path, step: int) -> None:
    """Removes a checkpoint."""
    shutil.rmtree(run_dir / FOLDER / f"{step:012d}")


def checkpoint_steps(run_dir: Path) -> list[int]:
    """Environment steps of the checkpoints of a run, in order."""
    folder = run_dir / FOLDER
    return sorted(int(path.name) for path in folder.iterdir() if path.name.isdigit()) if folder.is_dir() else []


def check_checkpoint(run_dir: Path, step: int | None = None) -> int:
    """Environment steps of a checkpoint of a run, of the last one where None.

    Raises:
      ValueError: the run has no such checkpoint.
    """
    steps = checkpoint_steps(run_dir)
    if not steps:
        raise ValueError(f"{str(run_dir)!r} has no checkpoint")
    step = steps[-1] if step is None else step
    if step not in steps:
        raise ValueError(f"{str(run_dir)!r} has no checkpoint {step}; it has {', '.join(map(str, steps))}")
    return step


def load_checkpoint(run_dir: Path, template: Any, step: int | None = None) -> tuple[int, Any]:
    """Reads a checkpoint of a run: its step, and a pytree like the template.

    Args:
      run_dir: the run directory.
      template: arrays or shapes of the structure that was saved.
      step: environment steps of the checkpoint; the last one where None.

    Raises:
      ValueError: no such checkpoint, or one of another structure.
    """
    step = check_checkpoint(run_dir, step)
    path = (run_dir / FOLDER / f"{step:012d}").absolute()
    abstract = jax.tree.map(ocp.utils.to_shape_dtype_struct, template)
    try:
        with ocp.StandardCheckpointer() as checkpointer:
            return step, checkpointer.restore(path, abstract)
    except Exception as error:  # orbax has many kinds for a folder that is damaged or of another structure
        reason = " ".join(str(error).split())[:200]
        raise ValueError(f"checkpoint {str(path)!r} cannot be read: {reason}") from error
