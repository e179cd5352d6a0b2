"""Reads markers of C3D files by ezc3d, of the extra `mocap`, in a process of its own: damaged files can crash it.

That process runs this file: it must import nothing of mimic at its start.
"""

import importlib.util
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mimic.motions.mocap.tables import Table

_SECONDS, _MEMORY = 60, 4 * 2**30  # an hour of 100 markers at 100 Hz takes some seconds


def read_c3d(path: Path) -> "Table":
    """Markers of a C3D file; those without a label are left out.

    Raises:
      ValueError: ezc3d is not installed, or it cannot read the file.
    """
    from mimic.base.files import check_file
    from mimic.base.limited_process import call_limited
    from mimic.motions.mocap.tables import read_npz

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
        return read_npz(points)


def write_points(source: str, points: str) -> None:
    """What `read_c3d` runs in a process: writes the npz file that `read_npz` expects."""
    import ezc3d
    import numpy as np

    np.savez(points, **_arrays(ezc3d.c3d(source)))


def _arrays(content: Any) -> dict[str, Any]:
    import numpy as np

    points, parameters = content["data"]["points"], content["parameters"]["POINT"]
    labels = [str(label).split(":")[-1].strip() for label in parameters["LABELS"]["value"]][: points.shape[1]]
    named = [i for i, label in enumerate(labels) if label and not label.startswith("*")]  # * is what was not identified
    arrays = {
        "names": np.array([labels[i] for i in named], dtype=str),
        "positions": np.moveaxis(points[:3, named], 0, -1).swapaxes(0, 1).astype(float),
        "rate": np.array(float(parameters["RATE"]["value"][0])),
    }
    units = parameters["UNITS"]["value"] if "UNITS" in parameters else []
    return {**arrays, "unit": np.array(str(units[0]))} if units else arrays
