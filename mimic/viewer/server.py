"""The server of a view: viser's, behind checks of each request and of each message that a browser sends.

viser 1.1 accepts requests of every site, a message that it cannot read ends its task with a traceback, and updates from
several threads may end one of these.
"""

import asyncio
import contextlib
import dataclasses
import functools
import http
import io
import sys
from collections.abc import Iterator
from typing import Any

import msgspec
import viser
import websockets.asyncio.server
from viser.infra import _infra
from websockets.asyncio.server import ServerConnection
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

from mimic.viewer.messages import ValueCheck, fault, in_range, is_flag, one_of
from mimic.viewer.origins import accepted_names, objection, serves_all_addresses

_MAX_MESSAGE = 64 * 1024  # bytes; the page's messages have some hundred
_MAX_CLIENTS = 100  # connections; more are rejected
_MAX_LINES = 100  # printed in all
_PROTOCOL = "viser-v"  # how viser's pages begin the name of theirs
# A page of another site must not show the view in a frame, where the user might move the arms unknowingly.
_HEADERS = {"Content-Security-Policy": "frame-ancestors 'self'", "X-Content-Type-Options": "nosniff"}


def make_server(host: str, port: int) -> "tuple[viser.ViserServer, Gatekeeper]":
    """Starts a server without elements, and the checks before it."""
    gatekeeper = Gatekeeper(host)
    _infra.AsyncMessageBuffer = _MessageBuffer  # the class of the buffers that viser makes from now on
    banner = contextlib.redirect_stdout(io.StringIO())  # which `verbose` does not turn off
    with banner, _serving_through(gatekeeper):
        server = viser.ViserServer(host=host, port=port, label="mimic", verbose=False)
    gatekeeper.server = server
    return server, gatekeeper


class Gatekeeper:
    """Rejects requests of other sites, and drops messages that no page of the view sends.

    Args:
      host: address of the server.

    Attributes:
      server: the server behind.
      dropped: number of dropped messages.
      rejected: number of rejected requests.
    """

    def __init__(self, host: str):
        self.server: viser.ViserServer | None = None
        self.dropped = self.rejected = 0
        self._names, self._any_address = accepted_names(host), serves_all_addresses(host)
        self._clients = 0
        self._noted: set[tuple[str, str]] = set()

    def check(self, connection: ServerConnection, request: Request) -> Response | None:
        """A response that rejects a request; None to go on."""
        host, origin = request.headers.get_all("Host"), request.headers.get_all("Origin")
        reason = objection(",".join(host), ",".join(origin) if origin else None, self._names, self._any_address)
        if reason:
            return self._reject(connection, f"a request with {reason}, not of the page of the view,")
        if request.headers.get("Upgrade", "").lower() != "websocket":
            return None
        if not any(name.strip().startswith(_PROTOCOL) for name in _protocols(request)):
            return self._reject(connection, "a connection that is not of the page of the view")
        if self._clients >= _MAX_CLIENTS:
            return self._reject(connection, f"a connection beyond {_MAX_CLIENTS}")
        return None

    def _reject(self, connection: ServerConnection, what: str) -> Response:
        self.rejected += 1
        self._note(connection, f"rejected {what}")
        body = b"rejected by mimic.view\n"
        headers = Headers({"Content-Type": "text/plain", "Content-Length": str(len(body)), "Connection": "close"})
        return Response(http.HTTPStatus.FORBIDDEN, "Forbidden", headers, body)

    async def serve(self, handler: Any, connection: ServerConnection) -> None:
        """Serves a connection from which bad messages never arrive."""
        receive = connection.recv

        async def receive_valid() -> bytes:
            while True:
                message = await receive()
                reason = self._fault(message)
                if reason is None:
                    assert isinstance(message, bytes)
                    return message
                if reason:
                    self.dropped += 1
                    self._note(connection, f"dropped a message ({reason})")

        connection.recv = receive_valid  # type: ignore[method-assign]
        self._clients += 1
        try:
            await handler(connection)
        finally:
            self._clients -= 1

    def _fault(self, message: str | bytes) -> str | None:
        if not isinstance(message, bytes):
            return "text"
        try:
            return fault(msgspec.msgpack.decode(message), self._check_of)
        except (msgspec.MsgspecError, ValueError, RecursionError):
            return "not MessagePack"

    def _check_of(self, uuid: str) -> ValueCheck | None:
        """Which values suit a widget."""
        widget = self.server.gui._gui_input_handle_from_uuid.get(uuid) if self.server else None
        if isinstance(widget, viser.GuiSliderHandle):
            return in_range(widget.min, widget.max)
        if isinstance(widget, viser.GuiDropdownHandle | viser.GuiButtonGroupHandle):
            return one_of(widget.options)
        return is_flag if isinstance(widget, viser.GuiCheckboxHandle | viser.GuiButtonHandle) else None

    def _note(self, connection: ServerConnection, what: str) -> None:
        """Prints a line, once for each client and kind."""
        address = connection.remote_address
        client = str(address[0]) if address else "unknown"
        note = client, what.partition(" ")[0]
        if note not in self._noted and len(self._noted) < _MAX_LINES:
            self._noted.add(note)
            print(f"view: {what} from {client}; further ones are only counted", file=sys.stderr, flush=True)


class _LoopEvent(asyncio.Event):
    """An event that is set in a loop only: `set` does nothing in other threads.

    viser sets the event of a buffer in the thread that updates the page, while the loop may change the waiting tasks,
    and then in the loop, which is enough.
    """

    def set(self) -> None:
        try:
            asyncio.get_running_loop()
        except RuntimeError:
            return
        super().set()


@dataclasses.dataclass
class _MessageBuffer(_infra.AsyncMessageBuffer):
    """The updates that wait for their connection; threads may add to it."""

    message_event: asyncio.Event = dataclasses.field(default_factory=_LoopEvent)


def _protocols(request: Request) -> list[str]:
    return ",".join(request.headers.get_all("Sec-WebSocket-Protocol")).split(",")


@contextlib.contextmanager
def _serving_through(gatekeeper: Gatekeeper) -> Iterator[None]:
    """Context in which viser starts a server behind a gatekeeper; it has no option for that."""
    serve = websockets.asyncio.server.serve

    def guarded(handler: Any, *args: Any, process_request: Any, **options: Any) -> Any:
        def process(connection: ServerConnection, request: Request) -> Response | None:
            response = gatekeeper.check(connection, request) or process_request(connection, request)
            if response is not None:
                response.headers.update(_HEADERS)
            return response

        options["max_size"] = _MAX_MESSAGE
        return serve(functools.partial(gatekeeper.serve, handler), *args, process_request=process, **options)

    websockets.asyncio.server.serve = guarded  # type: ignore[misc]
    try:
        yield
    finally:
        websockets.asyncio.server.serve = serve  # type: ignore[misc]
