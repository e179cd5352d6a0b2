"""Policies on disk: orbax checkpoints, one folder for each evaluation, named by its environment steps."""

import shutil
from pathlib import Path
from typing import Any

import jax
import numpy as np
import orbax.checkpoint as ocp

FOLDER = "checkpoints"


def save_checkpoint(run_dir: Path, step: int, params: Any) -> Path:
    """Writes a pytree; the folder has its final name only when it is whole."""
    path = (run_dir / FOLDER / f"{step:012d}").absolute()
    # Orbax refuses the arrays of one process among several, but not NumPy's; plain containers let them be that.
    plain = jax.tree.map(np.asarray, ocp.tree.serialize_tree(params, keep_empty_nodes=True))
    with _checkpointer() as checkpointer:
        checkpointer.save(path, plain, force=True)
    return path


def _checkpointer() -> ocp.StandardCheckpointer:
    """Of this process by itself: orbax would wait for the others that train with it, of which one alone writes."""
    this = jax.process_index()
    options = ocp.options.MultiprocessingOptions(primary_host=this, active_processes={this})
    return ocp.StandardCheckpointer(multiprocessing_options=options)


def delete_checkpoint(run_dir: Path, step: int) -> None:
    """Removes a checkpoint."""
    shutil.rmtree(run_dir / FOLDER / f"{step:012d}")


def checkpoint_steps(run_dir: Path) -> list[int]:
    """Environment steps of the checkpoints of a run, ascending."""
    folder = run_dir / FOLDER
    return sorted(int(path.name) for path in folder.iterdir() if path.name.isdigit()) if folder.is_dir() else []


def check_checkpoint(run_dir: Path, step: int | None = None) -> int:
    """Returns the environment steps of a checkpoint of a run; those of the last one where None.

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
    """Reads a checkpoint of a run; returns its environment steps and a pytree with the template's structure.

    Args:
      run_dir: the run directory.
      template: arrays or shapes with the structure of the checkpoint.
      step: environment steps of the checkpoint; the last one where None.

    Raises:
      ValueError: no such checkpoint, a damaged checkpoint, or one of other arms or another network.
    """
    step = check_checkpoint(run_dir, step)
    path = (run_dir / FOLDER / f"{step:012d}").absolute()
    abstract = jax.tree.map(ocp.utils.to_shape_dtype_struct, template)
    expected = _shapes(template)
    try:
        with _checkpointer() as checkpointer:
            stored = _shapes(checkpointer.metadata(path).item_metadata.tree)
            if stored == expected:  # otherwise orbax would fail in its threads, which print their own errors
                return step, checkpointer.restore(path, abstract)
    except Exception as error:  # orbax raises many types of error for a damaged folder
        reason = " ".join(str(error).split())[:200]
        raise ValueError(f"checkpoint {str(path)!r} cannot be read: {reason}") from error
    name = next(key for key in {**expected, **stored} if expected.get(key) != stored.get(key))
    raise ValueError(
        f"checkpoint {str(path)!r} does not fit the config of its run: it has other arms or another network "
        f"({name}: expected shape {expected.get(name)}, got {stored.get(name)})"
    )


def _shapes(tree: Any) -> dict[str, tuple[int, ...]]:
    """Shape of each leaf by its path. Paths do not depend on whether a node is a tuple or list, dataclass or dict."""
    leaves = jax.tree_util.tree_leaves_with_path(tree, is_leaf=lambda node: hasattr(node, "shape"))
    return {jax.tree_util.keystr(path, simple=True, separator="."): np.shape(leaf) for path, leaf in leaves}
