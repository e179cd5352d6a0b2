"""Retargeting of poses and motions from one arm to another: by optimisation, in closed form, and by baselines."""

from mimic.base import compat
from mimic.base.lazy import modules_of

compat.import_mujoco()
__getattr__ = modules_of(__name__, __path__)
