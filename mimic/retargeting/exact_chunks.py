"""Functions of a fixed number of times, so that motions of all lengths share what is compiled."""

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

import jax
import numpy as np
from jax import Array

from mimic.base import compat
from mimic.base.compilation import compiled_once
from mimic.retargeting.exact_pose import exact_solver
from mimic.retargeting.hand_target import Placement

T = TypeVar("T")

_THREADS = 8  # at most, each with arrays of its own


def chunk_size() -> int:
    """Times of a chunk: more where these are not on a CPU, and a call costs more."""
    return 256 if compat.is_cpu() else 4096


def in_chunks(rows: np.ndarray, size: int, overlap: int = 0) -> Iterator[np.ndarray]:
    """The rows in chunks of one size, each with the first rows of the next; the last one is padded with its last row.

    Each row is among the first `size - overlap` of a chunk.
    """
    for start in range(0, len(rows), size - overlap):
        chunk = rows[start : start + size]
        yield np.concatenate([chunk, np.repeat(chunk[-1:], size - len(chunk), axis=0)])


def by_chunks(function: Callable[..., Any], *arrays: np.ndarray, size: int | None = None) -> tuple[np.ndarray, ...]:
    """A function of chunks of rows, for all rows; `chunk_size` where no size is given."""
    chunks = zip(*(in_chunks(array, size or chunk_size()) for array in arrays), strict=True)
    results = [function(*chunk) for chunk in chunks]
    return tuple(np.concatenate(jax.device_get(part))[: len(arrays[0])] for part in zip(*results, strict=True))


def in_threads(function: Callable[..., T], *arguments: Sequence[Any]) -> Iterator[T]:
    """As `map`: a function of the first arguments, which compiles, and then of the others in threads."""
    first, *others = zip(*arguments, strict=True)
    yield function(*first)
    with ThreadPoolExecutor(min(os.cpu_count() or 1, _THREADS)) as pool:
        yield from pool.map(lambda values: function(*values), others)


@compiled_once
def hand_report(*arms: Any) -> Callable[..., tuple[Array, Array, Array]]:
    """The function from poses, a placement and angles to distances and errors of the hand [m, rad]."""
    solver = exact_solver(*arms)

    def report(poses: Array, base: Placement, qpos: Array) -> tuple[Array, Array, Array]:
        targets, states = solver.targets(base, poses)
        lanes = qpos.astype(poses.dtype).T[:, None]
        position, rotation = solver.errors(targets, lanes)
        return solver.distances(states, lanes)[0], position[0], rotation[0]

    return report
