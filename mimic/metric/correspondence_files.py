"""Correspondence matrices W [n, n_hat] from files of others."""

import os
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from mimic.arms.embodiment import Embodiment
from mimic.base.files import read_text
from mimic.base.npz import read_arrays

SUFFIXES = (".csv", ".npz")
ARRAY = "correspondence"  # of an npz file
MAX_BYTES = 2**20  # of a file; 100 links each have 0.2 MB as text
_MAX_VALUE = 1e6


def is_correspondence_file(name: str) -> bool:
    """Whether the name of a correspondence is that of a file."""
    return name.endswith(SUFFIXES)


def load_correspondence(
    path: str | os.PathLike[str], expert: Embodiment, learner: Embodiment
) -> Float[np.ndarray, "expert learner"]:
    """Reads W from a CSV file, a row for each expert link, or from the array `correspondence` of an npz file.

    Raises:
      ValueError: no such file, one that cannot be read, or a matrix that does not fit the arms.
    """
    file = Path(path).expanduser()
    label = repr(os.fspath(path))
    if not file.is_file():
        raise ValueError(f"correspondence: no file at {label}")
    try:
        matrix = _read_npz(file) if file.suffix == ".npz" else _read_csv(file)
    except ValueError as error:
        raise ValueError(f"correspondence: {label} cannot be read: {error}") from error
    return checked_matrix(matrix, expert, learner, label)


def checked_matrix(
    matrix: Any, expert: Embodiment, learner: Embodiment, label: str
) -> Float[np.ndarray, "expert learner"]:
    """W as an array. Raises a ValueError that starts with the label if it does not fit the arms."""
    values, shape = np.asarray(matrix), (expert.num_links, learner.num_links)
    if values.shape != shape:
        raise ValueError(
            f"correspondence: {label}: expected shape {list(shape)}, a row for each expert link "
            f"({', '.join(expert.link_names)}) and a column for each learner link ({', '.join(learner.link_names)}), "
            f"got {list(values.shape)}"
        )
    if values.dtype.kind not in "biuf" or not np.all(np.isfinite(values)):
        raise ValueError(f"correspondence: {label}: expected finite numbers")
    if values.min() < 0 or not 0 < values.max() <= _MAX_VALUE:
        raise ValueError(
            f"correspondence: {label}: expected numbers from 0 to {_MAX_VALUE:g}, not all of them 0, got "
            f"{values.min():g} to {values.max():g}"
        )
    return values.astype(float)


def _read_npz(file: Path) -> np.ndarray:
    arrays = read_arrays(file, (ARRAY,), MAX_BYTES)
    if ARRAY not in arrays:
        raise ValueError(f"expected an array {ARRAY!r}")
    return arrays[ARRAY]


def _read_csv(file: Path) -> np.ndarray:
    lines = [line for line in read_text(file, MAX_BYTES).splitlines() if line.strip()]
    rows = [[_number(cell) for cell in line.split(",")] for line in lines]
    if not rows or len({len(row) for row in rows}) != 1:
        raise ValueError("expected rows of equal length, numbers separated by commas")
    return np.array(rows)


def _number(cell: str) -> float:
    try:
        return float(cell)
    except ValueError:
        raise ValueError(f"expected a number, got {cell.strip()!r:.40}") from None
