"""Retargeting of poses and motions from one arm to another: by optimisation, in closed form, and by baselines."""

from mimic.base import compat

compat.import_mujoco()
