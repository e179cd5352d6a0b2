"""Environments of a robot as it is: an inner loop at 1 kHz, gravity, friction, payload, sensors and delays."""

from mimic.base import compat

compat.import_mujoco()
