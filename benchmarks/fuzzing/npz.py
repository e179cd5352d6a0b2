"""Damaged and hostile npz files: mimic's own demonstrations, and motions in LocoMuJoCo's format."""

import functools
import io
import lzma
import pickle
import struct
import warnings
import zipfile
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.random import Generator

import mimic
from benchmarks.fuzzing import ACCEPTED, OTHER_NUMBERS, Case
from mimic.motions.demonstrations import FORMAT

SEED = 25
_FILE, _MARK = "motions.npz", "unpickled"
_HORIZON, _DT, _JOINTS = 50, 0.1, 7
_LOCAL, _CENTRAL, _END = b"PK\x03\x04", b"PK\x01\x02", b"PK\x05\x06"
Damage = Callable[[bytes, Generator], bytes]


@functools.cache
def _expert() -> Any:
    return mimic.panda(limits="hardware")


@functools.cache
def _content(own: bool) -> dict[str, np.ndarray]:
    """Arrays of a good file."""
    arm = _expert()
    time = np.arange(_HORIZON + 1) * _DT
    phase = np.arange(2)[:, None, None] + np.arange(_JOINTS)
    qpos = np.asarray(arm.home) + 0.05 * np.sin(time[:, None] + phase)
    qvel = 0.05 * np.cos(time[:, None] + phase)
    names = np.array(arm.joint_names)
    if own:
        facts = {"dt": np.array(_DT), "seed": np.array(3), "arm": np.array(arm.name), "format": np.array(FORMAT)}
        torque = np.zeros((2, _HORIZON, _JOINTS))
        return {"qpos": qpos, "qvel": qvel, "goals": qpos[:, -1], "joint_names": names, "torque": torque, **facts}
    splits = np.array([0, _HORIZON + 1, 2 * (_HORIZON + 1)])
    types = np.full(_JOINTS, 3)
    motions = {"qpos": qpos.reshape(-1, _JOINTS), "qvel": qvel.reshape(-1, _JOINTS), "frequency": np.array(1 / _DT)}
    return {**motions, "joint_names": names, "split_points": splits, "jnt_type": types}


def _npz(arrays: Mapping[str, np.ndarray], compressed: bool = True) -> bytes:
    stream = io.BytesIO()
    (np.savez_compressed if compressed else np.savez)(stream, **arrays)  # type: ignore[arg-type]
    return stream.getvalue()


@functools.cache
def _good(own: bool, compressed: bool) -> bytes:
    return _npz(_content(own), compressed)


def _read(path: Path, own: bool) -> list[np.ndarray]:
    arm = _expert()
    if own:
        loaded = mimic.load_demonstrations(path)
        loaded.check_fits(arm, _DT, _HORIZON)
        mimic.check_effort(loaded, arm)
    else:
        loaded, _ = mimic.import_demonstrations(path, arm, dt=_DT, horizon=_HORIZON)
    torque = () if loaded.torque is None else (loaded.torque,)
    return [loaded.qpos, loaded.qvel, loaded.goals, *torque]


@functools.cache
def _expected(own: bool) -> list[np.ndarray]:
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / _FILE).write_bytes(_good(own, True))
        return _read(Path(folder) / _FILE, own)


# --- bytes of a good file are changed: it must be rejected, or be what it was ---


def _flipped(data: bytes, rng: Generator) -> bytes:
    changed = bytearray(data)
    for _ in range(int(rng.integers(1, 9))):
        changed[int(rng.integers(len(data)))] ^= 1 << int(rng.integers(8))
    return bytes(changed)


def _flipped_structure(data: bytes, rng: Generator) -> bytes:
    """Bits of the zip archive's headers alone."""
    starts = [at for mark in (_LOCAL, _CENTRAL, _END) for at in _positions(data, mark)]
    changed = bytearray(data)
    for _ in range(int(rng.integers(1, 4))):
        at = starts[int(rng.integers(len(starts)))] + int(rng.integers(46))
        changed[min(at, len(data) - 1)] ^= 1 << int(rng.integers(8))
    return bytes(changed)


def _cut(data: bytes, rng: Generator) -> bytes:
    return data[: int(rng.integers(len(data)))]


def _without_middle(data: bytes, rng: Generator) -> bytes:
    start, end = sorted(rng.integers(len(data), size=2))
    return data[:start] + data[end:]


def _zeroed(data: bytes, rng: Generator) -> bytes:
    start = int(rng.integers(len(data)))
    end = min(start + int(rng.integers(1, 200)), len(data))
    return data[:start] + bytes(end - start) + data[end:]


def _doubled(data: bytes, rng: Generator) -> bytes:
    start, end = sorted(rng.integers(len(data), size=2))
    return data[:end] + data[start:]


def _random_bytes(data: bytes, rng: Generator) -> bytes:
    return rng.bytes(int(rng.integers(2000)))


def _random_tail(data: bytes, rng: Generator) -> bytes:
    return data + rng.bytes(int(rng.integers(1, 300)))


def _random_start(data: bytes, rng: Generator) -> bytes:
    return rng.bytes(int(rng.integers(1, 300))) + data


def _field(mark: bytes, offset: int, form: str, values: list[int]) -> Damage:
    """Another value in a field of one header of the zip archive."""

    def change(data: bytes, rng: Generator) -> bytes:
        positions = _positions(data, mark)
        at = positions[int(rng.integers(len(positions)))] + offset
        changed = bytearray(data)
        struct.pack_into(form, changed, at, values[int(rng.integers(len(values)))])
        return bytes(changed)

    return change


def _positions(data: bytes, mark: bytes) -> list[int]:
    positions, at = [], data.find(mark)
    while at >= 0:
        positions.append(at)
        at = data.find(mark, at + 1)
    return positions


_SIZES = [0, 1, 100, 2**20, 2**31 - 1, 2**31, 2**32 - 2, 2**32 - 1]
_FLAGS = [1, 0x20, 0x40, 0x61, 0x800, 0x2000, 0xFFFF, 8]
_METHODS = [0, 1, 8, 9, 12, 14, 93, 98, 99, 0xFFFF]
BYTE_DAMAGES: dict[str, Damage] = {
    "flipped bits": _flipped,
    "flipped bits of headers": _flipped_structure,
    "truncated": _cut,
    "a part removed": _without_middle,
    "zeros": _zeroed,
    "a part doubled": _doubled,
    "random bytes": _random_bytes,
    "bytes after the end": _random_tail,
    "bytes before the start": _random_start,
    "flags in the directory": _field(_CENTRAL, 8, "<H", _FLAGS),
    "flags of an entry": _field(_LOCAL, 6, "<H", _FLAGS),
    "compression in the directory": _field(_CENTRAL, 10, "<H", _METHODS),
    "compression of an entry": _field(_LOCAL, 8, "<H", _METHODS),
    "checksum": _field(_CENTRAL, 16, "<I", _SIZES),
    "compressed size": _field(_CENTRAL, 20, "<I", _SIZES),
    "size": _field(_CENTRAL, 24, "<I", _SIZES),
    "length of a name": _field(_CENTRAL, 28, "<H", [0, 1, 7, 2**16 - 1]),
    "length of a comment": _field(_CENTRAL, 32, "<H", [1, 7, 2**16 - 1]),
    "place of an entry": _field(_CENTRAL, 42, "<I", _SIZES),
    "number of entries": _field(_END, 10, "<H", [0, 1, 100, 2**16 - 1]),
    "size of the directory": _field(_END, 12, "<I", _SIZES),
    "place of the directory": _field(_END, 16, "<I", _SIZES),
}

# --- files with right checksums and wrong content ---


def _entry(name: str, content: bytes, method: int = zipfile.ZIP_DEFLATED) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", method) as archive:
        archive.writestr(name, content)
    return stream.getvalue()


def _with_entries(arrays: Mapping[str, np.ndarray], raw: Mapping[str, bytes], method: int) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", method) as archive:
        for name, array in arrays.items():
            content = io.BytesIO()
            np.lib.format.write_array(content, array, allow_pickle=True)
            archive.writestr(f"{name}.npy", content.getvalue())
        for name, content in raw.items():
            archive.writestr(f"{name}.npy", content)
    return stream.getvalue()


def _npy(header: str, content: bytes, version: int = 1, length: int | None = None) -> bytes:
    text = header.encode("latin1", "replace") + b"\n"
    size = len(text) if length is None else length
    return b"\x93NUMPY" + bytes([version, 0]) + struct.pack("<H" if version == 1 else "<I", size) + text + content


_HUGE = ["(2**50,)", f"({2**40},)", f"({2**62}, {2**62})", "(2, 51, 999999999999)", "(-1,)", "(0, -5)", "(True, 7)"]
_SHAPES = [*_HUGE, "(2.0, 51, 7)", "[2, 51, 7]", "7", "()", "(0, 51, 7)", "(2, 51, 7, 0)", "('a',)", f"({10**400},)"]
_TYPES = ["'|O'", "'|V8'", "'|S8'", "'<M8[s]'", "'<U1000000000'", "'<c16'", "'<f2'", "'>f8'", "'<f16'", "'|b1'",
          "'<u8'",
          "[('a', '<f8')]", "'<f8,<f8'", "'(1000000,)<f8'", "None", "'x'", "''", "'|O8'", "'<U0'"]  # fmt: skip
_HEADERS = ["", "{", "{}", "(" * 5000, "[" * 9000 + "]" * 9000, "{'descr': '<f8'}", "1", "__import__('os')", "\0" * 100,
            "{'descr': '<f8', 'fortran_order': 3, 'shape': (2, 51, 7)}", "9" * 5000, "-" * 4000 + "1"]  # fmt: skip


def _header_lies(arrays: dict[str, np.ndarray], rng: Generator) -> bytes:
    """One array whose header does not fit its content."""
    key = _pick(rng, list(arrays))
    shape, kind = repr(arrays[key].shape), repr(arrays[key].dtype.str)
    which = int(rng.integers(4))
    if which == 0:
        shape = _pick(rng, _SHAPES)
    elif which == 1:
        kind = _pick(rng, _TYPES)
    header = f"{{'descr': {kind}, 'fortran_order': {_pick(rng, ['False', 'True'])}, 'shape': {shape}, }}"
    header = _pick(rng, _HEADERS) if which == 2 else header
    length = _pick(rng, [None, 0, 1, 9999, 65535]) if which == 3 else None
    raw = {key: _npy(header, arrays[key].tobytes(), _pick(rng, [1, 2, 1, 1, 3, 9]), length)}
    others = {name: array for name, array in arrays.items() if name != key}
    return _with_entries(others, raw, _pick(rng, [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED]))


class _Marker:
    """Creates a file where it is unpickled."""

    def __reduce__(self) -> tuple[Any, ...]:
        return open, (_MARK, "w")


def _objects(arrays: dict[str, np.ndarray], rng: Generator) -> bytes:
    key = _pick(rng, list(arrays))
    if rng.integers(2):
        return _with_entries({**arrays, key: np.array([_Marker(), None], object)}, {}, zipfile.ZIP_STORED)
    others = {name: array for name, array in arrays.items() if name != key}
    return pickle.dumps(_Marker()) if rng.integers(2) else _with_entries(others, {key: pickle.dumps(_Marker())}, 0)


def _bomb(arrays: dict[str, np.ndarray], rng: Generator) -> bytes:
    """A large array of zeros in a small file."""
    key = _pick(rng, ["qpos", "qvel", "joint_names"])
    kind, size = _pick(rng, [("<f8", 8), ("|i1", 1), ("<U1", 4), ("<f2", 2)])
    # Some such files take a second to make, so that not all are made as large as their headers say.
    count = int(_pick(rng, [10**6, 10**7, 2 * 10**8, 2**34]))
    header = f"{{'descr': '{kind}', 'fortran_order': False, 'shape': ({count},), }}"
    raw = {key: _npy(header, bytes(min(count * size, 2 * 10**7)))}
    return _with_entries({name: a for name, a in arrays.items() if name != key}, raw, zipfile.ZIP_DEFLATED)


def _compressions(arrays: dict[str, np.ndarray], rng: Generator) -> bytes:
    return _with_entries(arrays, {}, _pick(rng, [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA]))


def _values(arrays: dict[str, np.ndarray], rng: Generator) -> bytes:
    key = _pick(rng, list(arrays))
    value = arrays[key]
    if value.dtype.kind == "U":
        odd = ["", "a\nb", "\x1b[2J", "\u2028", "x" * 100_000, "\ud800", "joint1", "{}", "[red]", "\x00"]
        changed = np.array(_pick(rng, odd) if value.ndim == 0 else [_pick(rng, odd) for _ in value])
    else:
        changed = np.array(value)
        odd_numbers = [np.nan, np.inf, -np.inf, 1e300, -1e30, 1e7, 0, -1, 1e-320, 2**62, 2.5]
        with np.errstate(all="ignore"):
            odd_number = np.array(_pick(rng, odd_numbers)).astype(value.dtype)
        changed[...] = odd_number if rng.integers(2) else changed
        if changed.size:
            changed.flat[int(rng.integers(changed.size))] = odd_number
    return _npz({**arrays, key: changed})


def _forms(arrays: dict[str, np.ndarray], rng: Generator) -> bytes:
    """One array of another type or shape, or none."""
    key = _pick(rng, list(arrays))
    value = arrays[key]
    changes: list[Callable[[], Any]] = [
        lambda: value.reshape(-1), lambda: value[None], lambda: np.array(value.tolist(), str), lambda: value.T,
        lambda: np.zeros(0), lambda: np.array("text"), lambda: np.zeros((0, 7)), lambda: np.zeros((2, 0, 7)),
        lambda: value.astype("f2"), lambda: value.astype(complex), lambda: value.astype("i8"), lambda: value == value,
        lambda: np.repeat(value, 3), lambda: np.array(value.tolist(), "S"), lambda: np.zeros(()),
        lambda: value.astype(">f4"),
    ]  # fmt: skip
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            changed = _pick(rng, changes)()
    except ValueError:
        changed = np.array([])
    kept = {name: array for name, array in arrays.items() if name != key}
    return _npz(kept if rng.integers(5) == 0 else {**kept, key: changed}, bool(rng.integers(2)))


def _many_entries(arrays: dict[str, np.ndarray], rng: Generator) -> bytes:
    count = int(_pick(rng, [100, 5000, 30_000]))
    stream = io.BytesIO(_npz(arrays))
    with zipfile.ZipFile(stream, "a") as archive:
        for number in range(count):
            archive.writestr(zipfile.ZipInfo(f"{number}.npy"), b"")
    return stream.getvalue()


def _twice(arrays: dict[str, np.ndarray], rng: Generator) -> bytes:
    stream = io.BytesIO(_npz(arrays))
    with warnings.catch_warnings(), zipfile.ZipFile(stream, "a") as archive:
        warnings.simplefilter("ignore")
        archive.writestr(f"{_pick(rng, list(arrays))}.npy", _npy("{'descr': '<f8'", b""))
    return stream.getvalue()


def _other_formats(arrays: dict[str, np.ndarray], rng: Generator) -> bytes:
    array = io.BytesIO()
    np.save(array, arrays["qpos"])
    formats = [
        array.getvalue(), array.getvalue()[:9], zlib.compress(b"a"), lzma.compress(b"a"), b"", b"PK", _END + bytes(18),
        _entry("qpos", b"text"), _entry("../../qpos.npy", b"text"), b"\x93NUMPY", _END + b"\xff" * 18, _END * 1000,
        b"PK\x06\x07" + bytes(16) + _END + bytes(18),
    ]  # fmt: skip
    return _pick(rng, formats)


CONTENT_DAMAGES: dict[str, Callable[[dict[str, np.ndarray], Generator], bytes]] = {
    "an array's header lies": _header_lies,
    "pickled objects": _objects,
    "a small file of many zeros": _bomb,
    "another compression": _compressions,
    "odd values": _values,
    "another type or shape": _forms,
    "many entries": _many_entries,
    "an entry twice": _twice,
    "another format": _other_formats,
}
NPZ_DAMAGES = (*BYTE_DAMAGES, *CONTENT_DAMAGES)
_RARE = ("a small file of many zeros", "many entries")  # which take a second each


def npz_case(number: int) -> Case:
    """Case number n: a damage by turns, of one of two formats."""
    rng = np.random.default_rng([SEED, number])
    name = NPZ_DAMAGES[number % len(NPZ_DAMAGES)]
    if name in _RARE and rng.integers(4):
        name = "an array's header lies"
    own = bool(rng.integers(2))

    def write(folder: Path) -> None:
        if name in BYTE_DAMAGES:
            data = BYTE_DAMAGES[name](_good(own, bool(rng.integers(2))), rng)
        else:
            data = CONTENT_DAMAGES[name](dict(_content(own)), rng)
        (folder / _FILE).write_bytes(data)

    def read(folder: Path) -> str:
        loaded = _read(folder / _FILE, own)
        if any(Path(place, _MARK).exists() for place in (folder, Path())):
            return OTHER_NUMBERS
        if not all(np.all(np.isfinite(array)) for array in loaded):
            return OTHER_NUMBERS
        same = len(loaded) == len(_expected(own)) and all(map(np.array_equal, loaded, _expected(own)))
        return ACCEPTED if same or name in CONTENT_DAMAGES else OTHER_NUMBERS

    return Case(name, write, read)


def _pick(rng: Generator, values: list[Any]) -> Any:
    return values[int(rng.integers(len(values)))]
