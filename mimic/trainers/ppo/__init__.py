"""PPO on an imitation environment."""

from mimic import compat

compat.import_mujoco()
