"""Paths of the repository, and how tests and the processes that they start compile."""

import contextlib
import os
import pathlib

REPOSITORY = pathlib.Path(__file__).resolve().parents[2]
# Outside of the checkout, so that a fresh clone finds what an older one compiled.
CACHE = pathlib.Path(os.environ.get("JAX_COMPILATION_CACHE_DIR") or "~/.cache/mimic/tests").expanduser()
CACHED = {  # environment variables of processes with the user's home: mimic's own cache is kept out of it
    "HOME": str(CACHE / "home"),
    "JAX_PLATFORMS": "cpu",
}
# Nine tenths of a quick test are compilation: without LLVM's optimisation the suite takes half of the time.
_FLAG = "xla_backend_optimization_level"


def share_compilations() -> None:
    """Sets the variables with which JAX compiles quickly and into one cache, here and in the processes of tests.

    Small functions are cached too: there are thousands. Must run before JAX starts its backend.
    """
    flags = os.environ.get("XLA_FLAGS", "")
    if _FLAG not in flags:
        os.environ["XLA_FLAGS"] = f"{flags} --{_FLAG}=0".strip()
    with contextlib.suppress(OSError):  # JAX warns and does without
        pathlib.Path(CACHED["HOME"]).mkdir(parents=True, exist_ok=True)
    os.environ["JAX_COMPILATION_CACHE_DIR"] = str(CACHE)
    os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0"
    # A fifth of a test's time: the source lines of each operation, which only profiles and XLA's messages show.
    os.environ["JAX_TRACEBACK_IN_LOCATIONS_LIMIT"] = "0"
