"""The live view in the browser."""

from mimic.base import compat

compat.import_mujoco()
