"""The policy in a process of its own: the inner loop sends it observations and takes its actions, but never waits.

Messages are datagrams of a pair of sockets, so that a policy that is killed or stopped at any moment leaves the inner
loop nothing to wait for. Linux and macOS have such sockets.
"""

import contextlib
import os
import signal
import socket
import struct
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

from mimic.control.joint_control import Reference
from mimic.deploy.bundle import Bundle, load_bundle
from mimic.deploy.sessions import Policy

_TICK = struct.Struct("<q")
_ANSWER = struct.Struct("<qdd")  # the tick, and the wall and CPU time of its evaluation [s]; then the action follows
_READY = -1  # the tick of the first message
_MAX_MESSAGE = 65_536  # bytes
_COMMAND = "import sys; from mimic.deploy.policy_process import main; main(*sys.argv[1:])"
_WATCH = 1.0  # s between two looks whether the inner loop still lives
# From the first of these times [s] before an observation is due to the second one, the last answer is computed again at
# intervals [s]: caches lose code and weights in a tick, and the evaluation would take several times as long.
_REHEARSAL, _REST, _INTERVAL = 0.004, 0.0004, 0.0001


class LocalPolicy:
    """The policy of one robot in this process, for simulated time."""

    def __init__(self, bundle: Bundle, motion: int):
        self._policy = Policy(bundle, [motion])
        self._action: tuple[int, np.ndarray] | None = None

    def send(self, tick: int, qpos: np.ndarray, qvel: np.ndarray, reference: Reference) -> None:
        """Gives the policy an observation: vectors [joints]."""
        of_robot = Reference(*(x[None] for x in reference))
        self._action = tick, self._policy.act(tick, qpos[None], qvel[None], of_robot)[0]

    def receive(self) -> tuple[int, np.ndarray] | None:
        """The newest action with its tick, once; None where there is none."""
        action, self._action = self._action, None
        return action

    def close(self) -> None:
        """Does nothing."""


class PolicyProcess:
    """The policy of one robot in a process of its own; the methods never wait for it.

    Args:
      bundle: see `load_bundle`.
      motion: index of the motion.
      start_s: maximum time until the process is ready [s].

    Attributes:
      wall_s, cpu_s: times of the evaluations whose actions were received [s].

    Raises:
      RuntimeError: the process did not become ready.
    """

    def __init__(self, bundle: Bundle, motion: int, start_s: float = 30.0):
        self._socket, other = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
        arguments = [str(bundle.folder), str(motion), str(other.fileno()), str(os.getpid())]
        with other:
            environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
            self._process = subprocess.Popen(
                [sys.executable, "-c", _COMMAND, *arguments], pass_fds=[other.fileno()], env=environment
            )
        self._size = bundle.action_size
        self.wall_s: list[float] = []
        self.cpu_s: list[float] = []
        self._wait(start_s)
        self._socket.setblocking(False)

    @property
    def pid(self) -> int:
        """Number of the process."""
        return self._process.pid

    def send(self, tick: int, qpos: np.ndarray, qvel: np.ndarray, reference: Reference) -> None:
        """See `LocalPolicy`; the observation is dropped where the process does not read."""
        values = np.concatenate([qpos, qvel, reference.qpos, reference.qvel]).astype(np.float32)
        with contextlib.suppress(OSError):
            self._socket.send(_TICK.pack(tick) + values.tobytes())

    def receive(self) -> tuple[int, np.ndarray] | None:
        """See `LocalPolicy`."""
        message = None
        with contextlib.suppress(OSError):  # BlockingIOError: there is none
            while True:
                message = self._socket.recv(_MAX_MESSAGE)
        if message is None or len(message) != _ANSWER.size + 4 * self._size:
            return None
        tick, wall, cpu = _ANSWER.unpack_from(message)
        self.wall_s.append(wall)
        self.cpu_s.append(cpu)
        return tick, np.frombuffer(message, np.float32, offset=_ANSWER.size).astype(float)

    def close(self) -> None:
        """Ends the process, also a stopped one."""
        self._process.kill()
        self._process.wait()
        self._socket.close()

    def _wait(self, start_s: float) -> None:
        self._socket.settimeout(0.2)
        end = time.monotonic() + start_s
        while time.monotonic() < end and self._process.poll() is None:
            with contextlib.suppress(TimeoutError):
                if self._socket.recv(_MAX_MESSAGE) == _TICK.pack(_READY):
                    return
        self.close()
        raise RuntimeError(f"policy: expected its process to be ready within {start_s:g} s, exit code "
                           f"{self._process.returncode}")  # fmt: skip


def main(folder: str, motion: str, descriptor: str, parent: str) -> None:
    """The process of a policy: it answers each observation with an action, until the inner loop has ended."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C in a terminal reaches it too: the inner loop ends it
    _yield_to_inner_loop()
    bundle = load_bundle(Path(folder))
    joints, connection = bundle.num_joints, socket.socket(fileno=int(descriptor))
    _warm_up(bundle)
    policy = Policy(bundle, [int(motion)])
    connection.send(_TICK.pack(_READY))
    connection.settimeout(_WATCH)
    message, due = b"", 0.0
    while os.getppid() == int(parent):
        try:
            message = connection.recv(_MAX_MESSAGE)
        except TimeoutError:
            is_early = time.perf_counter() < due - _REST
            if is_early:
                _answer(policy, message, joints, is_rehearsal=True)
            connection.settimeout(_INTERVAL if is_early else _WATCH)
            continue
        except OSError:
            return
        due = time.perf_counter() + bundle.control_dt
        with contextlib.suppress(OSError):
            connection.send(_answer(policy, message, joints))
        connection.settimeout(max(due - _REHEARSAL - time.perf_counter(), _INTERVAL))


def _answer(policy: Policy, message: bytes, joints: int, *, is_rehearsal: bool = False) -> bytes:
    """The message with the action for an observation."""
    wall, cpu = time.perf_counter(), time.thread_time()
    values = np.frombuffer(message, np.float32, offset=_TICK.size).reshape(4, 1, joints)
    (tick,) = _TICK.unpack_from(message)
    reference = Reference(values[2], values[3], values[3])
    action = policy.act(tick, values[0], values[1], reference, is_rehearsal=is_rehearsal).astype(np.float32)
    return _ANSWER.pack(tick, time.perf_counter() - wall, time.thread_time() - cpu) + action.tobytes()


def _yield_to_inner_loop() -> None:
    """On Linux, lets the inner loop go first where both share a core: an answer or a rehearsal waits for its period."""
    if not hasattr(os, "sched_setscheduler"):
        return
    scheduler, priority = os.sched_getscheduler(0), os.sched_getparam(0).sched_priority
    with contextlib.suppress(OSError):  # some containers forbid it
        if scheduler == os.SCHED_OTHER:
            os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))  # does not preempt others when it wakes up
        elif priority > 1:
            os.sched_setscheduler(0, scheduler, os.sched_param(priority - 1))


def _warm_up(bundle: Bundle, calls: int = 20) -> None:
    """Runs another session of the policy: the first calls take longer."""
    policy, zeros = Policy(bundle, [0]), np.zeros((1, bundle.num_joints))
    for _ in range(calls):
        policy.act(0, zeros, zeros, Reference(zeros, zeros, zeros))
