"""Damaged motion capture files: BVH, C3D, TRC, CSV and npz of the tests' generated person.

A damage of bytes or words may leave a file that is valid and says something else, which is then read as it says. What
is accepted must be finite or missing, and in metres: the body must have the size that it had. Damages that only state
another unit, or scale all lengths from one unit to another, must leave the same positions.
"""

import functools
import importlib.util
import io
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.random import Generator

from benchmarks.fuzzing import ACCEPTED, OTHER_NUMBERS, Case
from benchmarks.fuzzing.npz import BYTE_DAMAGES
from mimic.commands.capture import body_lines, read_arm
from mimic.commands.config import CaptureConfig
from mimic.motions.mocap.conventions import UNITS
from mimic.motions.mocap.points import PointMotion
from mimic.motions.mocap.reading import read_motion
from tests.helpers.bodies import RATE, bvh_text, person

SEED = 27
_SAMPLES = 12
_MARKERS = {"LSHO": "LeftArm", "LELB": "LeftForeArm", "LWRA": "LeftHand", "LFIN": "LeftHandMiddle1",
            "RSHO": "RightArm", "RELB": "RightForeArm", "RWRA": "RightHand", "RFIN": "RightHandMiddle1",
            "HEAD": "Head", "LANK": "LeftFoot"}  # fmt: skip
_SIZE = 0.7, 1.4  # of the body relative to what it was; two units differ by a factor of 2.2 at least
_ODD = [
    *(["nan", "inf", "-1", "0", "1e308", "1e9", "a", "1,5", "0x10", "{", "}", "MOTION", "-", "é"]),
    "",
    "\x00",
    "1 2",
    "9" * 400,
]
Damage = Callable[[bytes, Generator], bytes]


def bvh_bytes(scale: float = 1.0) -> bytes:
    """The person, in centimetres times a scale."""
    return bvh_text(_SAMPLES, unit=0.01 / scale).encode()


def csv_bytes(scale: float = 1.0) -> bytes:
    body, stream = person(_SAMPLES), io.StringIO()
    header = ",".join(["time", *(f"{name}_{axis}" for name in body.names for axis in "xyz")])
    rows = np.column_stack([np.arange(_SAMPLES) / RATE, scale * body.positions.reshape(_SAMPLES, -1)])
    np.savetxt(stream, rows, "%.6f", delimiter=",", header=header, comments="")
    return stream.getvalue().encode()


def npz_bytes(scale: float = 1.0, unit: str = "") -> bytes:
    body, stream = person(_SAMPLES), io.BytesIO()
    arrays = {"names": np.array(body.names), "positions": scale * body.positions, "rate": np.array(RATE)}
    np.savez(stream, **arrays, **({"unit": np.array(unit)} if unit else {}))  # type: ignore[arg-type]
    return stream.getvalue()


def trc_bytes(scale: float = 1.0, unit: str = "mm") -> bytes:
    values = 1000 * scale * _markers()[..., [1, 2, 0]]  # y up
    lines = [
        "PathFileType\t4\t(X/Y/Z)\tclip.trc",
        "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames",
        f"{RATE}\t{RATE}\t{_SAMPLES}\t{len(_MARKERS)}\t{unit}\t{RATE}\t1\t{_SAMPLES}",
        "Frame#\tTime\t" + "\t\t\t".join(_MARKERS) + "\t\t",
        "\t\t" + "\t".join(f"X{i}\tY{i}\tZ{i}" for i in range(1, len(_MARKERS) + 1)),
    ]
    for sample, row in enumerate(values.reshape(_SAMPLES, -1)):
        lines.append("\t".join([str(sample + 1), f"{sample / RATE:.6f}", *(f"{value:.4f}" for value in row)]))
    return "\n".join(lines).encode()


def c3d_bytes(scale: float = 1.0, unit: str = "mm") -> bytes:
    import ezc3d

    points = np.ones((4, len(_MARKERS), _SAMPLES))
    points[:3] = np.moveaxis(1000 * scale * _markers(), -1, 0).swapaxes(1, 2)
    file = ezc3d.c3d()
    parameters = file["parameters"]["POINT"]
    for name, value in (("RATE", [RATE]), ("LABELS", list(_MARKERS)), ("UNITS", [unit])):
        parameters[name]["value"] = value
    file["data"]["points"] = points
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "clip.c3d"
        file.write(str(path))
        return path.read_bytes()


def _markers() -> np.ndarray:
    body = person(_SAMPLES)
    return np.stack([body.point(name) for name in _MARKERS.values()], axis=1)


WRITERS = {".bvh": bvh_bytes, ".csv": csv_bytes, ".npz": npz_bytes, ".trc": trc_bytes, ".c3d": c3d_bytes}
_TEXT, _WITH_UNIT = (".bvh", ".csv", ".trc"), (".npz", ".trc", ".c3d")


def _formats() -> list[str]:
    """The formats that are installed."""
    return [suffix for suffix in WRITERS if suffix != ".c3d" or importlib.util.find_spec("ezc3d")]


@functools.cache
def _good(suffix: str) -> bytes:
    return WRITERS[suffix]()


@functools.cache
def _expected(suffix: str) -> PointMotion:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"good{suffix}"
        path.write_bytes(_good(suffix))
        return read_motion(path)


# --- words and lines of a text file ---


def _odd_word(data: bytes, rng: Generator) -> bytes:
    words = data.decode().split(" ") if b"\t" not in data and b"," not in data else data.decode().split("\t")
    words = data.decode().split(",") if len(words) < 10 else words
    for _ in range(int(rng.integers(1, 4))):
        words[int(rng.integers(len(words)))] = _ODD[int(rng.integers(len(_ODD)))]
    separator = "," if b"," in data and b"\t" not in data else "\t" if b"\t" in data and b"ROOT" not in data else " "
    return separator.join(words).encode()


def _lines(change: Callable[[list[bytes], int, int], list[bytes]]) -> Damage:
    def damage(data: bytes, rng: Generator) -> bytes:
        lines = data.split(b"\n")
        first, second = sorted(rng.integers(len(lines), size=2))
        return b"\n".join(change(lines, int(first), int(second)))

    return damage


def _separators(data: bytes, rng: Generator) -> bytes:
    old, new = [(b",", b";"), (b"\t", b" "), (b".", b","), (b"\n", b"\r"), (b"\n", b"\r\n"), (b" ", b"  ")][
        int(rng.integers(6))
    ]
    return data.replace(old, new)


def _encodings(data: bytes, rng: Generator) -> bytes:
    encoding = ("utf-16", "utf-8-sig", "utf-32", "utf-7")[int(rng.integers(4))]
    return data.decode().encode(encoding)


WORD_DAMAGES: dict[str, Damage] = {
    "odd words": _odd_word,
    "a line removed": _lines(lambda lines, i, _: [*lines[:i], *lines[i + 1 :]]),
    "a line doubled": _lines(lambda lines, i, _: [*lines[:i], lines[i], *lines[i:]]),
    "two lines exchanged": _lines(
        lambda lines, i, j: [*lines[:i], lines[j], *lines[i + 1 : j], *([lines[i]] if j > i else []), *lines[j + 1 :]]
    ),
    "a line cut": _lines(lambda lines, i, _: [*lines[:i], lines[i][: len(lines[i]) // 2], *lines[i + 1 :]]),
    "other separators": _separators,
    "another encoding": _encodings,
}
BYTES = (
    *("flipped bits", "truncated", "a part removed", "zeros", "a part doubled", "random bytes"),
    *("bytes after the end", "bytes before the start"),
)
ANOTHER_UNIT, SCALED = "another unit is stated", "lengths in another unit"
CAPTURE_DAMAGES = (*BYTES, *WORD_DAMAGES, ANOTHER_UNIT, SCALED)


def _damaged(name: str, suffix: str, rng: Generator) -> bytes:
    if name == SCALED:
        ratio = float(rng.choice([1 / value for value in UNITS.values()])) / {".bvh": 100, ".csv": 1, ".npz": 1}[suffix]
        return WRITERS[suffix](ratio)
    if name == ANOTHER_UNIT:
        unit = str(rng.choice([*UNITS, "millimetres", "MM", "parsec", ""]))
        return npz_bytes(1.0, unit) if suffix == ".npz" else WRITERS[suffix](1.0, unit)  # type: ignore[call-arg]
    damages = WORD_DAMAGES if name in WORD_DAMAGES else BYTE_DAMAGES
    return damages[name](_good(suffix), rng)


def capture_case(number: int) -> Case:
    """Case number n: a damage by turns, of a format that it can have."""
    rng = np.random.default_rng([SEED, number])
    name = CAPTURE_DAMAGES[number % len(CAPTURE_DAMAGES)]
    possible = _TEXT if name in WORD_DAMAGES else _WITH_UNIT if name == ANOTHER_UNIT else tuple(WRITERS)
    possible = (".bvh", ".csv", ".npz") if name == SCALED else possible
    installed = [suffix for suffix in _formats() if suffix in possible]
    suffix = installed[number // len(CAPTURE_DAMAGES) % len(installed)]

    def write(folder: Path) -> None:
        (folder / f"clip{suffix}").write_bytes(_damaged(name, suffix, rng))

    def read(folder: Path) -> str:
        motion = read_motion(folder / f"clip{suffix}")
        body_lines(motion)
        same = _is_in_metres(motion, _expected(suffix))
        if name in (ANOTHER_UNIT, SCALED):
            same = same and np.allclose(motion.positions, _expected(suffix).positions, atol=1e-5, equal_nan=True)
        if not same:
            return OTHER_NUMBERS
        read_arm(folder / f"clip{suffix}", "left", CaptureConfig(), 0.25)
        return ACCEPTED

    return Case(f"{suffix[1:]}: {name}", write, read)


def _is_in_metres(motion: PointMotion, expected: PointMotion) -> bool:
    """Whether what is left of the body has its size, or too little is left to say so."""
    if np.any(np.isinf(motion.positions)):
        return False
    common = [name for name in motion.names if name in expected.names]
    if len(common) < len(expected.names) // 2:
        return True
    sizes = [
        np.linalg.norm(body.select(common).positions - body.positions[:, :1].mean(axis=0), axis=2)
        for body in (motion, expected)
    ]
    known = [size[np.isfinite(size)] for size in sizes]
    if min(map(len, known)) == 0:
        return True
    ratio = float(np.median(known[0]) / np.median(known[1]))
    return _SIZE[0] <= ratio <= _SIZE[1]
