"""Readers of motion capture files, compared with readers of others on the same files: largest difference in metres.

    pip install c3d pybvh trc-data-reader
    python -m benchmarks.readers [--clips FILE.bvh ...] [--out FILE]

BVH is compared with pybvh, C3D with c3d, TRC with trc-data-reader. C3D files are written by ezc3d and by c3d, in
floating point and in integers; the others are those of the tests' generated person. `--clips` adds BVH files; a header
with a wrong number of frames, which pybvh rejects, is corrected before.
"""

import argparse
import re
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.common.parser import make_parser
from benchmarks.common.record import Row, print_table, write_results
from benchmarks.fuzzing.captures import bvh_bytes, c3d_bytes, trc_bytes
from mimic.motions.mocap.bvh import joint_positions, read_bvh
from mimic.motions.mocap.conventions import UNITS
from mimic.motions.mocap.reading import read_motion

LIMIT = 1e-6  # m
_RATE, _FRAMES = 100.0, 40


def bvh_row(path: Path, unit: float) -> Row:
    """The joints of a BVH file with lengths in a unit [m], against pybvh."""
    import pybvh  # pyright: ignore[reportMissingImports]

    ours = read_bvh(path)
    text = path.read_text()
    with tempfile.TemporaryDirectory() as folder:
        corrected = Path(folder) / path.name
        corrected.write_text(re.sub(r"Frames:\s*\d+", f"Frames: {len(ours.values)}", text))
        theirs = pybvh.read_bvh_file(corrected, warn_on_world_up_disagreement=False)
    positions, names = joint_positions(ours), [joint.name for joint in ours.joints]
    common = [name for name in theirs.joint_names if name in names]
    expected = theirs.joint_positions()
    pairs = [(positions[:, names.index(name)], expected[:, theirs.joint_index[name]]) for name in common]
    difference = max(float(np.abs(mine - other).max()) for mine, other in pairs) * unit
    return {"file": path.name, "reader": "pybvh", "points": len(common), "frames": len(positions), "m": difference}


def c3d_row(path: Path) -> Row:
    """The markers of a C3D file, which names the unit, against c3d."""
    import c3d  # pyright: ignore[reportMissingImports]

    ours = read_motion(path, up="z")
    with path.open("rb") as file:
        reader = c3d.Reader(file)
        labels = [label.strip() for label in reader.point_labels]
        unit = UNITS[reader.get("POINT:UNITS").string_value.strip()]
        frames = np.array(
            [np.where(points[:, 3:4] < 0, np.nan, points[:, :3]) for _, points, _ in reader.read_frames()]
        )
        rate = float(reader.point_rate)
    assert np.isclose(ours.rate, rate), f"rate: {ours.rate} and {rate}"
    return _row(path, "c3d", ours, labels, frames * unit)


def trc_row(path: Path) -> Row:
    """The markers of a TRC file, which names the unit, against trc-data-reader."""
    import trc  # pyright: ignore[reportMissingImports]

    ours, data = read_motion(path, up="z"), trc.TRCData()
    data.load(str(path))
    labels = list(data["Markers"])
    frames = np.array([data[label] for label in labels]).swapaxes(0, 1)
    return _row(path, "trc-data-reader", ours, labels, frames * UNITS[data["Units"]])


def _row(path: Path, reader: str, ours: Any, labels: list[str], expected: np.ndarray) -> Row:
    """Both as [time, points, 3] in metres; points that one reader has as missing must be so for the other."""
    assert set(ours.names) == set(labels), f"{ours.names} and {labels}"
    positions = ours.select(labels).positions
    missing = ~np.isfinite(positions).all(axis=2)
    assert np.array_equal(missing, ~np.isfinite(expected).all(axis=2)), "other points are missing"
    difference = float(np.abs(positions - expected)[~missing].max())
    return {"file": path.name, "reader": reader, "points": len(labels), "frames": len(positions), "m": difference}


def written_by_c3d(path: Path, scale: float) -> None:
    """A C3D file of the package c3d: integers for a scale above 0 [mm], floating point for one below."""
    import c3d  # pyright: ignore[reportMissingImports]

    random = np.random.default_rng(0)
    labels = ["LSHO", "LELB", "LWRA", "LFIN"]
    rest = np.array([[0, 0, 1400], [280, 0, 1400], [530, 0, 1400], [620, 0, 1400]])
    writer = c3d.Writer(point_rate=_RATE, point_scale=scale, point_units="mm  ")
    for frame in range(_FRAMES):
        points = np.zeros((len(labels), 5), np.float32)
        points[:, :3] = np.round(rest + random.normal(0, 5, rest.shape), 1)
        if frame in (5, 6):  # a marker that was not seen: zeros with a residual of -1
            points[1] = [0, 0, 0, -1, -1]
        writer.add_frames([(points, np.zeros((0, 0)))])
    writer.set_point_labels(labels)
    with path.open("wb") as file:
        writer.write(file)


def rows(folder: Path, clips: list[str]) -> Iterator[Row]:
    """A row for each file."""
    for name, content in (("person.bvh", bvh_bytes()), ("ezc3d.c3d", c3d_bytes()), ("person.trc", trc_bytes())):
        (folder / name).write_bytes(content)
    yield bvh_row(folder / "person.bvh", UNITS["cm"])
    for clip in map(Path, clips):
        unit = next(note.split()[1].strip(",") for note in read_motion(clip).notes if note.startswith("unit:"))
        yield bvh_row(clip, UNITS[unit])
    yield c3d_row(folder / "ezc3d.c3d")
    for name, scale in (("c3d_float.c3d", -1.0), ("c3d_integer.c3d", 0.1)):
        written_by_c3d(folder / name, scale)
        yield c3d_row(folder / name)
    yield trc_row(folder / "person.trc")


def main() -> None:
    parser = make_parser("readers", __doc__)
    parser.add_argument("--clips", nargs="*", default=[], metavar="FILE")
    options: argparse.Namespace = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        measured = list(rows(Path(folder), options.clips))
    write_results(options, files=measured)
    print_table(measured, "file reader points frames m:.2g")
    if max(row["m"] for row in measured) > LIMIT:
        raise SystemExit(f"error: expected differences of at most {LIMIT:g} m")


if __name__ == "__main__":
    main()
