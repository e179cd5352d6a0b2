"""The policy in a process of its own: the inner loop sends it observations and takes its actions, but never waits.

Messages are datagrams of a pair of sockets, so that a policy that is killed or stopped at any moment leaves the inner
loop nothing to wait for. Linux and macOS have such sockets.

Caches lose the code and weights of a network in a tick, and an evaluation would take several times as long. So the
process rehearses: before an observation is due, it computes an answer from the last one again and again.
"""

import contextlib
import errno
import gc
import os
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np

from mimic.control.joint_control import Reference
from mimic.deploy.bundle import Bundle, load_bundle
from mimic.deploy.cores import check_core
from mimic.deploy.sessions import Policy

_OBSERVATION = struct.Struct("<qd")  # the tick and the time at which it is sent [s]; then the motions follow
_ANSWER = struct.Struct(
    "<qddd"
)  # the tick, and times as the attributes of `PolicyProcess` [s]; then the action follows
_READY = b"ready"  # the first message of the process
_MAX_MESSAGE = 65_536  # bytes
_COMMAND = "import sys; from mimic.deploy.policy_process import main; main(*sys.argv[1:])"
_WATCH = 1.0  # s between two looks whether the inner loop still lives


class _Rehearsals(NamedTuple):
    """When a process rehearses.

    Attributes:
      rest: fraction of a tick without rehearsals, from an observation on.
      until: time before an observation is due at which they end [s]; negative: after it.
      pause: pause between two of them [s].
    """

    rest: float
    until: float
    pause: float


# On a core of its own the process never waits, but for the rest: Linux would throttle it at real-time priority.
_SHARED_CORE, _OWN_CORE = _Rehearsals(0.7, 0.0002, 0.0001), _Rehearsals(0.1, -0.001, 0.0)


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
      core: a core that this process keeps busy; until `close`, the thread that creates it runs on its other cores.
        None: any core of this thread, shared with other processes. Linux only.

    Attributes:
      ticks: of the actions that were received.
      answer_s: times from sending an observation to its answer, of these actions [s].
      wall_s, cpu_s: times of these evaluations [s].

    Raises:
      ValueError: no such core.
      RuntimeError: the process did not become ready.
    """

    def __init__(self, bundle: Bundle, motion: int, start_s: float = 30.0, core: int | None = None):
        if core is not None:
            check_core(core)
            if os.sched_getaffinity(0) == {core}:
                raise ValueError(f"core: expected another core than that of the inner loop, got {core}")
        self._socket, other = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
        arguments = [str(bundle.folder), str(motion), str(other.fileno()), str(os.getpid())]
        arguments += [] if core is None else ["own core"]
        with other:
            environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
            self._process = subprocess.Popen(
                [sys.executable, "-c", _COMMAND, *arguments], pass_fds=[other.fileno()], env=environment
            )
        self._size = bundle.action_size
        self.ticks: list[int] = []
        self.answer_s: list[float] = []
        self.wall_s: list[float] = []
        self.cpu_s: list[float] = []
        self._thread, self._left_core = threading.get_native_id(), None
        try:
            if core is not None:
                self._leave(core)
            self._wait(start_s)
        except BaseException:  # Ctrl-C too
            self.close()
            raise
        self._socket.setblocking(False)

    @property
    def pid(self) -> int:
        """Number of the process."""
        return self._process.pid

    def send(self, tick: int, qpos: np.ndarray, qvel: np.ndarray, reference: Reference) -> None:
        """See `LocalPolicy`; the observation is dropped where the process does not read."""
        values = np.concatenate([qpos, qvel, reference.qpos, reference.qvel]).astype(np.float32)  # `Policy.observed`
        with contextlib.suppress(OSError):
            self._socket.send(_OBSERVATION.pack(tick, time.perf_counter()) + values.tobytes())

    def receive(self) -> tuple[int, np.ndarray] | None:
        """See `LocalPolicy`."""
        message = None
        with contextlib.suppress(OSError):  # BlockingIOError: there is none
            while True:
                message = self._socket.recv(_MAX_MESSAGE)
        if message is None or len(message) != _ANSWER.size + 4 * self._size:
            return None
        tick, answer, wall, cpu = _ANSWER.unpack_from(message)
        self.ticks.append(tick)
        self.answer_s.append(answer)
        self.wall_s.append(wall)
        self.cpu_s.append(cpu)
        return tick, np.frombuffer(message, np.float32, offset=_ANSWER.size).astype(float)

    def close(self) -> None:
        """Ends the process, also a stopped one; the thread may use all of its cores again."""
        self._process.kill()
        self._process.wait()
        self._socket.close()
        if self._left_core is not None:
            with contextlib.suppress(OSError):  # the thread has ended, or the core is no longer allowed
                os.sched_setaffinity(self._thread, os.sched_getaffinity(self._thread) | {self._left_core})
        self._left_core = None

    def _leave(self, core: int) -> None:
        """Gives the process a core, which this thread leaves."""
        try:
            os.sched_setaffinity(self._process.pid, {core})
        except OSError as error:
            if error.errno != errno.EINVAL:
                raise
            raise ValueError(f"core: expected one that processes may use, got {core}") from error
        allowed = os.sched_getaffinity(0)
        if core in allowed:
            os.sched_setaffinity(0, allowed - {core})
            self._left_core = core

    def _wait(self, start_s: float) -> None:
        self._socket.settimeout(0.2)
        end = time.monotonic() + start_s
        while time.monotonic() < end and self._process.poll() is None:
            with contextlib.suppress(TimeoutError):
                if self._socket.recv(_MAX_MESSAGE) == _READY:
                    return
        raise RuntimeError(f"policy: expected its process to be ready within {start_s:g} s, exit code "
                           f"{self._process.returncode}")  # fmt: skip


def main(folder: str, motion: str, descriptor: str, parent: str, own_core: str = "") -> None:
    """The process of a policy: it answers each observation with an action, until the inner loop has ended."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C in a terminal reaches it too: the inner loop ends it
    _yield_to_inner_loop()
    bundle = load_bundle(Path(folder))
    connection = socket.socket(fileno=int(descriptor))
    _warm_up(bundle)
    policy = Policy(bundle, [int(motion)])
    gc.freeze()
    gc.disable()  # an answer leaves no cycles of references
    connection.send(_READY)
    _answer_all(policy, bundle, connection, int(parent), _OWN_CORE if own_core else _SHARED_CORE)


def _answer_all(
    policy: Policy, bundle: Bundle, connection: socket.socket, parent: int, rehearsals: _Rehearsals
) -> None:
    """Answers observations, and rehearses before each, as long as the parent lives."""
    connection.settimeout(_WATCH)
    answers, due = _Answers(policy), 0.0
    while os.getppid() == parent:
        try:
            size, _, flags, _ = connection.recvmsg_into(answers.message)
        except (TimeoutError, BlockingIOError):
            is_early = time.perf_counter() < due - rehearsals.until
            if is_early:
                answers.compute()
            connection.settimeout(rehearsals.pause if is_early else _WATCH)
            continue
        except OSError:
            return
        received = time.perf_counter()
        if size != answers.size or flags & socket.MSG_TRUNC:
            got = "more" if size == answers.size else size
            raise ValueError(f"observation: expected {answers.size} bytes, got {got}")
        with contextlib.suppress(OSError):
            connection.send(answers.compute())
        answers.expect_next()
        due = received + bundle.control_dt
        connection.settimeout(max(received + rehearsals.rest * bundle.control_dt - time.perf_counter(), 1e-4))


class _Answers:
    """The answers of a policy to the observations of one robot.

    Attributes:
      message: where an observation is received, as `PolicyProcess.send` wrote it: its head, and `Policy.observed`.
      size: of a message [bytes].
    """

    def __init__(self, policy: Policy):
        self._policy, self._head = policy, bytearray(_OBSERVATION.size)
        self.message = self._head, policy.observed.data
        self.size = len(self._head) + policy.observed.nbytes

    def compute(self) -> bytes:
        """The message with the action for the observation; a rehearsal of the next answer calls it too."""
        cpu, wall = time.thread_time(), time.perf_counter()
        tick, sent = _OBSERVATION.unpack_from(self._head)
        action = self._policy.evaluate(tick)
        now = time.perf_counter()
        return _ANSWER.pack(tick, now - sent, now - wall, time.thread_time() - cpu) + action.tobytes()

    def expect_next(self) -> None:
        """Ends a tick: its action is a past one, and rehearsals are of the next one."""
        self._policy.remember()
        tick, sent = _OBSERVATION.unpack_from(self._head)
        _OBSERVATION.pack_into(self._head, 0, tick + 1, sent)


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
