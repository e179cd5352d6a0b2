"""Reads files: the only module of mimic that opens a file to read it.

A named pipe or a device would block a reader for ever, and a file of another program may be larger than the memory.
"""

import hashlib
import io
import json
import os
import shutil
import stat
from pathlib import Path
from typing import Any

MAX_BYTES = 2**30
_MAX_JSON_BYTES = 10_000_000  # a report has some 20 kB, the plan of a large sweep 1 MB
_KINDS = {
    stat.S_IFDIR: "folder",
    stat.S_IFIFO: "named pipe",
    stat.S_IFSOCK: "socket",
    stat.S_IFCHR: "device",
    stat.S_IFBLK: "device",
}
_WITHOUT_WAITING = getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_NOCTTY", 0) | getattr(os, "O_BINARY", 0)
PathLike = str | os.PathLike[str]


def open_file(path: PathLike, max_bytes: int | None = MAX_BYTES) -> io.BufferedReader:
    """Opens a regular file to read its bytes.

    Args:
      path: the file.
      max_bytes: the maximum of its size; None for a file that is read in parts.

    Raises:
      ValueError: no regular file, such as a named pipe, or a larger one. The message does not name the file.
      OSError: it does not exist or cannot be opened.
    """
    descriptor = os.open(path, os.O_RDONLY | _WITHOUT_WAITING)
    try:
        _check(os.fstat(descriptor), max_bytes)
        return os.fdopen(descriptor, "rb")
    except BaseException:
        os.close(descriptor)
        raise


def check_file(path: PathLike, max_bytes: int | None = MAX_BYTES) -> Path:
    """Checks a file that a library opens by its path; returns the path. See `open_file`."""
    _check(os.stat(path), max_bytes)
    return Path(path)


def copy_file(source: PathLike, target: PathLike) -> None:
    """Copies a regular file of any size. See `open_file`."""
    with open_file(source, None) as content, open(target, "wb") as copy:
        shutil.copyfileobj(content, copy)


def check_folder(folder: PathLike) -> Path:
    """Checks all files in a folder that a library reads, without a limit on their size; returns its path.

    Raises:
      ValueError: it contains something that is neither a regular file nor a folder.
    """
    for path in Path(folder).rglob("*"):
        if not path.is_dir():
            try:
                check_file(path, None)
            except ValueError as error:
                raise ValueError(f"{path.name}: {error}") from error
    return Path(folder)


def read_bytes(path: PathLike, max_bytes: int = MAX_BYTES) -> bytes:
    """The content of a regular file. See `open_file`."""
    with open_file(path, max_bytes) as file:
        content = file.read(max_bytes + 1)
    if len(content) > max_bytes:  # a file that grows, or one of /proc, whose size is stated as 0
        raise ValueError(_too_large(len(content), max_bytes))
    return content


def read_text(path: PathLike, max_bytes: int = MAX_BYTES, *, errors: str = "strict") -> str:
    """The content of a regular file as text in UTF-8, without a byte order mark; line ends become newlines.

    Args:
      path: the file.
      max_bytes: the maximum of its size.
      errors: what to do with bytes that are not UTF-8, see `bytes.decode`.

    Raises:
      ValueError: see `open_file`; or it is not UTF-8.
      OSError: see `open_file`.
    """
    content = read_bytes(path, max_bytes)
    try:
        return io.TextIOWrapper(io.BytesIO(content), "utf-8-sig", errors).read()
    except UnicodeDecodeError as error:
        raise ValueError("expected text in UTF-8") from error


def read_json(path: PathLike) -> dict[str, Any]:
    """Reads a JSON file that holds an object.

    Raises:
      ValueError: see `read_text`; or it holds something else.
      OSError: see `open_file`.
    """
    try:
        content = json.loads(read_text(path, _MAX_JSON_BYTES))
    except RecursionError as error:
        raise ValueError("expected values that are not nested as deeply") from error
    if not isinstance(content, dict):
        raise ValueError(f"expected an object, got {content!r:.80}")
    return content


def write_atomically(path: Path, text: str) -> None:
    """Writes a file; an existing one is replaced only when the new one is complete."""
    partial = path.with_name(path.name + ".partial")
    partial.write_text(text, newline="")
    os.replace(partial, path)


def file_digest(path: PathLike) -> str:
    """The SHA-256 checksum of a regular file of any size. See `open_file`."""
    with open_file(path, None) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _check(status: os.stat_result, max_bytes: int | None) -> None:
    if not stat.S_ISREG(status.st_mode):
        kind = _KINDS.get(stat.S_IFMT(status.st_mode), "special file")
        raise ValueError(f"expected a regular file, got a {kind}")
    if max_bytes is not None and status.st_size > max_bytes:
        raise ValueError(_too_large(status.st_size, max_bytes))


def _too_large(size: int, max_bytes: int) -> str:
    return f"expected at most {max_bytes:,} bytes, got {size:,}"
