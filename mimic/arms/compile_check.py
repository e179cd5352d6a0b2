"""Compiles a model in a process of its own, with limits on time and memory, and checks its magnitudes.

`python -I compile_check.py` reads a request from its input and writes a reply: this module must import nothing of
mimic, whose import takes seconds.
"""

import contextlib
import json
import math
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from typing import Any

CPU_SECONDS, WALL_SECONDS = 10, 15  # a Panda with meshes needs 1 s
MEMORY = 2 * 2**30  # bytes of address space, of which a process that imports MuJoCo has 0.2 GiB
VELOCITY_LIMIT = "velocity_limit"  # custom numeric with the velocity limit of each joint [rad/s]

# What a model may have of each element; some robots with scenes have a few hundred.
MAX_COUNTS = {"nbody": 1000, "njnt": 1000, "nu": 1000, "neq": 1000, "nsite": 2000, "ngeom": 5000, "nkey": 1000}
# Magnitudes that no arm exceeds, for finite simulations in float32: fields of a compiled model by what they are.
MAX_VALUES = {
    "mass [kg]": (1e5, ("body_mass", "body_subtreemass")),
    "inertia [kg m^2]": (1e7, ("body_inertia",)),
    "position [m]": (1e4, ("body_pos", "body_ipos", "jnt_pos", "site_pos", "geom_pos")),
    "orientation": (2.0, ("body_quat", "body_iquat", "site_quat", "geom_quat", "jnt_axis")),
    "size [m]": (1e4, ("site_size",)),
    "joint position [rad or m]": (1e4, ("qpos0", "qpos_spring", "key_qpos")),
    "joint range [rad or m]": (1e4, ("jnt_range",)),
    "rotor inertia [kg m^2]": (1e6, ("dof_armature",)),
    "damping [N m s/rad]": (1e12, ("dof_damping",)),  # Fetch's base is held by 1e11
    "stiffness [N m/rad]": (1e8, ("jnt_stiffness",)),
    "dry friction [N m]": (1e8, ("dof_frictionloss",)),
    "torque limit [N m]": (1e10, ("jnt_actfrcrange",)),
    "actuator parameter": (1e10, ("actuator_forcerange", "actuator_ctrlrange", "actuator_gear", "actuator_gainprm")),
}
MAX_VELOCITY = 1e4  # rad/s; a motor of 100,000 rpm has this speed without a gear


def check_magnitudes(model: Any) -> None:
    """Rejects a compiled model with more elements than an arm has, or with values that are not finite or implausible.

    Raises:
      ValueError: names the quantity, its value and the maximum.
    """
    import numpy as np

    for name, maximum in MAX_COUNTS.items():
        if getattr(model, name) > maximum:
            raise ValueError(f"the model has {name} = {getattr(model, name)}; expected at most {maximum}")
    for quantity, (maximum, names) in MAX_VALUES.items():
        for name in names:
            values = np.asarray(getattr(model, name))
            wrong = values[~(np.abs(values) <= maximum)]
            if wrong.size:
                raise ValueError(f"the model has a {quantity} of {wrong[0]:g} ({name}); expected at most {maximum:g}")
    for name in ("body_mass", "body_inertia", "dof_armature", "dof_damping"):
        if np.any(np.asarray(getattr(model, name)) < 0):
            raise ValueError(f"the model has a negative {name}; expected at least 0")
    for limit in _velocity_limits(model):
        if not (0 < limit <= MAX_VELOCITY or limit == math.inf):
            raise ValueError(
                f"the model has a velocity limit of {limit:g} rad/s; expected a number above 0 and of at most "
                f"{MAX_VELOCITY:g}, or inf for a joint without a limit"
            )


def _velocity_limits(model: Any) -> list[float]:
    import mujoco

    numeric = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_NUMERIC, VELOCITY_LIMIT)
    return list(map(float, model.numeric(numeric).data)) if numeric >= 0 else []


def check_in_process(text: str, attached: Mapping[str, bytes]) -> None:
    """Compiles a model in a process with limits, before this one does, and checks its magnitudes.

    Raises:
      ValueError: MuJoCo rejects the model, crashes, or exceeds a limit; or what `check_magnitudes` rejects.
    """
    request = {"path": [entry for entry in sys.path if os.path.isabs(entry)], "text": text}
    request["attached"] = {name: content.decode() for name, content in attached.items()}
    # One thread and one heap: address space is limited, and a thread's heap reserves 64 MiB of it.
    environment = {**os.environ, "MUJOCO_GL": "disable", "OPENBLAS_NUM_THREADS": "1", "MALLOC_ARENA_MAX": "1"}
    try:
        process = subprocess.run(
            [sys.executable, "-I", __file__],
            input=json.dumps(request).encode(),
            capture_output=True,
            timeout=WALL_SECONDS,
            cwd=tempfile.gettempdir(),
            env=environment,
            start_new_session=True,  # Ctrl-C ends this process, which then ends that one
            check=False,
        )
    except subprocess.TimeoutExpired:
        raise ValueError(_too_long(WALL_SECONDS)) from None
    error = _error(process)
    if error is not None:
        raise ValueError(error)


def _error(process: subprocess.CompletedProcess[bytes]) -> str | None:
    """Why the process rejected the model, or what ended it; None where the model is accepted."""
    if b"contains a 'NaN'" in process.stderr:  # MuJoCo's warning, in whatever attribute it is
        return "the model has a number that is not a number: NaN"
    with contextlib.suppress(ValueError, IndexError, TypeError, KeyError):
        error = json.loads(process.stdout.splitlines()[-1])["error"]
        return _TOO_LARGE if error and "allocate memory" in error else error
    if -process.returncode in (signal.SIGXCPU, signal.SIGKILL):
        return _too_long(CPU_SECONDS)
    if b"MemoryError" in process.stderr or b"bad_alloc" in process.stderr:
        return _TOO_LARGE
    cause = signal.Signals(-process.returncode).name if process.returncode < 0 else f"exit code {process.returncode}"
    return f"MuJoCo crashes when it compiles the model ({cause})"


_TOO_LARGE = f"the model needs more than {MEMORY // 2**30} GiB of memory to compile"


def _too_long(seconds: int) -> str:
    return f"the model takes more than {seconds} s to compile; expected simpler meshes or fewer elements"


def _limit() -> None:
    try:
        import resource
    except ImportError:  # not on this system, where the limit on wall time remains
        return
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))  # MuJoCo writes its warnings to a file
    resource.setrlimit(resource.RLIMIT_CPU, (CPU_SECONDS, CPU_SECONDS + 1))
    with contextlib.suppress(ValueError, OSError):  # macOS has no such limit
        resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))


def _compile(request: Mapping[str, Any]) -> None:
    import mujoco

    attached = {name: content.encode() for name, content in request["attached"].items()}
    spec = mujoco.MjSpec.from_string(request["text"], include=attached)
    spec.compiler.usethread = False
    model = spec.compile()
    check_magnitudes(model)
    mujoco.mj_kinematics(model, mujoco.MjData(model))


def main() -> None:
    """Replies to the request in the input."""
    request = json.loads(sys.stdin.buffer.read())
    sys.path[:] = request["path"]
    import mujoco  # noqa: F401  # before the limits, so that these are of the model alone

    _limit()
    error = None
    try:
        _compile(request)
    except MemoryError:
        error = _TOO_LARGE
    except Exception as failure:  # MuJoCo's own errors, and what C++ raises for sizes that it cannot have
        error = str(failure) or type(failure).__name__
    print("\n" + json.dumps({"error": error}), flush=True)
    os._exit(0)  # without MuJoCo's own clean-up, which takes time and may crash


if __name__ == "__main__":
    main()
