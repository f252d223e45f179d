"""Notice that another process of a group has ended, also while this one waits for a GPU.

Gloo notices by itself that a peer has ended. NCCL does not: a collective operation is only queued on the GPU, and waits
there for the peer forever. So each process keeps a TCP connection to process 0, which the system closes when its
process ends, also by a crash. Process 0 tells the others which process has ended.
"""

from __future__ import annotations

import hmac
import logging
import secrets
import socket
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from threading import Lock, Thread

_LOG = logging.getLogger(__name__)

CONNECT_SECONDS = 60.0
# A process sends its token and rank as soon as it is connected. A connection without them is closed after this time.
GREETING_SECONDS, MAX_GREETING_BYTES = 5.0, 64
# A machine that is switched off closes no connection. The system then sends probes: the first after 30 s without data,
# and after 6 of them without an answer, 10 s apart, the connection counts as closed.
KEEPALIVE_OPTIONS = {"TCP_KEEPIDLE": 30, "TCP_KEEPINTVL": 10, "TCP_KEEPCNT": 6}
# Lines that processes send: "bye" before a process leaves as planned, "lost N" from process 0.
LEAVING_WORD, LOST_WORD = "bye", "lost"


class PeerWatch:
    """Watches connections to other processes of the group in threads, until it is closed.

    Attributes:
        lost: the rank of the first process that ended without having left; None if there is none.
    """

    def __init__(self, connections: Mapping[int, socket.socket], on_loss: Callable[[], object]) -> None:
        """Begin to watch.

        Args:
            connections: a connection to each watched process, by its rank.
            on_loss: called once, in another thread, when a process is lost.
        """
        self.lost: int | None = None
        self._connections, self._on_loss = dict(connections), on_loss
        self._closed, self._lock = False, Lock()
        for peer, connection in self._connections.items():
            Thread(target=self._watch, args=(peer, connection), name=f"watch of process {peer}", daemon=True).start()

    def close(self, *, failed: bool = False) -> None:
        """End the watch.

        Args:
            failed: whether this process leaves because of an error; the others then count it as lost.
        """
        self._closed = True
        for connection in self._connections.values():
            with suppress(OSError):
                if not failed:
                    connection.sendall(f"{LEAVING_WORD}\n".encode())
                connection.shutdown(socket.SHUT_RDWR)
            connection.close()

    def _watch(self, peer: int, connection: socket.socket) -> None:
        with suppress(OSError, ValueError), connection.makefile() as lines:
            for line in lines:
                word, _, rank = line.strip().partition(" ")
                if word == LOST_WORD:
                    self._lose(int(rank))
                return
        self._lose(peer)

    def _lose(self, rank: int) -> None:
        with self._lock:
            if self._closed or self.lost is not None:
                return
            self.lost = rank
        for peer, connection in self._connections.items():
            if peer != rank:
                with suppress(OSError):
                    connection.sendall(f"{LOST_WORD} {rank}\n".encode())
        self._on_loss()


def connect_to_peers(
    rank: int,
    size: int,
    address: str,
    share: Callable[[tuple[int, str]], tuple[int, str]],
    on_loss: Callable[[], object],
) -> PeerWatch:
    """Connect the processes of a group, all of which call this, and begin to watch.

    Args:
        rank, size: number of this process, and number of processes.
        address: the name or address of the machine of process 0.
        share: returns process 0's object on all processes.
        on_loss: see `PeerWatch`.

    Returns:
        The watch. A process that could not connect in time watches nothing, and logs a warning.
    """
    if rank == 0:
        has_ipv6 = socket.has_dualstack_ipv6()
        family = socket.AF_INET6 if has_ipv6 else socket.AF_INET
        with socket.create_server(("", 0), family=family, backlog=size, dualstack_ipv6=has_ipv6) as server:
            token = secrets.token_hex(16)
            share((server.getsockname()[1], token))
            return PeerWatch(_accept(server, size, token), on_loss)
    port, token = share((0, ""))
    try:
        connection = socket.create_connection((address, port), CONNECT_SECONDS)
        connection.sendall(f"{token} {rank}\n".encode())
    except OSError as error:
        _LOG.warning(f"process {rank} cannot watch process 0 at {address}:{port} ({error}); if that ends, it may hang")
        return PeerWatch({}, on_loss)
    return PeerWatch({0: _keep_alive(connection)}, on_loss)


def _accept(server: socket.socket, size: int, token: str) -> dict[int, socket.socket]:
    """Accept the connections of all other processes, and drop others that do not know the token."""
    connections: dict[int, socket.socket] = {}
    server.settimeout(CONNECT_SECONDS)
    while len(connections) < size - 1:
        try:
            connection, _ = server.accept()
        except OSError:
            _LOG.warning(
                f"only {len(connections)} of {size - 1} other processes are watched; if one ends, this may hang"
            )
            break
        with suppress(OSError, ValueError):
            received_token, _, rank = _read_greeting(connection).partition(b" ")
            if hmac.compare_digest(received_token, token.encode()) and 0 < int(rank) < size:
                connections[int(rank)] = _keep_alive(connection)
                continue
        connection.close()
    return connections


def _read_greeting(connection: socket.socket) -> bytes:
    """Read the first line of a connection, which anyone may have opened.

    It reads at most MAX_GREETING_BYTES, for at most GREETING_SECONDS.

    Raises:
        OSError: the line did not arrive in time.
    """
    deadline, line = time.monotonic() + GREETING_SECONDS, b""
    while not line.endswith(b"\n") and len(line) < MAX_GREETING_BYTES:
        connection.settimeout(max(1e-3, deadline - time.monotonic()))
        received = connection.recv(MAX_GREETING_BYTES - len(line))
        if not received:
            break
        line += received
    return line.strip()


def _keep_alive(connection: socket.socket) -> socket.socket:
    """Make a connection wait for data without a limit, and notice when the other machine has gone."""
    connection.settimeout(None)
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for name, value in KEEPALIVE_OPTIONS.items():
        if hasattr(socket, name):
            connection.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)
    return connection
