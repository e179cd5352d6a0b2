"""The relay to the first process: it passes on, and outlives what it connects to."""

import socket

import pytest

from mimic.trainers.distributed.relay import Relay


def connect(address):
    host, port = address.rsplit(":", 1)
    return socket.create_connection((host, int(port)), timeout=20)


def test_bytes_pass_in_both_directions_and_a_loss_is_seen():
    with socket.create_server(("127.0.0.1", 0)) as server:
        relay = Relay(f"127.0.0.1:{server.getsockname()[1]}")
        here = connect(relay.address)
        there, _ = server.accept()
        here.sendall(b"question")
        assert there.recv(100) == b"question"
        there.sendall(b"answer" * 50_000)
        received = b""
        while len(received) < 300_000:
            received += here.recv(65536)
        assert received == b"answer" * 50_000 and not relay.lost.is_set()
        there.close()
        assert relay.lost.wait(20)
        here.settimeout(0.3)
        with pytest.raises(TimeoutError):  # not closed: JAX's client would end the process
            here.recv(1)
        here.close()


def test_a_first_process_that_has_not_started_is_not_lost():
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    relay = Relay(f"127.0.0.1:{port}")
    with connect(relay.address) as early:
        assert early.recv(1) == b""  # the client tries again
    assert not relay.lost.is_set()
    with socket.create_server(("127.0.0.1", port)) as server, connect(relay.address) as here:
        there, _ = server.accept()
        here.sendall(b"x")
        assert there.recv(1) == b"x"


def test_the_end_of_this_side_is_passed_on():
    with socket.create_server(("127.0.0.1", 0)) as server:
        relay = Relay(f"127.0.0.1:{server.getsockname()[1]}")
        here = connect(relay.address)
        there, _ = server.accept()
        here.close()
        there.settimeout(20)
        assert there.recv(1) == b""
        there.close()
