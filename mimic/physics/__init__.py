"""Equations of motion, the inner loop at 1 kHz and its plant, and their kernels."""

from mimic.base import compat

compat.import_mujoco()
