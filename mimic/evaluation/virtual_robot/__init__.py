"""Virtual robots: C MuJoCo at 1 kHz with loads, friction, noise, delays, and reflexes that abort as real ones do."""

from mimic.base import compat

compat.import_mujoco()
