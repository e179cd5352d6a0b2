"""Config of an export."""

import dataclasses

from mimic.base.config import check_choice
from mimic.base.ranges import check_ranges, checkpoint_number

CONTROLLER = "controller"  # a format of a folder, see mimic/trainers/export/export_controller.py
EXPORT_FORMATS = ("onnx", CONTROLLER)


@dataclasses.dataclass(frozen=True)
class ExportConfig:
    """Config of an export of a trained policy or pose mapper to a file.

    Attributes:
      run: run directory, or the environment of a policy that comes with mimic.
      out: exported file, or folder of a controller; must not exist.
      format: "onnx", or "controller": a policy with an inner loop and what a robot needs beside it.
      checkpoint: steps of the checkpoint. Default None: the last checkpoint.
    """

    run: str = ""
    out: str = ""
    format: str = "onnx"
    checkpoint: int | None = checkpoint_number()

    def __post_init__(self) -> None:
        check_ranges(self)
        check_choice("format", self.format, EXPORT_FORMATS)
