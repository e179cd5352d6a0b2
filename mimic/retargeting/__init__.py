"""Poses and motions of one arm that resemble those of another, by optimisation, in closed form, and by baselines."""
