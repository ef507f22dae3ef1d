"""Where the page is."""

from __future__ import annotations

import socket

import pytest

pytest.importorskip("viser")

from dcc_jax.view import server


def test_next_free_port_is_taken_where_one_is_in_use():
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        found = server.free_port("127.0.0.1", port)
        assert port < found < port + server.ATTEMPTS


def test_no_free_port_is_one_clear_line(monkeypatch):
    class Busy(socket.socket):
        def bind(self, address):
            raise OSError(98, "Address already in use")

    monkeypatch.setattr(server.socket, "socket", Busy)
    with pytest.raises(ValueError, match="no free port from 9000 to 9049"):
        server.free_port("127.0.0.1", 9000)


@pytest.mark.parametrize("host", ["203.0.113.7", "no.such.host.invalid"])
def test_foreign_host_is_named(host):
    with pytest.raises(ValueError, match=f"host must be .*{host}"):
        server.free_port(host, 9000)


@pytest.mark.parametrize(
    ("host", "loopback", "page"),
    [
        ("127.0.0.1", True, "http://127.0.0.1:80"),
        ("localhost", True, "http://localhost:80"),
        ("::1", True, "http://[::1]:80"),
        ("0.0.0.0", False, "http://localhost:80"),
        ("192.168.0.7", False, "http://192.168.0.7:80"),
    ],
)
def test_who_can_reach_the_page_is_said(host, loopback, page):
    assert server.is_loopback(host) == loopback
    assert server.address(host, 80) == page
    assert ("anyone" in server.who_can_reach(host, 80)) != loopback
