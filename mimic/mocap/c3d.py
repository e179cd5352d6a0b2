"""Reads markers of C3D files by ezc3d, of the extra `mocap`."""

from pathlib import Path

import numpy as np

from mimic.mocap.tables import Table, checked


def read_c3d(path: Path) -> Table:
    """Markers of a C3D file.

    Raises:
      ValueError: ezc3d is not installed, or it cannot read the file.
    """
    try:
        import ezc3d
    except ImportError as error:
        raise ValueError("C3D files need the package ezc3d: install mimic with the extra [mocap]") from error
    try:
        content = ezc3d.c3d(str(path))
        points, parameters = content["data"]["points"], content["parameters"]["POINT"]
        labels = [str(label).split(":")[-1].strip() for label in parameters["LABELS"]["value"]]
        rate = float(parameters["RATE"]["value"][0])
        unit = str(parameters["UNITS"]["value"][0]) if parameters.get("UNITS", {}).get("value") else None
    except Exception as error:  # of the library, for damaged files
        raise ValueError(f"ezc3d cannot read it: {' '.join(str(error).split())[:150]}") from error
    count = min(len(labels), points.shape[1])
    chosen = [i for i in range(count) if labels[i] and not labels[i].startswith("*")]  # unlabelled trajectories
    positions = np.moveaxis(points[:3, chosen], 0, -1).swapaxes(0, 1).astype(float)
    if not 0.1 <= rate <= 1e5:
        raise ValueError(f"RATE: expected samples per second from 0.1 to 1e5, got {rate:g}")
    names = tuple(labels[i] for i in chosen)
    return checked(Table(names, positions, np.arange(len(positions)) / rate, unit=unit))
