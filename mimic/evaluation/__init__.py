"""Evaluation of controllers on demonstrations: rollouts, metrics, other controllers, plots."""
