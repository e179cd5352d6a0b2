"""The server of a view, over real connections: other sites, damaged messages, many clients."""

import asyncio
import importlib.util
import socket
import threading
import time

import pytest

if importlib.util.find_spec("viser") is None:
    pytest.skip("needs viser: pip install 'mimic-arms[view]'", allow_module_level=True)

import msgspec
import viser
from viser._messages import GuiUpdateMessage
from viser.infra import _infra
from websockets.asyncio.client import connect
from websockets.exceptions import InvalidStatus

from mimic.viewer.server import _LoopEvent, make_server
from tests.helpers.commands import free_port

PROTOCOL = f"viser-v{viser.__version__}"
CAMERA = {
    "type": "ViewerCameraMessage", "wxyz": [1.0, 0.0, 0.0, 0.0], "position": [2.0, 0.0, 1.0], "fov": 0.75,
    "near": 0.01, "far": 1000.0, "image_height": 850, "image_width": 1360, "look_at": [0.0, 0.0, 0.0],
    "up_direction": [0.0, 0.0, 1.0],
}  # fmt: skip
encode = msgspec.msgpack.encode


@pytest.fixture(scope="module")
def served():
    server = make_server("127.0.0.1", free_port())
    values = []
    slider = server.gui.add_slider("joint", -1.0, 1.0, 0.01, 0.0)
    slider.on_update(lambda event: values.append(event.target.value) if event.client else None)
    yield server.get_port(), server, slider, values
    server.stop()


def page(port, **headers):
    """A connection as the page of the view makes it."""
    options = {
        "subprotocols": [PROTOCOL],
        "origin": f"http://127.0.0.1:{port}",
        "max_size": None,
        "close_timeout": 0.2,
        **headers,
    }
    return connect(f"ws://127.0.0.1:{port}", **options)


def move(slider, value):
    return encode({"type": "GuiUpdateMessage", "uuid": slider._impl.uuid, "updates": {"value": value}})


async def until(condition):
    end = time.monotonic() + 30
    while not condition():
        assert time.monotonic() < end
        await asyncio.sleep(0.02)


@pytest.mark.parametrize(
    "headers",
    [
        {"origin": "http://evil.example"},
        {"origin": "null"},
        {"additional_headers": {"Host": "evil.example"}, "origin": "http://evil.example"},
    ],
    ids=str,
)
def test_pages_of_other_sites_are_rejected(served, headers, capfd):
    port = served[0]

    async def attempt():
        async with page(port, **headers):
            pass

    with pytest.raises(InvalidStatus, match="403"):
        asyncio.run(attempt())
    assert "view: rejected a request with " in capfd.readouterr().err or headers["origin"] == "http://evil.example"


@pytest.mark.parametrize(("host", "status"), [("127.0.0.1", b"200"), ("evil.example", b"403")])
def test_the_page_is_for_own_names_and_not_for_frames(served, host, status):
    with socket.create_connection(("127.0.0.1", served[0])) as browser:
        browser.sendall(f"GET / HTTP/1.1\r\nHost: {host}:{served[0]}\r\n\r\n".encode())
        answer = browser.recv(65536)
    assert answer.split()[1] == status and (b"frame-ancestors 'self'" in answer) == (status == b"200")


@pytest.mark.parametrize(("message", "value"), [(b"garbage", 0.1), ("text", 0.2), (encode(5), 0.3)], ids=str)
def test_a_damaged_message_ends_its_connection_alone(served, message, value):
    port, _, slider, values = served

    async def send():
        async with page(port) as first, page(port) as second:
            for client in (first, second):
                await client.send(encode(CAMERA))
            await first.send(message)
            await first.wait_closed()
            await second.send(move(slider, value))
            await until(lambda: values == [value])

    values.clear()
    asyncio.run(send())


def test_a_client_cannot_make_the_view_public(served, monkeypatch):
    port, server, slider, values = served
    monkeypatch.setattr(server, "request_share_url", lambda *_, **__: values.append("public"))

    async def send():
        async with page(port) as client:
            await client.send(encode(CAMERA))
            await client.send(encode({"type": "ShareUrlRequest"}))
            await client.send(move(slider, 0.75))
            await until(lambda: 0.75 in values)

    values.clear()
    asyncio.run(send())
    assert values == [0.75]


def test_an_update_in_a_thread_wakes_connections_in_the_loop_alone(served):
    message = GuiUpdateMessage(served[2]._impl.uuid, {"value": 0.5})

    async def run():
        buffer = _infra.AsyncMessageBuffer(
            asyncio.get_running_loop(), persistent_messages=True, message_event=_LoopEvent()
        )
        waiting = [asyncio.create_task(buffer.message_event.wait()) for _ in range(20)]
        await asyncio.sleep(0)
        thread = threading.Thread(target=buffer.push, args=(message,))
        thread.start()
        thread.join()  # the loop does not run meanwhile
        is_set_by_thread = buffer.message_event.is_set()
        await asyncio.wait_for(asyncio.gather(*waiting), 5)
        return is_set_by_thread

    assert not asyncio.run(run())
    assert isinstance(served[1]._websock_server.get_message_buffer().message_event, _LoopEvent)
