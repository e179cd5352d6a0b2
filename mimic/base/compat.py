"""Workarounds for other packages and their versions; all of them are here."""

import contextlib
import ctypes
import importlib
import importlib.metadata
import importlib.util
import io
import logging
import os
import pkgutil
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

_log = logging.getLogger(__name__)
_BRAX_AXIS_NAME = "i"  # brax.training.agents.ppo.train
# What PyOpenGL and ctypes raise where a graphics library is missing.
NO_GRAPHICS = (AttributeError, OSError, ctypes.ArgumentError)
_RESULTS = 15  # of one kernel: XLA computes anew what more of them have in common
_SLOW_CPU_FLAG = "--xla_cpu_use_fusion_emitters=false"


def needs_cpu_flag(jaxlib_version: str | None = None) -> bool:
    """Whether the fusion emitters of XLA's CPU backend must be turned off.

    Before jaxlib 0.11 they make batched kinematics several hundred times slower. From 0.11 on XLA does not know the
    flag and aborts on it. False where jaxlib is not installed, as on a computer that only runs `mimic.deploy`.
    """
    try:
        version = jaxlib_version or importlib.metadata.version("jaxlib")
    except importlib.metadata.PackageNotFoundError:
        return False
    major, minor = (int(part) for part in version.split(".")[:2])
    return (major, minor) < (0, 11)


def prepare_cpu() -> None:
    """Turns XLA's fusion emitters off where `needs_cpu_flag`; must run before JAX starts its backend."""
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
    """Imports MuJoCo even if the graphics library that MUJOCO_GL names is missing; only rendering fails then.

    Called by each folder of mimic whose modules import MuJoCo.
    """
    user_setting = os.environ.get("MUJOCO_GL", "")
    try:
        importlib.import_module("mujoco")
    except NO_GRAPHICS:
        os.environ["MUJOCO_GL"] = "disabled"
        try:
            package = importlib.import_module("mujoco")
        finally:
            os.environ["MUJOCO_GL"] = user_setting
        for name, part in list(sys.modules.items()):  # submodules of the first try are no attributes yet
            if name.startswith("mujoco.") and name.count(".") == 1:
                setattr(package, name.partition(".")[2], part)


def import_mjx() -> None:
    """Imports MJX without printing its two lines about Warp, an optional backend that mimic does not use.

    MJX's meshes and brax's contact solver are imported at their first use: arms do not need them. Their imports
    trimesh, jaxopt and SciPy would take 1.3 s of processor time at the start of a training, beside 4.0 s for all others
    (medians of seven starts).
    """
    for name in ("mujoco.mjx._src.mesh", "jaxopt"):
        if name not in sys.modules:
            _import_later(name)
    with contextlib.redirect_stdout(io.StringIO()):
        importlib.import_module("mujoco.mjx")


def _import_later(name: str) -> None:
    """Registers a module that is executed at the first access to an attribute; does nothing if there is no module."""
    package, *path = name.split(".")
    spec = importlib.util.find_spec(package)
    if spec and path:  # located by hand, because `find_spec` of a submodule imports its parents
        file = Path((spec.submodule_search_locations or [""])[0], *path).with_suffix(".py")
        spec = importlib.util.spec_from_file_location(name, file) if file.is_file() else None
    if spec is None or spec.loader is None:
        return
    module, execute = importlib.util.module_from_spec(spec), spec.loader.exec_module

    def load(attribute: str) -> Any:  # PEP 562; the import system itself already reads attributes of a `LazyLoader`
        del module.__getattr__
        execute(module)
        return getattr(module, attribute)

    module.__getattr__ = load  # type: ignore[method-assign]
    sys.modules[name] = module


def import_jax2onnx() -> Any:
    """Imports jax2onnx with the conversions of JAX's primitives alone, and makes its log silent.

    Its others convert functions of flax, equinox and dm_pix. They take 13 of 14 s of processor time, and dm_pix fails.
    """
    module = importlib.import_module("jax2onnx")
    plugins: Any = importlib.import_module("jax2onnx.plugins.plugin_system")
    if not plugins._already_imported_plugins:
        plugins._already_imported_plugins = True
        primitives = importlib.import_module("jax2onnx.plugins.jax.lax")
        for plugin in pkgutil.iter_modules(primitives.__path__, f"{primitives.__name__}."):
            importlib.import_module(plugin.name)
    logging.getLogger("onnx_ir").setLevel(logging.ERROR)  # warns of each intermediate value without a type
    return module


def share_config_store() -> None:
    """Keeps Hydra from copying all registered configs for each group that it lists, which is half the time of `--help`.

    The copies are unnecessary, because Hydra also copies each config that it loads.
    """
    from hydra.core.config_store import ConfigStore

    ConfigStore.__deepcopy__ = lambda self, memo: self  # type: ignore[attr-defined]


def computed_once(scalars: list[Any]) -> list[Any]:
    """Returns the scalars with a barrier, so that XLA computes them once before it stacks them.

    On GPUs XLA may fuse a concatenation with all of its inputs' computation, with one copy of it for each row: small
    batches of a 7-link arm then take a minute to compile. On CPUs it does not, and the barrier would cost time.
    """
    import jax

    return scalars if is_cpu() else jax.lax.optimization_barrier(scalars)


def is_cpu() -> bool:
    """Whether JAX's default backend is the CPU."""
    import jax

    return jax.default_backend() == "cpu"


def stored(tree: Any) -> Any:
    """The values of a pytree of arrays and Python numbers, which XLA's CPU backend computes together and stores.

    A kernel of this backend has one result, except for that of a reduction of several arrays. So without this it
    computes what several results have in common once for each: in a Newton step its sines 30 times. Here each array is
    repeated along a new axis and reduced to its last entry; LLVM sees that the entries are equal. Pairs of real numbers
    are one complex one, because few results fit into a kernel. Other backends do without.

    Args:
      tree: its arrays have real numbers, and shapes that broadcast; all results have the same shape.
    """
    import jax
    import numpy as np

    leaves, structure = jax.tree.flatten(tree)
    arrays = [x for x in leaves if not _is_number(x)]
    if not is_cpu() or not arrays:
        return tree
    shape = jax.numpy.broadcast_shapes(*(x.shape for x in arrays))

    @jax.custom_jvp  # JAX differentiates no reduction of several arrays
    def together(arrays: list[Any]) -> list[Any]:
        last: list[Any] = []
        pairs = _in_pairs(arrays)
        for group in (pairs[i : i + _RESULTS] for i in range(0, len(pairs), _RESULTS)):
            twice = [jax.numpy.broadcast_to(x, (2, *shape)) for x in group]
            last += jax.lax.reduce(twice, [np.zeros((), x.dtype) for x in group], lambda _, entry: entry, (0,))
        return list(_from_pairs(last))

    together.defjvp(lambda primals, tangents: (together(*primals), tangents[0]))
    results = iter(together([jax.numpy.broadcast_to(x, shape) for x in arrays]))
    return jax.tree.unflatten(structure, [x if _is_number(x) else next(results) for x in leaves])


def _in_pairs(arrays: list[Any]) -> list[Any]:
    """Real arrays as half as many complex ones; the last one stays real if their number is odd."""
    import jax

    pairs = zip(arrays[::2], arrays[1::2], strict=False)
    return [jax.lax.complex(*pair) for pair in pairs] + arrays[len(arrays) // 2 * 2 :]


def _from_pairs(arrays: list[Any]) -> list[Any]:
    import jax

    is_complex = jax.numpy.iscomplexobj
    return [part for x in arrays for part in ([jax.lax.real(x), jax.lax.imag(x)] if is_complex(x) else [x])]


def _is_number(value: Any) -> bool:
    return isinstance(value, float | int)


def coordination_client() -> Any:
    """The key-value client of `jax.distributed`'s coordination service; JAX has no public name for it."""
    from jax._src import distributed

    return distributed.global_state.client


def process_number() -> int:
    """The number of this process in `jax.distributed`; unlike `jax.process_index`, it does not start the backend."""
    from jax._src import distributed

    return distributed.global_state.process_id


def mend_brax() -> None:
    """Restores `jax.device_put_replicated`, which brax 0.14 calls in its training loops and JAX removed in 0.10.

    Called by each `ImitationEnv`, not by `import mimic`. brax looks the name up in `jax` itself. The name is added only
    where it is missing, with JAX's own arguments and result; nothing that exists is replaced.
    """
    import jax

    def replicated(tree: Any, devices: Sequence[Any]) -> Any:
        """Copies a pytree to all devices, along a new first axis.

        By `jax.pmap` with brax's own name of the axis, so that the result has the sharding of what brax's training
        epoch returns: the epoch is then compiled once instead of twice.
        """
        replicate = jax.pmap(lambda _, x: x, axis_name=_BRAX_AXIS_NAME, in_axes=(0, None), devices=list(devices))
        return replicate(jax.numpy.arange(len(devices)), tree)

    if not hasattr(jax, "device_put_replicated"):
        jax.device_put_replicated = replicated  # type: ignore[attr-defined]
