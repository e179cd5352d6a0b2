"""Which pages may talk to the server of a view: those that it served itself.

Every page in a browser can connect to a server of the same machine. The browser names the page's site in the header
Origin, and in the header Host the name by which it reached the server. A site whose own name leads to this machine (DNS
rebinding) sends that name, so only addresses and the server's own names are accepted.
"""

import ipaddress
import re
import socket

_HOST = re.compile(r"(\[[0-9a-f:.]+\]|[\w.-]+)(?::\d+)?")  # with a port; an IPv6 address in brackets


def accepted_names(host: str) -> frozenset[str]:
    """Names that a request may use for a server at `host`, beside IP addresses."""
    own = () if is_local(host) else (socket.gethostname().lower(), socket.getfqdn().lower())
    return frozenset({"localhost", host.lower(), *own})


def is_local(host: str) -> bool:
    """Whether only this machine can reach a server at `host`."""
    try:
        entries = socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)
    except OSError:
        return False
    return all(ipaddress.ip_address(str(entry[4][0]).partition("%")[0]).is_loopback for entry in entries)


def objection(host: str, origin: str | None, names: frozenset[str]) -> str:
    """The reason to reject a request; "" for a request to accept.

    Args:
      host: header Host.
      origin: header Origin; None from a program that is not a browser, and for the page itself.
      names: see `accepted_names`.
    """
    match = _HOST.fullmatch(host.strip().lower())
    name = match[1].strip("[]").rstrip(".") if match else ""
    if name not in names and not _is_address(name):
        return f"Host {host[:80]!r}"
    if origin is not None and origin.partition("://")[2].lower() != host.strip().lower():
        return f"Origin {origin[:80]!r}"
    return ""


def _is_address(name: str) -> bool:
    try:
        return bool(ipaddress.ip_address(name))
    except ValueError:
        return False
