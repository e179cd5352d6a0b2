"""Serial arms as arrays of one shape: kinematics, metric and dynamics of any arm in one compiled function."""

from mimic.base import compat

compat.import_mujoco()
