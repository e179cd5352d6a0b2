"""The metric between embodiments: link states, distances, correspondences, similarity, and fast kernels."""

from mimic.base.lazy import modules_of

__getattr__ = modules_of(__name__, __path__)
