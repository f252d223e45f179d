"""Connections to the port at which the main process watches the others."""

from __future__ import annotations

import socket
import time
from threading import Thread

import pytest

from hyrfpack.parallel import peer_watch

GROUP_TOKEN = "0123456789abcdef"


def accept_after(*greetings: bytes) -> dict[int, socket.socket]:
    """Return the connections that process 0 of two accepts, given what clients send one after the other."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        clients = [socket.create_connection(server.getsockname()) for _ in greetings]

        def send() -> None:
            for client, greeting in zip(clients, greetings, strict=True):
                try:
                    client.sendall(greeting)
                except OSError:  # The server has closed the connection of a foreign client.
                    pass

        Thread(target=send, daemon=True).start()
        connections = peer_watch._accept(server, 2, GROUP_TOKEN)
        for connection in (*clients, *connections.values()):
            connection.close()
        return connections


@pytest.mark.parametrize(
    "foreign",
    [
        b"\x16\x03\x01\xff\xfe",
        b"x" * 1_000_000,
        b"\n",
        b"wrong 1\n",
        GROUP_TOKEN.encode() + b" 7\n",
        GROUP_TOKEN.encode() + b" \xb2\n",
    ],
    ids=["TLS", "endless", "empty", "token", "rank", "digit"],
)
def test_foreign_clients_are_dropped_and_the_peer_is_accepted(foreign, monkeypatch):
    monkeypatch.setattr(peer_watch, "GREETING_SECONDS", 0.2)
    assert list(accept_after(foreign, f"{GROUP_TOKEN} 1\n".encode())) == [1]


def test_a_silent_client_does_not_delay_the_peer_for_long(monkeypatch):
    monkeypatch.setattr(peer_watch, "GREETING_SECONDS", 0.2)
    start = time.monotonic()
    assert list(accept_after(b"", f"{GROUP_TOKEN} 1\n".encode())) == [1]
    assert time.monotonic() - start < peer_watch.CONNECT_SECONDS / 2
