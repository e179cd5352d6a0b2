"""A local socket that takes points as lines of JSON, of which only the newest counts."""

import contextlib
import select
import socket
import threading
import time
from typing import NamedTuple

from mimic.motions.mocap.live_points import Sample, parse_sample

MAX_LINE = 256 * 1024  # bytes; a line of 2000 points has 150,000
_RECEIVE = 64 * 1024  # bytes that are read from a connection in one call
_BACK = 1.0  # s; a time that is earlier by more begins a new motion
_POLL = 0.2  # s


class Counts(NamedTuple):
    """Lines of all senders.

    Attributes:
      received: valid samples.
      bad: lines that are no samples, or older than the one before.
      unused: samples that a newer one replaced before they were taken.
      rejected: connections whose first line was bad.
    """

    received: int
    bad: int
    unused: int
    rejected: int


class PointListener:
    """Receives samples in a thread and keeps the newest one. A new sender replaces the one before.

    A connection whose first line is no sample is closed: a page in a browser can send requests to local sockets.

    Args:
      host: address of this machine.
      port: port; 0 for a free one.

    Attributes:
      port: the port.
      last_error: what was wrong with the last bad line; "" before.

    Raises:
      ValueError: the address cannot be bound.
    """

    def __init__(self, host: str, port: int):
        self._server = _bound_socket(host, port)
        self.port = int(self._server.getsockname()[1])
        self.last_error = ""
        self._lock = threading.Lock()
        self._newest: Sample | None = None
        self._received = self._bad = self._unused = self._rejected = 0
        self._arrived: float | None = None  # time of the last sample [s]
        self._is_connected = self._is_closed = False
        self._thread = threading.Thread(target=self._run, daemon=True, name="points")
        self._thread.start()

    def take(self) -> Sample | None:
        """The newest sample; None if none has arrived since the last call."""
        with self._lock:
            sample, self._newest = self._newest, None
            return sample

    @property
    def counts(self) -> Counts:
        """Numbers of lines so far."""
        with self._lock:
            return Counts(self._received, self._bad, self._unused, self._rejected)

    @property
    def is_connected(self) -> bool:
        """Whether a sender is connected."""
        return self._is_connected

    @property
    def silence(self) -> float:
        """Time since the last sample [s]; infinite before the first."""
        arrived = self._arrived
        return float("inf") if arrived is None else time.monotonic() - arrived

    def close(self) -> None:
        """Closes the socket and waits for the thread."""
        self._is_closed = True
        self._thread.join()

    def _run(self) -> None:
        connection: _Connection | None = None
        with self._server:
            while not self._is_closed:
                sockets = [self._server, *([connection.socket] if connection else [])]
                ready = select.select(sockets, [], [], _POLL)[0]
                if connection and connection.socket in ready and not self._read(connection):
                    connection = connection.close()
                if self._server in ready:
                    if connection:
                        connection.close()
                    connection = _Connection(self._server.accept()[0])
                self._is_connected = connection is not None
        if connection:
            connection.close()

    def _read(self, connection: "_Connection") -> bool:
        """Reads what has arrived; returns whether the connection goes on."""
        try:
            received = connection.socket.recv(_RECEIVE)
        except OSError:
            return False
        for line in connection.lines(received):
            if not self._take_line(connection, line):
                return False
        return bool(received)

    def _take_line(self, connection: "_Connection", line: bytes | None) -> bool:
        try:
            if line is None:
                raise ValueError(f"expected lines of at most {MAX_LINE} bytes")
            sample = parse_sample(line)
            if connection.time is not None and connection.time - _BACK <= sample.time <= connection.time:
                raise ValueError(f"time: expected more than {connection.time:g} s, got {sample.time:g}")
        except ValueError as error:
            with self._lock:
                self._bad += 1
                self._rejected += not connection.is_sender
                self.last_error = str(error)
            return connection.is_sender
        connection.time, connection.is_sender = sample.time, True
        with self._lock:
            self._received += 1
            self._unused += self._newest is not None
            self._newest, self._arrived = sample, time.monotonic()
        return True


class _Connection:
    """A sender: its socket, and the time of its last sample [s]."""

    def __init__(self, connection: socket.socket):
        self.socket = connection
        connection.setblocking(False)
        self.time: float | None = None
        self.is_sender = False  # after its first sample
        self._rest = b""
        self._skips = False  # the rest of a line that is too long

    def lines(self, received: bytes) -> list[bytes | None]:
        """Complete lines so far that are not empty; None for one that is too long."""
        *complete, self._rest = (self._rest + received).split(b"\n")
        lines: list[bytes | None] = []
        for line in complete:
            if self._skips:
                self._skips = False
            elif line.strip():
                lines.append(line if len(line) <= MAX_LINE else None)
        if len(self._rest) > MAX_LINE:
            lines += [] if self._skips else [None]
            self._rest, self._skips = b"", True
        return lines

    def close(self) -> None:
        with contextlib.suppress(OSError):
            self.socket.close()


def _bound_socket(host: str, port: int) -> socket.socket:
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
    except OSError as error:
        raise ValueError(f"source: expected an address of this machine, as localhost, got {host!r}: {error}") from None
    server = socket.socket(family, kind, protocol)
    try:
        server.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # also where a listener has just ended
        server.bind(address)
        server.listen(4)
    except OSError as error:
        server.close()
        raise ValueError(f"source: expected a free port at {host}, got {port}: {error.strerror}") from None
    return server
