"""What other packages' versions make necessary; everything of this kind is here."""

import contextlib
import importlib
import importlib.metadata
import importlib.util
import io
import logging
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

_log = logging.getLogger(__name__)
_BRAX_AXIS_NAME = "i"  # brax.training.agents.ppo.train
_SLOW_CPU_FLAG = "--xla_cpu_use_fusion_emitters=false"


def needs_cpu_flag(jaxlib_version: str | None = None) -> bool:
    """Whether XLA's CPU backend needs its fusion emitters turned off.

    Before jaxlib 0.11 they make batched kinematics several hundred times slower; from 0.11 on the flag is unknown to
    XLA, which aborts on it.
    """
    version = jaxlib_version or importlib.metadata.version("jaxlib")
    major, minor = (int(part) for part in version.split(".")[:2])
    return (major, minor) < (0, 11)


def prepare_cpu() -> None:
    """Sets that flag where it is needed; must run before JAX starts its backend."""
    flags = os.environ.get("XLA_FLAGS", "")
    if not needs_cpu_flag() or "xla_cpu_use_fusion_emitters" in flags:
        return
    bridge = sys.modules.get("jax._src.xla_bridge")
    if bridge is not None and bridge.backends_are_initialized():
        _log.warning("JAX was started before mimic was imported: on a CPU import mimic first, or set XLA_FLAGS=%s; "
                     "without it kinematics run several hundred times slower", _SLOW_CPU_FLAG)  # fmt: skip
        return
    os.environ["XLA_FLAGS"] = f"{flags} {_SLOW_CPU_FLAG}".strip()


def import_mujoco() -> None:
    """Imports MuJoCo also where the graphics library that MUJOCO_GL names is missing: who draws is told so then."""
    asked_for = os.environ.get("MUJOCO_GL", "")
    try:
        importlib.import_module("mujoco")
    except (AttributeError, OSError):  # of PyOpenGL and ctypes, while they look for the library
        os.environ["MUJOCO_GL"] = "disabled"
        try:
            package = importlib.import_module("mujoco")
        finally:
            os.environ["MUJOCO_GL"] = asked_for
        for name, part in list(sys.modules.items()):  # what was imported before it failed belonged to the first try
            if name.startswith("mujoco.") and name.count(".") == 1:
                setattr(package, name.partition(".")[2], part)


def import_mjx() -> None:
    """Imports MJX without its two lines about Warp, an optional backend that mimic does not use.

    MJX's meshes and brax's solver of contacts wait until something asks for them: arms have no use for them, and
    trimesh, jaxopt and SciPy would take half of the time.
    """
    for name in ("mujoco.mjx._src.mesh", "jaxopt"):
        if name not in sys.modules:
            _import_later(name)
    with contextlib.redirect_stdout(io.StringIO()):
        importlib.import_module("mujoco.mjx")


def _import_later(name: str) -> None:
    """Lets a module run when something of it is first used, not when it is imported; if there is such a one."""
    package, *path = name.split(".")
    spec = importlib.util.find_spec(package)
    if spec and path:  # found without its parents, which would import it
        file = Path((spec.submodule_search_locations or [""])[0], *path).with_suffix(".py")
        spec = importlib.util.spec_from_file_location(name, file) if file.is_file() else None
    if spec is None or spec.loader is None:
        return
    module, execute = importlib.util.module_from_spec(spec), spec.loader.exec_module

    def load(attribute: str) -> Any:  # PEP 562: what is asked for and is not there
        del module.__getattr__
        execute(module)
        return getattr(module, attribute)

    module.__getattr__ = load  # type: ignore[method-assign]
    sys.modules[name] = module


def import_tensorboard() -> Any:
    """Imports tensorboardX, but not torch with it: where that is installed it takes seconds, for a type's name."""
    if "torch" not in sys.modules:
        sys.modules["torch"] = None  # type: ignore[assignment]  # an import fails, as where it is not installed
    try:
        return importlib.import_module("tensorboardX")
    finally:
        if sys.modules["torch"] is None:
            del sys.modules["torch"]


def share_config_store() -> None:
    """Hydra copies all registered configs for each group that it lists: half of the time that `--help` takes.

    It need not, as it copies a config besides whenever it loads one.
    """
    from hydra.core.config_store import ConfigStore

    ConfigStore.__deepcopy__ = lambda self, memo: self  # type: ignore[attr-defined]


def computed_once(scalars: list[Any]) -> list[Any]:
    """The scalars, to be computed before they are stacked where XLA would else compute each of them from scratch.

    On GPUs XLA may fuse a concatenation with all that leads to it, one copy of the chain for each row: small batches of
    a 7-link arm then take a minute to compile. On CPUs it does not, and the barrier would cost time.
    """
    import jax

    return scalars if jax.default_backend() == "cpu" else jax.lax.optimization_barrier(scalars)


def device_put_replicated(tree: Any, devices: Sequence[Any]) -> Any:
    """Copies of a pytree on all devices, along a new first axis.

    JAX removed its function of this name in 0.10, and brax 0.14 still calls it. This one replicates through `jax.pmap`,
    with brax's own name for the axis, so that the result is sharded just as what brax's training epoch returns: the
    epoch is then compiled once and not twice.
    """
    import jax

    replicate = jax.pmap(lambda _, x: x, axis_name=_BRAX_AXIS_NAME, in_axes=(0, None), devices=list(devices))
    return replicate(jax.numpy.arange(len(devices)), tree)


def coordination_client() -> Any:
    """What the processes of `jax.distributed` tell each other through; JAX has no public name for it."""
    from jax._src import distributed

    return distributed.global_state.client


def process_number() -> int:
    """Of this process in `jax.distributed`, without starting the backend as `jax.process_index` would."""
    from jax._src import distributed

    return distributed.global_state.process_id


def mend_brax() -> None:
    """Gives brax's training loop the function that it calls and JAX no longer has."""
    import jax

    if not hasattr(jax, "device_put_replicated"):
        jax.device_put_replicated = device_put_replicated  # type: ignore[attr-defined]
