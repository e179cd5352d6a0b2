"""Sweeps: many runs of one command line, and their launchers."""
