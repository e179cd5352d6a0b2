"""Virtual robots: C MuJoCo at 1 kHz with loads, friction, noise, delays, and the reflexes with which a real robot aborts."""

from mimic import compat

compat.import_mujoco()
