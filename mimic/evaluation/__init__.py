"""Evaluation of controllers on demonstrations: rollouts, metrics, other controllers, plots."""

from mimic.base import compat

compat.import_mujoco()
