"""A function to export, with what its inputs and outputs mean."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import jax

from mimic.arms.embodiment import Embodiment


@dataclasses.dataclass(frozen=True)
class ExportedFunction:
    """A function to export.

    Attributes:
      function: maps one float32 vector for each input to the named output vectors.
      kind: "policy" or "pose_mapper".
      inputs: length of each input by its name.
      metadata: meaning and units of inputs and outputs.
    """

    function: Callable[..., dict[str, jax.Array]]
    kind: str
    inputs: dict[str, int]
    metadata: dict[str, Any]


def joint_ranges(arm: Embodiment) -> Sequence[Sequence[float]]:
    """Minimum and maximum angle of each joint [rad], for metadata."""
    return [[float(bound) for bound in bounds] for bounds in arm.joint_range]
