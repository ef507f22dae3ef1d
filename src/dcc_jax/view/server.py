"""Where the page is: host, port, address."""

from __future__ import annotations

import contextlib
import errno
import io
import ipaddress
import socket

import viser

ATTEMPTS = 50  # ports, from the one asked for


def free_port(host: str, port: int) -> int:
    """The port, or the next one that is free.

    Raises:
        ValueError: the host is none of this machine's, or no port is free.
    """
    last = min(port + ATTEMPTS - 1, 65535)
    for candidate in range(port, last + 1):
        try:
            with _socket(host) as probe:
                probe.bind((host, candidate))
        except socket.gaierror as error:
            raise ValueError(
                f"host must be an address of this machine, got {host!r}: {error}"
            ) from None
        except PermissionError:
            raise ValueError(
                f"port {candidate} is not allowed here; choose one from 1024 on"
            ) from None
        except OSError as error:
            if error.errno == errno.EADDRNOTAVAIL:
                raise ValueError(
                    f"host must be an address of this machine, got {host!r}"
                ) from None
        else:
            return candidate
    raise ValueError(f"no free port from {port} to {last}; choose another --port")


def start(host: str, port: int) -> viser.ViserServer:
    """A page without anything on it yet. It says nothing by itself."""
    with contextlib.redirect_stdout(io.StringIO()):
        return viser.ViserServer(host, port, label="dcc_jax", verbose=False)


def is_loopback(host: str) -> bool:
    """Whether only this machine reaches it."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def address(host: str, port: int) -> str:
    """What to open in a browser."""
    everywhere = host in ("0.0.0.0", "::", "")
    name = "localhost" if everywhere else f"[{host}]" if ":" in host else host
    return f"http://{name}:{port}"


def who_can_reach(host: str, port: int) -> str:
    """A warning where more than this machine can; else nothing."""
    if is_loopback(host):
        return ""
    return (
        f"anyone who can reach this machine on port {port} ({host}) can watch, pull "
        "and save films: there is no password"
    )


def _socket(host: str) -> socket.socket:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    probe = socket.socket(family, socket.SOCK_STREAM)
    # As the server does: a port that was in use a moment ago is free.
    probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    return probe
