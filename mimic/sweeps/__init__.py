"""Sweeps: many runs of one command line, and what they come to together."""
