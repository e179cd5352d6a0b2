"""The socket that takes points: what it drops, what it counts, and that only the newest sample is kept."""

import contextlib
import json
import socket
import time

import pytest

from mimic.motions.mocap.point_socket import MAX_LINE, PointListener


@pytest.fixture
def listener():
    with contextlib.closing(PointListener("localhost", 0)) as listener:
        yield listener


def connect(listener):
    return socket.create_connection(("localhost", listener.port), timeout=60)


def line(time, x=0.0):
    return json.dumps({"time": time, "points": {"a": [x, 0, 0]}}).encode() + b"\n"


def wait(condition, seconds=60.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "nothing has arrived"
        time.sleep(0.005)


def test_the_newest_sample_wins(listener):
    assert listener.take() is None and listener.silence == float("inf")
    with connect(listener) as sender:
        for number in range(50):
            sender.sendall(line(number / 100, number))
        wait(lambda: listener.counts.received == 50)
        sample = listener.take()
        assert sample is not None and sample.time == 0.49 and sample.points["a"][0] == 49
        assert listener.take() is None
        assert listener.counts == (50, 0, 49, 0) and listener.is_connected and listener.silence < float("inf")
    wait(lambda: not listener.is_connected)


def test_bad_lines_are_dropped_and_counted(listener):
    with connect(listener) as sender:
        sender.sendall(line(1.0) + b"nonsense\n\n" + b'{"time": 2, "points": {"a": 3}}\n' + line(0.9) + line(1.0))
        sender.sendall(b"x" * (3 * MAX_LINE) + b"\n" + line(3.0, 7))
        wait(lambda: listener.counts.received == 2)
        assert listener.counts.bad == 5  # the empty line is none
        sample = listener.take()
        assert sample is not None and sample.points["a"][0] == 7
        assert "at most" in listener.last_error


def test_a_line_may_arrive_in_pieces(listener):
    with connect(listener) as sender:
        for byte in line(1.0, 5):
            sender.sendall(bytes([byte]))
        wait(lambda: listener.counts.received == 1)
        assert listener.counts.bad == 0


def test_time_that_goes_far_back_begins_anew(listener):
    with connect(listener) as sender:
        sender.sendall(line(10.0) + line(2.0, 3))
        wait(lambda: listener.counts.received == 2)
        assert listener.counts.bad == 0


def test_a_request_of_a_browser_is_closed(listener):
    body = line(1.0)
    with connect(listener) as sender:
        sender.sendall(b"POST / HTTP/1.1\r\nHost: localhost\r\nContent-Length: 50\r\n\r\n" + body)
        with contextlib.suppress(ConnectionResetError):
            assert sender.recv(1) == b""
    wait(lambda: listener.counts.rejected == 1)
    assert listener.counts.received == 0 and listener.take() is None


def test_a_new_sender_replaces_the_one_before(listener):
    with connect(listener) as first:
        first.sendall(line(100.0, 1))
        wait(lambda: listener.counts.received == 1)
        with connect(listener) as second:
            second.sendall(line(0.1, 2))  # with a clock of its own
            wait(lambda: listener.counts.received == 2)
            sample = listener.take()
            assert sample is not None and sample.points["a"][0] == 2
            with contextlib.suppress(ConnectionResetError):
                assert first.recv(1) == b""


def test_a_port_that_is_taken(listener):
    with pytest.raises(ValueError, match=f"source: expected a free port at localhost, got {listener.port}"):
        PointListener("localhost", listener.port)
    with pytest.raises(ValueError, match="expected an address of this machine"):
        PointListener("nowhere.invalid", 0)


def test_closing_ends_the_thread_and_frees_the_port():
    listener = PointListener("localhost", 0)
    listener.close()
    PointListener("localhost", listener.port).close()
