"""Environments of a robot as it is: an inner loop at 1 kHz, gravity, friction, payload, sensors and delays."""

from mimic import compat

compat.import_mujoco()
