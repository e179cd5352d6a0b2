"""Arms: embodiments, MJCF and URDF readers, and the models that simulate and draw an arm."""

from mimic.base import compat
from mimic.base.lazy import modules_of

compat.import_mujoco()
__getattr__ = modules_of(__name__, __path__)
