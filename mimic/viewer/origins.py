"""Which pages may talk to the server of a view: those that it served itself, at a name of its own.

Every page in a browser can connect to a server on the same machine. The browser names the page's site in the header
Origin, and in the header Host the name that the user, or a site that resolves to this machine, used for the server.
"""

import ipaddress
import re
import socket

_HOST = re.compile(r"(\[[0-9a-f:.]+\]|[\w.-]+)(?::\d+)?")  # with a port; an IPv6 address in brackets
LOCAL_NAMES = ("localhost", "127.0.0.1", "::1")


def accepted_names(host: str) -> frozenset[str]:
    """Names and addresses of the server that a request may use: the local ones, `host` and its addresses.

    If `host` is every address of this machine (0.0.0.0 or ::), also the name of this machine.
    """
    names = {*LOCAL_NAMES, host.lower(), *_addresses(host)}
    if serves_all_addresses(host):
        names |= {socket.gethostname().lower(), socket.getfqdn().lower()}
    return frozenset(names - {"0.0.0.0", "::", ""})


def serves_all_addresses(host: str) -> bool:
    """Whether a server at `host` listens at every address of this machine."""
    return any(ipaddress.ip_address(address).is_unspecified for address in _addresses(host))


def is_local(host: str) -> bool:
    """Whether only this machine can reach a server at `host`."""
    addresses = _addresses(host)
    return bool(addresses) and all(ipaddress.ip_address(address).is_loopback for address in addresses)


def objection(host_header: str, origin: str | None, names: frozenset[str], any_address: bool = False) -> str:
    """The reason to reject a request; "" for a request to accept.

    Args:
      host_header: header Host.
      origin: header Origin; None from a program that is not a browser.
      names: see `accepted_names`.
      any_address: whether any IP address is accepted as Host: another site cannot make a browser send it.
    """
    name = _host_name(host_header)
    if name not in names and not (any_address and _is_address(name)):
        return f"Host {host_header[:80]!r}"
    if origin is not None and origin.partition("://")[2].lower() != host_header.strip().lower():
        return f"Origin {origin[:80]!r}"
    return ""


def _host_name(header: str) -> str:
    match = _HOST.fullmatch(header.strip().lower())
    return match[1].strip("[]").rstrip(".") if match else ""


def _is_address(name: str) -> bool:
    try:
        return bool(ipaddress.ip_address(name))
    except ValueError:
        return False


def _addresses(host: str) -> set[str]:
    try:
        entries = socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)
    except OSError:
        return set()
    return {str(entry[4][0]).partition("%")[0] for entry in entries}
