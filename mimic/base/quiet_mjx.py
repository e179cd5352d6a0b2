"""Imports MJX without a word. Modules that import brax, which imports MJX too, import this one before it."""

from mimic.base import compat

compat.import_mjx()
