"""Reads markers of C3D files by ezc3d, of the extra `mocap`, in a process of its own: damaged files can crash it.

`python -I c3d.py` reads a request from its input and writes an npz file: this module must import nothing of mimic when
it runs, whose import takes seconds.
"""

import contextlib
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mimic.motions.mocap.tables import Table

_CPU_SECONDS, _WALL_SECONDS = 60, 90  # an hour of 100 markers at 100 Hz takes some seconds
_MEMORY = 4 * 2**30  # bytes of address space
_FAILED = 3  # exit code after an error with a line


def read_c3d(path: Path) -> "Table":
    """Markers of a C3D file; those without a label are left out.

    Raises:
      ValueError: ezc3d is not installed, or it cannot read the file.
    """
    from mimic.base.files import check_file
    from mimic.motions.mocap.tables import read_npz

    with tempfile.TemporaryDirectory(prefix="mimic-c3d-") as folder:
        out = Path(folder) / "points.npz"
        request = json.dumps({"file": str(check_file(path).absolute()), "out": str(out), "path": sys.path})
        try:
            done = subprocess.run(
                [sys.executable, "-I", __file__], input=request, capture_output=True, text=True, timeout=_WALL_SECONDS
            )
        except subprocess.TimeoutExpired as error:
            raise ValueError(f"ezc3d takes more than {_WALL_SECONDS} s to read it") from error
        if done.returncode == _FAILED:
            raise ValueError(done.stdout.strip())
        if done.returncode or not out.is_file():
            raise ValueError("ezc3d cannot read it: it is damaged or too large")
        return read_npz(out)


def main() -> None:
    """Answers the request in the input."""
    request = json.loads(sys.stdin.read())
    sys.path[:] = request["path"]
    try:
        import ezc3d
    except ImportError:
        _fail("C3D files need the package ezc3d: install mimic with the extra [mocap]")
    import numpy as np

    _limit()
    try:
        content = ezc3d.c3d(request["file"])
        np.savez(request["out"], **_arrays(content))
    except Exception as error:  # of the library, for damaged files
        _fail(f"ezc3d cannot read it: {' '.join(str(error).split())[:150]}")
    os._exit(0)


def _arrays(content: Any) -> dict[str, Any]:
    """The arrays that `read_npz` expects."""
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


def _limit() -> None:
    try:
        import resource
    except ImportError:  # not on this system, where the limit on wall time remains
        return
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    resource.setrlimit(resource.RLIMIT_CPU, (_CPU_SECONDS, _CPU_SECONDS + 1))
    with contextlib.suppress(ValueError, OSError):  # macOS has no such limit
        resource.setrlimit(resource.RLIMIT_AS, (_MEMORY, _MEMORY))


def _fail(message: str) -> None:
    print(message, flush=True)
    os._exit(_FAILED)


if __name__ == "__main__":
    main()
