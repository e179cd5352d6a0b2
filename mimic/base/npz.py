"""Reads npz files that others wrote: nothing is unpickled, and sizes are checked before anything is allocated."""

import math
import os
import struct
import zipfile
from collections.abc import Collection
from typing import IO

import numpy as np
from numpy.lib import format as npy

from mimic.base.files import open_file

MAX_BYTES = 2**30  # of all arrays, 8 for each value at least; 20,000 demonstrations of a Panda have 0.4 GiB
MAX_TEXT = 2**23  # bytes of an array of text, whose values become Python objects
_MAX_DIRECTORY = 2**20  # bytes of a zip archive's directory, which `zipfile` reads as a whole; mimic's own have 700
_END, _END_SIZE = b"PK\x05\x06", 22  # the zip archive's last record, which a comment of up to 64 KiB follows
_COMPRESSIONS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
_KINDS = "biufcU"  # of NumPy's types: numbers and text
_HEADERS = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}


def read_arrays(
    path: str | os.PathLike[str], names: Collection[str] | None, max_bytes: int = MAX_BYTES
) -> dict[str, np.ndarray]:
    """The arrays of an npz file with these names, as far as it has them; all for None.

    Raises:
      ValueError: no npz file, a damaged one, or arrays of objects, of more than `max_bytes`, or with text that cannot
        be printed. The message is one line, without the file's name.
    """
    arrays: dict[str, np.ndarray] = {}
    try:
        with open_file(path) as file:
            _check_directory(file)
            with zipfile.ZipFile(file) as archive:
                entries = {entry.filename: entry for entry in archive.infolist()}
                for entry in entries.values():
                    archive.open(entry).close()  # reads its own header, whose name must be that of the directory
                for name in [key.removesuffix(".npy") for key in entries] if names is None else names:
                    if f"{name}.npy" in entries:
                        arrays[name] = _read_array(archive, entries[f"{name}.npy"], max_bytes)
                        max_bytes -= 8 * arrays[name].size
    except Exception as error:  # zipfile, zlib and NumPy have many types of error for damaged files
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise ValueError("".join(c if c.isprintable() else "?" for c in reason)) from error
    return arrays


def _check_directory(file: IO[bytes]) -> None:
    size = file.seek(0, os.SEEK_END)
    file.seek(max(size - _END_SIZE - 2**16, 0))
    tail = file.read()
    start = tail.rfind(_END)
    if start < 0 or len(tail) - start < _END_SIZE:
        raise ValueError("it is no zip archive, or its end is missing")
    (directory,) = struct.unpack_from("<I", tail, start + 12)
    if directory > _MAX_DIRECTORY:
        raise ValueError(f"its directory has {directory} bytes, expected at most {_MAX_DIRECTORY}")


def _read_array(archive: zipfile.ZipFile, entry: zipfile.ZipInfo, max_bytes: int) -> np.ndarray:
    name = entry.filename.removesuffix(".npy")
    if entry.compress_type not in _COMPRESSIONS:
        raise ValueError(f"{name} has compression {entry.compress_type}; expected stored or deflated")
    try:
        with archive.open(entry) as stream:
            shape, _, dtype = _HEADERS[npy.read_magic(stream)](stream)
            size, stated = math.prod(shape) * dtype.itemsize, entry.file_size - stream.tell()
    except Exception as error:  # of the parser and of NumPy's types
        raise ValueError(f"{name} is no array, or its header cannot be read: {error}") from error
    if dtype.hasobject or dtype.kind not in _KINDS:
        raise ValueError(f"{name} has type {dtype}; expected numbers or text")
    if min(shape, default=0) < 0 or size != stated:
        raise ValueError(f"{name} states the shape {shape}, which does not fit its {stated} bytes")
    if max(size, 8 * math.prod(shape)) > max_bytes:
        raise ValueError(f"its arrays are too large; expected at most {max_bytes / 2**30:.3g} GiB for {name}")
    if dtype.kind == "U" and size > MAX_TEXT:
        raise ValueError(f"{name} has {size} bytes of text; expected at most {MAX_TEXT}")
    with archive.open(entry) as stream:
        array = npy.read_array(stream, allow_pickle=False)  # to its end, where `zipfile` verifies the checksum
    if dtype.kind == "U" and not all(text.isprintable() for text in array.ravel().tolist()):
        raise ValueError(f"{name} has text that cannot be printed")
    return array
