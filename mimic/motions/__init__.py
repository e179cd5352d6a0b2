"""Motions: demonstrations, their recording and import, files of others, motion capture."""

from mimic.base import compat

compat.import_mujoco()
