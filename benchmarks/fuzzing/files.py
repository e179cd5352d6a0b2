"""Damaged and hostile files: demonstrations (npz) and arms (MJCF and URDF)."""

from benchmarks.fuzzing import Case
from benchmarks.fuzzing.models import MODEL_DAMAGES, model_case
from benchmarks.fuzzing.npz import NPZ_DAMAGES, npz_case

__all__ = ["MODEL_DAMAGES", "NPZ_DAMAGES", "Case", "model_case", "npz_case"]
