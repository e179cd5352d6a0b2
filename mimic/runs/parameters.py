"""Parameters of networks in an npz file: an array for each leaf of their pytree, named by its path."""

import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np

from mimic.base.files import open_file
from mimic.base.npz import read_arrays


class OtherParameters(ValueError):
    """A file with parameters of another network."""


def named_leaves(tree: Any) -> dict[str, Any]:
    """The leaves of a pytree by their path, as in "params/Dense_0/kernel"."""
    leaves, _ = jax.tree_util.tree_flatten_with_path(tree)
    return {jax.tree_util.keystr(path, simple=True, separator="/"): leaf for path, leaf in leaves}


def write_parameters(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Writes arrays by name; an error leaves a part of the file."""
    with path.open("wb") as file:  # NumPy would add a suffix to the name
        np.savez(file, **arrays)  # type: ignore[arg-type]


def read_parameters(path: Path, template: Any, *, max_bytes: int, cast: bool = False) -> Any:
    """The parameters in a file, with the structure of the template.

    Args:
      path: an npz file.
      template: arrays or shapes with the structure of the parameters.
      max_bytes: maximum size of all arrays, see `read_arrays`.
      cast: whether numbers of other types are converted to those of the template.

    Raises:
      OtherParameters: arrays of other names, shapes or types than those of the template.
      ValueError: it cannot be read, or has numbers that are not finite.
    """
    leaves = named_leaves(template)
    arrays = read_arrays(path, list(leaves), max_bytes)
    with open_file(path) as file, zipfile.ZipFile(file) as archive:
        stored = {name.removesuffix(".npy") for name in archive.namelist()}
    for name in [*leaves, *sorted(stored - leaves.keys())]:
        expected, got = _shape(leaves.get(name)), _shape(arrays.get(name)) if name in leaves else "an array"
        if expected == got and not cast:
            expected, got = f"type {leaves[name].dtype}", f"type {arrays[name].dtype}"
        if expected != got:
            raise OtherParameters(f"{name}: expected {expected}, got {got}")
    for name, array in arrays.items():
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            raise ValueError(f"{name}: expected finite numbers, got others")
    values = [arrays[name].astype(leaf.dtype, copy=False) for name, leaf in leaves.items()]
    return jax.tree.unflatten(jax.tree.structure(template), values)


def _shape(array: Any) -> str:
    return "no such array" if array is None else f"shape {tuple(array.shape)}"
