"""PPO on an imitation environment."""

from mimic.base import compat

compat.import_mujoco()
