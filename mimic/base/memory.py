"""Estimates of memory against what the device or the machine has, before anything is allocated."""

import contextlib
import os

from mimic.base.files import read_text

_CGROUP_LIMITS = "/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes"  # version 2, version 1
_GIB = 2**30


def check_memory(what: str, needed: float, available: int | None, where: str) -> None:
    """Raises a ValueError if something needs more memory than there is.

    Args:
      what: the settings that decide on the memory, for the error message.
      needed: a lower bound on the memory [bytes].
      available: the memory that there is [bytes]; None where it is unknown.
      where: whose memory it is, as "device".
    """
    if available is not None and needed > available:
        raise ValueError(
            f"{what}: expected to fit into the memory of the {where}, {_text(available)}; got a need of at least "
            f"{_text(needed)}"
        )


def host_memory() -> int | None:
    """Memory of this machine, or of the control group (container) that this process is in [bytes]; None: unknown."""
    limits = []
    with contextlib.suppress(OSError, ValueError, AttributeError):
        limits.append(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    for path in _CGROUP_LIMITS:
        with contextlib.suppress(OSError, ValueError):  # no such file, or "max"
            limits.append(int(read_text(path)))
    return min(limits, default=None)


def device_memory() -> int | None:
    """Memory of all devices that JAX computes on [bytes]; the host's for a CPU; None: unknown."""
    import jax  # takes a second

    if jax.default_backend() == "cpu":
        return host_memory()
    limits = [(device.memory_stats() or {}).get("bytes_limit") for device in jax.local_devices()]
    known = [limit for limit in limits if limit]
    return sum(known) * jax.device_count() // len(limits) if known and len(known) == len(limits) else None


def _text(size: float) -> str:
    return f"{size / _GIB:,.1f} GiB"
