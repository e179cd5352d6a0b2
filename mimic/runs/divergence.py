"""Divergence of a training: a number that is not finite."""

from collections.abc import Mapping
from typing import Any

import jax
import numpy as np

EXIT_CODE = 3


class Diverged(Exception):
    """A training epoch had a result that is not finite.

    Attributes:
      step: training steps after that epoch.
    """

    def __init__(self, step: int, what: str):
        super().__init__(f"training diverged: {what} is not finite after {step} steps")
        self.step = step


def check_finite(step: int, metrics: Mapping[str, float], params: Any) -> None:
    """Raises `Diverged` where a training metric or a parameter is not finite.

    Args:
      step: training steps so far.
      metrics: of the training epoch.
      params: pytree of arrays on the host.
    """
    for name, value in metrics.items():
        if not np.isfinite(value):
            raise Diverged(step, name)
    for path, leaf in jax.tree_util.tree_leaves_with_path(params):
        if not np.isfinite(leaf).all():
            raise Diverged(step, f"parameter {jax.tree_util.keystr(path, simple=True, separator='.')}")
