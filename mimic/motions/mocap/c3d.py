"""Reads markers of C3D files by ezc3d, of the extra `mocap`, in a process of its own: damaged files can crash it.

That process runs this file: it must import nothing of mimic at its start.
"""

import importlib.util
import struct
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mimic.motions.mocap.tables import Table

_OUTPUTS = ("ANGLES", "FORCES", "MOMENTS", "POWERS", "SCALARS")  # of models, which are no markers
_BLOCK, _BIG_ENDIAN, _LAST_FRAME = 512, b"\x56", 2**16 - 1  # bytes; code of the processor; also that of longer files
_SECONDS, _MEMORY = 60, 4 * 2**30  # an hour of 100 markers at 100 Hz takes some seconds


def read_c3d(path: Path) -> "Table":
    """Markers of a C3D file; those without a label, and outputs of models, are left out.

    Raises:
      ValueError: ezc3d is not installed, or it cannot read the file.
    """
    from mimic.base.files import check_file, read_bytes
    from mimic.base.limited_process import call_limited
    from mimic.motions.mocap.tables import frames_note, read_npz

    if importlib.util.find_spec("ezc3d") is None:
        raise ValueError("C3D files need the package ezc3d: install mimic with the extra [mocap]")
    source = str(check_file(path).absolute())
    with tempfile.TemporaryDirectory(prefix="mimic-c3d-") as folder:
        points = Path(folder) / "points.npz"
        try:
            limits = {"seconds": _SECONDS, "memory": _MEMORY}
            call_limited(__file__, "write_points", source, str(points), library="ezc3d", what="the file", **limits)
        except ValueError as error:
            raise ValueError(f"ezc3d cannot read it: {error!s:.150}") from error
        table = read_npz(points)
    stated = _stated_frames(read_bytes(path))
    return table._replace(notes=(*table.notes, *frames_note(stated or len(table.time), len(table.time))))


def _stated_frames(content: bytes) -> int:
    """The number of frames in the header; 0 where it is too large for it. ezc3d reads a file that is cut off."""
    processor = (content[0] - 1) * _BLOCK + 3  # place of its code
    order = ">" if content[processor : processor + 1] == _BIG_ENDIAN else "<"
    first, last = struct.unpack(f"{order}HH", content[6:10])
    return last - first + 1 if first <= last < _LAST_FRAME else 0


def write_points(source: str, points: str) -> None:
    """What `read_c3d` runs in a process: writes the npz file that `read_npz` expects."""
    import ezc3d
    import numpy as np

    np.savez(points, **_arrays(ezc3d.c3d(source)))


def _arrays(content: Any) -> dict[str, Any]:
    import numpy as np

    points, parameters = content["data"]["points"], content["parameters"]["POINT"]

    def values(name: str) -> list[Any]:
        """Values of a parameter, which goes on in others with a number where it has more than 255."""
        names = [name, *(f"{name}{number}" for number in range(2, 100))]
        return [value for name in names if name in parameters for value in parameters[name]["value"]]

    outputs = {str(label) for group in _OUTPUTS for label in values(group)}
    labels = [str(label) for label in values("LABELS")][: points.shape[1]]
    own = [label.split(":")[-1].strip() for label in labels]  # without the subject
    named = [
        i for i, name in enumerate(own) if name and not name.startswith("*") and labels[i] not in outputs
    ]  # * unknown
    names, short = ([texts[i].strip() for i in named] for texts in (labels, own))
    arrays = {
        "names": np.array(short if len(set(short)) == len(short) else names, dtype=str),  # of one subject
        "positions": np.moveaxis(points[:3, named], 0, -1).swapaxes(0, 1).astype(float),
        "rate": np.array(float(values("RATE")[0])),
    }
    # The screen's y-axis is the vertical; its sign is no use, since Qualisys writes -Z where z points up.
    for key, name in (("unit", "UNITS"), ("up", "Y_SCREEN")):
        if values(name):
            arrays[key] = np.array(str(values(name)[0]).lstrip("+-").lower())
    return arrays
