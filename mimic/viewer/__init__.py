"""The live view in the browser."""

from mimic import compat

compat.import_mujoco()
