"""Paths of the repository, and the compilation cache of the processes that tests start."""

import pathlib

REPOSITORY = pathlib.Path(__file__).resolve().parents[2]
SLOW_PARAMETERS = REPOSITORY / "tests" / "slow_parameters.txt"  # one test with its parameter on each line
CACHE = REPOSITORY / ".jax_cache"
CACHED = {  # environment variables of processes that compile: one compilation cache for all tests
    "HOME": str(CACHE),  # the default place of mimic's own
    "JAX_PLATFORMS": "cpu",
    "JAX_COMPILATION_CACHE_DIR": str(CACHE),
    "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0.3",
}
