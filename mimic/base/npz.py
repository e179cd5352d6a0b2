"""Reads npz files that others wrote: sizes are checked against the file's own size before anything is allocated."""

import ast
import math
import os
import struct
import zipfile
from collections.abc import Collection
from typing import IO, NamedTuple

import numpy as np

MAX_BYTES = (
    2**30
)  # of all arrays, each value counted as float64 at least; 20,000 demonstrations of a Panda have 0.4 GiB
MAX_TEXT = 2**20  # bytes of an array of text, whose values become Python objects
_CHUNK = 2**20  # bytes of a read
_MAX_DIRECTORY = 2**20  # bytes of a zip archive's directory; mimic's own have 700
_MAX_HEADER = 10_000  # bytes of an array's header, as in NumPy
_DEFLATE_RATIO = 1032  # the maximum compression of deflate
_COMPRESSIONS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
_ENCRYPTED = 0x1 | 0x20 | 0x40  # bits of an entry's flags: encrypted, patched, strongly encrypted
_MAGIC, _OBJECTS = b"\x93NUMPY", "O"
_KINDS = "biufcU"  # of NumPy's types: numbers and text
_LAST_CODE_POINT = 0x10FFFF
_END, _END_SIZE = b"PK\x05\x06", 22  # the zip archive's last record, which a comment of up to 64 KiB follows
_ZIP64_END = b"PK\x06\x07"


class _Header(NamedTuple):
    dtype: np.dtype
    fortran_order: bool
    shape: tuple[int, ...]

    @property
    def count(self) -> int:
        return math.prod(self.shape)

    @property
    def nbytes(self) -> int:
        return self.count * self.dtype.itemsize


def read_arrays(
    path: str | os.PathLike[str], names: Collection[str], max_bytes: int = MAX_BYTES
) -> dict[str, np.ndarray]:
    """The arrays of an npz file with these names, as far as it has them.

    Nothing is unpickled. Entries must be stored or deflated and not encrypted, and all sizes must fit the file's own.

    Raises:
      ValueError: no npz file, a damaged one, or arrays of objects, of more than `max_bytes`, or with text that cannot
        be printed. The message is one line, without the file's name.
    """
    try:
        with open(path, "rb") as file:
            if file.read(len(_MAGIC)) == _MAGIC:
                raise ValueError("it has a single array")
            size = os.fstat(file.fileno()).st_size
            _check_directory(file, size)
            with zipfile.ZipFile(file) as archive:
                entries = _entries(archive, size)
                requested = {name: entries[f"{name}.npy"] for name in names if f"{name}.npy" in entries}
                return _read_all(archive, requested, max_bytes)
    except Exception as error:  # zipfile and zlib have many types of error for damaged files
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise ValueError("".join(c if c.isprintable() else "?" for c in reason)) from error


def _check_directory(file: IO[bytes], size: int) -> None:
    """Rejects archives with a large directory, which `zipfile` would read as a whole."""
    tail_size = min(size, _END_SIZE + 2**16)
    file.seek(size - tail_size)
    tail = file.read(tail_size)
    start = tail.rfind(_END)
    if start < 0 or len(tail) - start < _END_SIZE:
        raise ValueError("it is no zip archive, or its end is missing")
    (directory,) = struct.unpack_from("<I", tail, start + 12)
    if directory > min(_MAX_DIRECTORY, size) or _ZIP64_END in tail[max(start - 20, 0) : start]:
        raise ValueError(f"its directory has {directory} bytes, expected at most {_MAX_DIRECTORY}")


def _entries(archive: zipfile.ZipFile, size: int) -> dict[str, zipfile.ZipInfo]:
    """The entries of an archive by name; their own headers must have the names that the directory says."""
    entries: dict[str, zipfile.ZipInfo] = {}
    for entry in archive.infolist():
        name = entry.filename
        if name in entries:
            raise ValueError(f"it has two entries {name!r}")
        if entry.flag_bits & _ENCRYPTED:
            raise ValueError(f"{name!r} is encrypted")
        if entry.compress_type not in _COMPRESSIONS:
            raise ValueError(f"{name!r} has compression {entry.compress_type}; expected stored or deflated")
        limit = entry.compress_size * (_DEFLATE_RATIO if entry.compress_type == zipfile.ZIP_DEFLATED else 1)
        if entry.compress_size > size or entry.file_size > limit:
            raise ValueError(f"{name!r} states {entry.file_size} bytes, more than its file of {size} bytes can hold")
        archive.open(entry).close()  # reads the entry's own header
        entries[name] = entry
    return entries


def _read_all(archive: zipfile.ZipFile, entries: dict[str, zipfile.ZipInfo], max_bytes: int) -> dict[str, np.ndarray]:
    arrays: dict[str, np.ndarray] = {}
    total = text = 0
    for name, entry in entries.items():
        with archive.open(entry) as stream:
            header, header_size = _read_header(stream, name)
            total += max(header.nbytes, 8 * header.count)
            if header_size + header.nbytes != entry.file_size:
                raise ValueError(f"{name} states {header.nbytes} bytes, its entry has {entry.file_size - header_size}")
            if total > max_bytes:
                raise ValueError(
                    f"its arrays need {total / 2**30:.3g} GiB; expected at most {max_bytes / 2**30:.3g} GiB"
                )
            text += header.nbytes if header.dtype.kind == "U" else 0
            if text > MAX_TEXT:
                raise ValueError(f"{name} has {header.nbytes} bytes of text; expected at most {MAX_TEXT}")
            arrays[name] = _read_values(stream, header, name)
    return arrays


def _read_header(stream: IO[bytes], name: str) -> tuple[_Header, int]:
    """The header of an array, and its size in bytes."""
    magic = stream.read(8)
    if magic[:6] != _MAGIC or magic[6:7] not in (b"\x01", b"\x02"):
        raise ValueError(f"{name} is no array")
    length_size = 2 if magic[6] == 1 else 4
    length = int.from_bytes(stream.read(length_size), "little")
    if length > _MAX_HEADER:
        raise ValueError(f"{name} has a header of {length} bytes, expected at most {_MAX_HEADER}")
    try:
        fields = ast.literal_eval(stream.read(length).decode("latin1").strip())
        descr, fortran_order, shape = fields["descr"], fields["fortran_order"], fields["shape"]
        is_shape = isinstance(shape, tuple) and all(type(side) is int and side >= 0 for side in shape)
        if not (len(fields) == 3 and isinstance(descr, str) and isinstance(fortran_order, bool) and is_shape):
            raise ValueError("unexpected fields")
        dtype = np.dtype(descr)
    except Exception as error:  # of the parser and of NumPy's types
        raise ValueError(f"the header of {name} cannot be read") from error
    if dtype.kind == _OBJECTS:
        raise ValueError("it has pickled objects")
    if dtype.kind not in _KINDS:
        raise ValueError(f"{name} has type {dtype}; expected numbers or text")
    return _Header(dtype, fortran_order, shape), 8 + length_size + length


def _read_values(stream: IO[bytes], header: _Header, name: str) -> np.ndarray:
    values = np.zeros(header.count, header.dtype)
    if header.nbytes:
        target = values.view(np.uint8)
        for start in range(0, header.nbytes, _CHUNK):
            content = stream.read(min(_CHUNK, header.nbytes - start))
            if len(content) != min(_CHUNK, header.nbytes - start):
                raise ValueError(f"{name} is not whole")
            target[start : start + len(content)] = np.frombuffer(content, np.uint8)
    if stream.read(1):  # at the end, `zipfile` verifies the checksum
        raise ValueError(f"{name} is longer than its header states")
    if header.dtype.kind == "U":
        _check_text(values, name)
    return values.reshape(header.shape, order="F" if header.fortran_order else "C")


def _check_text(texts: np.ndarray, name: str) -> None:
    """Rejects text with code points that do not exist or cannot be printed, such as line breaks."""
    code_points = np.frombuffer(texts.tobytes(), np.dtype(np.uint32).newbyteorder(texts.dtype.byteorder))
    if code_points.max(initial=0) > _LAST_CODE_POINT or not all(text.isprintable() for text in texts.tolist()):
        raise ValueError(f"{name} has text that cannot be printed")
