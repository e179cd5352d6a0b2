"""Parameters of networks in an npz file: an array for each leaf of their pytree, named by its path."""

import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np

from mimic.base.files import open_file
from mimic.base.npz import read_arrays

PARAMETERS = "parameters.npz"  # of a trained network that comes with the package
_MAX_BYTES = 2**26  # of these, as float64; the largest network of a preset has 2 MB


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


def read_parameters(path: Path, template: Any, *, max_bytes: int, of_package: bool = False) -> Any:
    """The parameters in a file, with the structure of the template.

    Args:
      path: an npz file.
      template: arrays or shapes with the structure of the parameters.
      max_bytes: maximum size of all arrays, see `read_arrays`.
      of_package: whether numbers of other types are converted to those of the template, and its entries of which the
        file has nothing, as the value network of a policy, are 0.

    Raises:
      OtherParameters: arrays of other names, shapes or types than those of the template.
      ValueError: it cannot be read, or has numbers that are not finite.
    """
    leaves = named_leaves(template)
    arrays = read_arrays(path, list(leaves), max_bytes)
    if of_package and arrays:
        entries = {name.split("/")[0] for name in arrays}
        unused = {name: leaf for name, leaf in leaves.items() if name.split("/")[0] not in entries}
        arrays |= {name: np.zeros(leaf.shape, leaf.dtype) for name, leaf in unused.items()}
    with open_file(path) as file, zipfile.ZipFile(file) as archive:
        stored = {name.removesuffix(".npy") for name in archive.namelist()}
    for name in [*leaves, *sorted(stored - leaves.keys())]:
        expected, got = _shape(leaves.get(name)), _shape(arrays.get(name)) if name in leaves else "an array"
        if expected == got and not of_package:
            expected, got = f"type {leaves[name].dtype}", f"type {arrays[name].dtype}"
        if expected != got:
            raise OtherParameters(f"{name}: expected {expected}, got {got}")
    for name, array in arrays.items():
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            raise ValueError(f"{name}: expected finite numbers, got others")
    values = [arrays[name].astype(leaf.dtype, copy=False) for name, leaf in leaves.items()]
    return jax.tree.unflatten(jax.tree.structure(template), values)


def has_network(folder: Path) -> bool:
    """Whether a folder has the parameters of a trained network that comes with the package, and no checkpoints."""
    return (folder / PARAMETERS).is_file()


def read_params(folder: Path, template: Any) -> Any:
    """The parameters of a trained network that comes with the package, with the template's structure and types.

    Raises:
      ValueError: the file is missing, cannot be read, or has parameters of another network.
    """
    path = folder / PARAMETERS
    try:
        return read_parameters(path, template, max_bytes=_MAX_BYTES, of_package=True)
    except ValueError as error:
        raise ValueError(f"{str(path)!r} cannot be read: {error}") from error


def _shape(array: Any) -> str:
    return "no such array" if array is None else f"shape {tuple(array.shape)}"
