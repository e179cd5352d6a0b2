"""The server of a view: viser's, for pages that it served itself."""

import asyncio
import contextlib
import functools
import http
import io
import sys
from typing import Any

import viser
import websockets.asyncio.server
from viser._messages import ShareUrlRequest
from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response

from mimic.viewer.origins import accepted_names, objection

# A page of another site must not show the view in a frame, where the user might move the arms unknowingly.
_HEADERS = {"Content-Security-Policy": "frame-ancestors 'self'", "X-Content-Type-Options": "nosniff"}


def make_server(host: str, port: int) -> viser.ViserServer:
    """Starts a server without elements, which rejects requests of other sites with status 403."""
    serve = websockets.asyncio.server.serve
    # viser has no option for `process_request`, which websockets calls with each request.
    websockets.asyncio.server.serve = functools.partial(_serve, serve, accepted_names(host), set())  # type: ignore[misc]
    try:
        with contextlib.redirect_stdout(io.StringIO()):  # a banner, which `verbose` does not turn off
            server = viser.ViserServer(host=host, port=port, label="mimic", verbose=False)
    finally:
        websockets.asyncio.server.serve = serve  # type: ignore[misc]
    connections = server._websock_server
    connections.get_message_buffer().message_event = _LoopEvent()
    connections._incoming_handlers.pop(ShareUrlRequest)  # it would make the view public
    return server


def _serve(serve: Any, names: frozenset[str], noted: set[str], *args: Any, process_request: Any, **options: Any) -> Any:
    """Serves as viser asks for, behind the check of each request; prints a line for each reason, up to a hundred."""

    def check(connection: ServerConnection, request: Request) -> Response | None:
        host, origin = (request.headers.get_all(name) for name in ("Host", "Origin"))
        reason = objection(",".join(host), ",".join(origin) if origin else None, names)
        if reason:
            if reason not in noted and len(noted) < 100:
                noted.add(reason)
                print(f"view: rejected a request with {reason}, not of the page of the view", file=sys.stderr)
            return connection.respond(http.HTTPStatus.FORBIDDEN, "rejected by mimic.view\n")
        response = process_request(connection, request)
        if response is not None:
            response.headers.update(_HEADERS)
        return response

    return serve(*args, process_request=check, **options)


class _LoopEvent(asyncio.Event):
    """An event that is set in a loop only: `set` does nothing in other threads.

    viser 1.1 sets the event of its buffer in the thread that updates the page, while the loop may change the waiting
    tasks, which may end one of them; and then in the loop, which is enough.
    """

    def set(self) -> None:
        try:
            asyncio.get_running_loop()
        except RuntimeError:
            return
        super().set()
