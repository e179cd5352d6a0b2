"""The commands: mimic/NAME.py starts mimic/commands/NAME.py."""

from mimic.base import compat

compat.import_mujoco()
