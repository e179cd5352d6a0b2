"""Runs a function in a process with limits on time and memory: a damaged file can make a library crash, or wait.

`python -I limited_process.py` reads a request from its input and writes a reply: this module, and the modules of the
functions that it runs, must import nothing of mimic at their start, whose import takes seconds.
"""

import contextlib
import importlib
import json
import os
import runpy
import signal
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from typing import Any

_FROM_CPU_TO_WALL_TIME = 5  # the machine may be busy
_TIME, _MEMORY = "time", "memory"


def call_limited(
    file: str, function: str, *arguments: Any, library: str, what: str, seconds: int, memory: int = 2 * 2**30
) -> Any:
    """Calls a function in a process of its own.

    Args:
      file: the module's file.
      function: its name there.
      arguments: its arguments, which JSON can hold, as the result must be.
      library: the package that the function uses; it is imported before the limits are set.
      what: what the function reads, for messages, as in "the model".
      seconds: CPU time.
      memory: address space [bytes].

    Raises:
      ValueError: the function raised an exception, crashed or exceeded a limit. The message is one line.
    """
    request = {"path": [entry for entry in sys.path if os.path.isabs(entry)], "file": file, "function": function}
    request |= {"arguments": arguments, "library": library, "seconds": seconds, "memory": memory}
    # One thread and one heap: address space is limited, and a thread's heap reserves 64 MiB of it.
    environment = {**os.environ, "MUJOCO_GL": "disable", "OPENBLAS_NUM_THREADS": "1", "MALLOC_ARENA_MAX": "1"}
    try:
        with tempfile.TemporaryDirectory(prefix="mimic-") as folder:  # MuJoCo writes its warnings to a file
            process = subprocess.run(
                [sys.executable, "-I", __file__],
                input=json.dumps(request).encode(),
                capture_output=True,
                timeout=_FROM_CPU_TO_WALL_TIME * seconds,
                cwd=folder,
                env=environment,
                start_new_session=True,  # Ctrl-C ends this process, which then ends that one
                check=False,
            )
    except subprocess.TimeoutExpired:
        reply: dict[str, Any] = {"exceeded": _TIME}
    else:
        reply = _reply(process)
    if "result" in reply:
        return reply["result"]
    if reply.get("exceeded") == _TIME:
        raise ValueError(f"{what} takes {library} more than {seconds} s to read")
    if reply.get("exceeded") == _MEMORY:
        raise ValueError(f"{what} needs more than {memory / 2**30:g} GiB of memory to read")
    raise ValueError(reply.get("error") or f"{library} crashes with {what} ({reply['ended_by']})")


def _reply(process: subprocess.CompletedProcess[bytes]) -> dict[str, Any]:
    """What the process wrote, or what ended it."""
    with contextlib.suppress(ValueError, IndexError):
        reply = json.loads(process.stdout.splitlines()[-1])
        if isinstance(reply, dict):
            return reply
    if -process.returncode in (signal.SIGXCPU, signal.SIGKILL):
        return {"exceeded": _TIME}
    if b"MemoryError" in process.stderr or b"bad_alloc" in process.stderr:
        return {"exceeded": _MEMORY}
    code = process.returncode
    return {"ended_by": signal.Signals(-code).name if code < 0 else f"exit code {code}"}


def _limit(seconds: int, memory: int) -> None:
    try:
        import resource
    except ImportError:  # not on this system, where the limit on wall time remains
        return
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds + 1))
    with contextlib.suppress(ValueError, OSError):  # macOS has no such limit
        resource.setrlimit(resource.RLIMIT_AS, (memory, memory))


def _answer(request: dict[str, Any], arguments: Sequence[Any]) -> dict[str, Any]:
    sys.path[:] = request["path"]
    importlib.import_module(request["library"])
    function = runpy.run_path(request["file"])[request["function"]]
    _limit(request["seconds"], request["memory"])
    try:
        return {"result": function(*arguments)}
    except MemoryError:
        return {"exceeded": _MEMORY}
    except Exception as error:  # the library's own errors, and what C++ raises for sizes that it cannot have
        line = " ".join(str(error).split()) or type(error).__name__
        return {"exceeded": _MEMORY} if "allocate memory" in line else {"error": line}


if __name__ == "__main__":
    content = json.loads(sys.stdin.buffer.read())
    print("\n" + json.dumps(_answer(content, content["arguments"])), flush=True)
    os._exit(0)  # without a library's own clean-up, which takes time and may crash
