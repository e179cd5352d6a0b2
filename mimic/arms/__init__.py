"""Arms: embodiments, MJCF and URDF readers, and the models that simulate and draw an arm."""

from mimic.base import compat

compat.import_mujoco()
