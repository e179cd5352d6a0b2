"""Config of an export."""

import dataclasses
from typing import Any

from mimic.base.config import check_choice
from mimic.base.ranges import check_ranges, checkpoint_number

CONTROLLER = "controller"  # a format of a folder, see mimic/trainers/export/export_controller.py
EXPORT_FORMATS = ("onnx", CONTROLLER)


def check_locked(locked: list[Any], learner: str) -> None:
    """Raises a `ValueError` for locked joints without the arm that they belong to."""
    if locked and not learner:
        raise ValueError(f"locked: expected with learner=NAME, as in learner=panda locked=[2,4], got {locked}")


@dataclasses.dataclass(frozen=True)
class ExportConfig:
    """Config of an export of a trained policy or pose mapper to a file.

    Attributes:
      run: run directory.
      out: exported file, or folder of a controller; must not exist.
      format: "onnx", or "controller": a policy with an inner loop and what a robot needs beside it.
      learner: of a mapper to any arm, the arm that it maps to. Default "": that of its environment.
      locked: numbers or names of the joints of this arm that are locked.
      checkpoint: steps of the checkpoint. Default None: the last checkpoint.
    """

    run: str = ""
    out: str = ""
    format: str = "onnx"
    learner: str = ""
    locked: list[Any] = dataclasses.field(default_factory=list)
    checkpoint: int | None = checkpoint_number()

    def __post_init__(self) -> None:
        check_ranges(self)
        check_choice("format", self.format, EXPORT_FORMATS)
        check_locked(self.locked, self.learner)
