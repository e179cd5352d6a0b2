"""Serial arms as arrays of one shape: kinematics, metric and dynamics of any arm in one compiled function."""
