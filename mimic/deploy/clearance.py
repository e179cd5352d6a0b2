"""The clearance of the arm of a bundle."""

import numpy as np

from mimic.control.clearance import clearance
from mimic.deploy.bundle import Bundle


class Clearance:
    """The clearance [m] of the arm of a bundle in poses [rows, joints] [rad]; NaN where an angle is not finite."""

    def __init__(self, bundle: Bundle):
        self._constants = bundle.clearance

    def __call__(self, qpos: np.ndarray) -> np.ndarray:
        """The clearances [rows]."""
        with np.errstate(invalid="ignore"):
            return clearance(np.ascontiguousarray(qpos, np.float32), self._constants)
