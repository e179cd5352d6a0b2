"""Figures of the paper, computed and drawn by the code."""
