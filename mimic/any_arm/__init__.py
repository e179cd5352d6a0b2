"""Serial arms as arrays of one shape: kinematics, metric and dynamics of any arm in one compiled function."""

from mimic import compat

compat.import_mujoco()
