"""The folder of a trained network: the config and the report of its run, and the parameters in one npz file."""

import dataclasses
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from mimic.runs.files import write_report
from mimic.runs.parameters import PARAMETERS, named_leaves
from mimic.trainers.config import TrainConfig
from mimic.trainers.run_config import save_config

SOURCE = "source"  # key of the report: command and commit that trained the network


def write_network(
    folder: Path, config: TrainConfig, params: Any, report: Mapping[str, Any], *, half: bool = False
) -> None:
    """Writes the folder of a trained network; files that exist are replaced.

    Args:
      folder: the folder, created if needed.
      config: config of the run, with all values resolved.
      params: the parameters, a pytree of arrays.
      report: report of these parameters, with the key "source".
      half: whether matrices are stored as float16, and so rounded to 11 bits.
    """
    folder.mkdir(parents=True, exist_ok=True)
    partial = folder / (PARAMETERS + ".partial")
    with partial.open("wb") as file:
        np.savez_compressed(file, **_stored(params, half))  # type: ignore[arg-type] - names of arrays, none a flag
    save_config(folder, dataclasses.replace(config, run_dir="", resume="", init=""))
    os.replace(partial, folder / PARAMETERS)
    write_report(folder, report)


def _stored(params: Any, half: bool) -> dict[str, np.ndarray]:
    """The arrays by name. Vectors keep their type: they are small, and some counts do not fit float16."""
    arrays = {name: np.asarray(leaf) for name, leaf in named_leaves(params).items()}
    return {name: array.astype(np.float16) if half and array.ndim > 1 else array for name, array in arrays.items()}
