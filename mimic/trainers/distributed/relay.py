"""The connection of a training process to the first one, whose loss does not end this process.

JAX's client aborts its process, with a stack trace and no reason, when the connection closes. It therefore connects to
a relay in its own process, which keeps that end open.
"""

import contextlib
import socket
import threading

_CHUNK = 65536


class Relay:
    """Passes the connections of this process on to an address.

    Args:
      address: HOST:PORT of the first process.

    Attributes:
      address: HOST:PORT to connect to instead.
      lost: set when the other end has closed a connection, or does not accept one any longer.
    """

    def __init__(self, address: str):
        host, _, port = address.rpartition(":")
        self._target = host.strip("[]"), int(port)
        self._listener = socket.create_server(("127.0.0.1", 0))
        self._connected = False
        self.address = f"127.0.0.1:{self._listener.getsockname()[1]}"
        self.lost = threading.Event()
        threading.Thread(target=self._accept, daemon=True, name="relay").start()

    def _accept(self) -> None:
        while True:
            here, _ = self._listener.accept()
            try:
                there = socket.create_connection(self._target)
            except OSError:  # the first process has not started yet: the client tries again
                here.close()
                if self._connected:
                    self.lost.set()
                continue
            self._connected = True
            for source, sink, is_lost in ((here, there, None), (there, here, self.lost)):
                source.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                threading.Thread(target=_pass_on, args=(source, sink, is_lost), daemon=True, name="relay").start()


def _pass_on(source: socket.socket, sink: socket.socket, lost: threading.Event | None) -> None:
    """Copies bytes until the source closes; with `lost`, the sink stays open then."""
    with contextlib.suppress(OSError):
        while data := source.recv(_CHUNK):
            sink.sendall(data)
    if lost is not None:
        lost.set()
    else:
        with contextlib.suppress(OSError):
            sink.shutdown(socket.SHUT_WR)
