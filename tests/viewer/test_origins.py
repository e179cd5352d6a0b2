"""Which pages may talk to a view."""

import socket

import pytest

from mimic.viewer.origins import accepted_names, is_local, objection

LOCAL = accepted_names("127.0.0.1")


@pytest.mark.parametrize(
    ("host", "origin"),
    [
        ("127.0.0.1:8080", "http://127.0.0.1:8080"),
        ("localhost:8080", "http://localhost:8080"),
        ("LOCALHOST:8080", "http://localhost:8080"),
        ("[::1]:8080", "http://[::1]:8080"),
        ("localhost:9000", "http://localhost:9000"),  # through ssh -L 9000:localhost:8080
        ("localhost", "https://localhost"),
        ("192.168.1.5:8080", "http://192.168.1.5:8080"),  # where the server can be reached at that address
        ("127.0.0.1:8080", None),  # no browser
    ],
)
def test_the_own_page_is_accepted(host, origin):
    assert objection(host, origin, LOCAL) == ""


@pytest.mark.parametrize(
    ("host", "origin", "reason"),
    [
        ("127.0.0.1:8080", "http://evil.example", "Origin 'http://evil.example'"),
        ("127.0.0.1:8080", "http://192.168.1.5:8080", "Origin"),  # a site with an address for a name
        ("127.0.0.1:8080", "http://127.0.0.1:3000", "Origin"),  # another server of this machine
        ("127.0.0.1:8080", "http://localhost:8080", "Origin"),
        ("127.0.0.1:8080", "null", "Origin"),  # a frame in a sandbox
        ("127.0.0.1:8080", "", "Origin"),
        ("evil.example:8080", "http://evil.example:8080", "Host 'evil.example:8080'"),  # a name that leads here
        ("127.0.0.1.evil.example", None, "Host"),
        ("127.0.0.1:8080,evil.example", None, "Host"),  # two headers
        ("evil.example@127.0.0.1", None, "Host"),
        ("", None, "Host"),
        ("[::1", None, "Host"),
        (f"{socket.gethostname()}x:8080", None, "Host"),
    ],
)
def test_other_pages_are_rejected(host, origin, reason):
    assert objection(host, origin, LOCAL).startswith(reason)


def test_a_server_that_others_can_reach_has_the_name_of_the_machine():
    host = f"{socket.gethostname()}:8080"
    assert objection(host, f"http://{host}".lower(), accepted_names("0.0.0.0")) == ""
    assert objection("evil.example", None, accepted_names("0.0.0.0"))
    assert objection("robot.example", None, accepted_names("robot.example")) == ""


@pytest.mark.parametrize(
    ("host", "local"),
    [("127.0.0.1", True), ("localhost", True), ("::1", True), ("0.0.0.0", False), ("::", False), ("192.0.2.7", False)],
)
def test_who_can_reach_an_address(host, local):
    assert is_local(host) == local
