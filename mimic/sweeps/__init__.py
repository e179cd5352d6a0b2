"""Sweeps: many runs of one command line, their launchers, and the collection of their results."""
