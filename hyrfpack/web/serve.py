"""An HTTP server of a page and the files that it plays, from disk or from memory."""

from __future__ import annotations

import contextlib
import errno
import io
import ipaddress
import logging
import os
import re
import socket
import socketserver
import sys
import threading
import webbrowser
from collections.abc import Callable, Iterator, Mapping
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, BinaryIO, Protocol

from hyrfpack.errors import HyrfError

_LOG = logging.getLogger(__name__)

LOCAL_HOST, LOCAL_HOST_IPV6 = "127.0.0.1", "::1"
# Names by which browsers of this machine open the page, also through a forwarded port.
_LOCAL_NAMES = frozenset({LOCAL_HOST, "localhost", f"[{LOCAL_HOST_IPV6}]"})
# Addresses in other networks by IP version. They are reserved for documentation (RFC 5737, RFC 3849).
_REMOTE_HOSTS = {4: "192.0.2.1", 6: "2001:db8::1"}
MAX_PORT = 65_535
BINARY_CONTENT_TYPE = "application/octet-stream"
CHUNK_BYTES = 1 << 18  # bounds the memory that sending a large file takes
SHUTDOWN_POLL_SECONDS = 0.1  # bounds the time that a server in a thread takes to end
_RANGE_PATTERN = re.compile(r"bytes=(\d{0,100})-(\d{0,100})", re.ASCII)  # int() refuses more than 4,300 digits


class MemoryFile:
    """A file that is served from memory and can be replaced at any time; each request gets one whole version."""

    def __init__(self, data: bytes) -> None:
        self._version = 0, data

    def replace(self, data: bytes) -> None:
        """Replace the content of the file, which changes its ETag."""
        self._version = self._version[0] + 1, data

    def open(self) -> tuple[BinaryIO, int, str]:
        """Return the current version for reading, its length in bytes and its ETag."""
        number, data = self._version
        return io.BytesIO(data), len(data), f'"{number:x}-{len(data):x}"'


class OpenableFile(Protocol):
    """A file that is served and is not a file on disk, such as a `MemoryFile`."""

    def open(self) -> tuple[BinaryIO, int, str]:
        """Return the file for reading, its length in bytes and its ETag.

        Raises:
            OSError, HyrfError: the file cannot be read.
        """


ServedFiles = Mapping[str, str | os.PathLike[str] | OpenableFile]


def serve(
    page: bytes,
    files: ServedFiles | None = None,
    *,
    host: str = LOCAL_HOST,
    port: int = 0,
    open_browser: bool,
    on_ready: Callable[[str], None],
) -> None:
    """Serve a page and files until interrupted by Ctrl-C, which is the normal end.

    Files on disk are read in chunks on request, whole or by byte range (RFC 9110, one range for each request). A file
    that changes gets another ETag, and a file that is removed is not found.

    Args:
        page: HTML, UTF-8, which is served at "/".
        files: the files, by the name that follows "/" in their address.
        host: address to listen at. At an address of this machine alone, such as the default, the server refuses
            requests that name another host, so that no website can read the page through the user's browser (DNS
            rebinding). Any other address lets other machines connect; if it stands for all addresses of the machine
            ("0.0.0.0", "::"), one that they can open is logged.
        port: port to listen at, 0 to 65535; 0 takes a free one.
        open_browser: open the page in the user's browser.
        on_ready: called with the page's address for this machine, once it can be opened.

    Raises:
        HyrfError: the server cannot listen at this address.
    """
    with _create_server(host, port, page, files or {}) as server:
        address = _page_address(host, server)
        on_ready(address)
        if server.ip_address.is_unspecified:
            _LOG.info(f"other machines can open {_network_address(server)}")
        if open_browser:  # in a thread, because opening some browsers blocks until they are closed
            threading.Thread(target=webbrowser.open, args=(address,), daemon=True).start()
        with contextlib.suppress(KeyboardInterrupt):
            server.serve_forever()


@contextlib.contextmanager
def serve_in_thread(page: bytes, files: ServedFiles, *, port: int = 0) -> Iterator[str]:
    """Serve a page and files to this machine in a thread while the block runs, and yield the page's address.

    Args:
        page, files, port: as for `serve`.

    Raises:
        HyrfError: the server cannot listen at this port.
    """
    with _create_server(LOCAL_HOST, port, page, files) as server:
        thread = threading.Thread(target=server.serve_forever, args=(SHUTDOWN_POLL_SECONDS,), daemon=True)
        thread.start()
        try:
            yield _page_address(LOCAL_HOST, server)
        finally:
            server.shutdown()
            thread.join()
            server.is_ended = True  # connections that browsers keep open must get nothing from now on
            server.page, server.files = b"", {}


def _page_address(host: str, server: _Server) -> str:
    """Return the page's address for this machine, at which a server for `host` listens."""
    if server.ip_address.is_unspecified:  # browsers on Windows cannot open it
        host = LOCAL_HOST if server.ip_address.version == 4 else LOCAL_HOST_IPV6
    return f"http://{_host_in_address(host)}:{server.server_port}/"


def _network_address(server: _Server) -> str:
    """Return the page's address for other machines, which names this machine by its IP address, or else by its name."""
    try:
        with socket.socket(server.address_family, socket.SOCK_DGRAM) as probe:
            probe.connect((_REMOTE_HOSTS[server.ip_address.version], 9))  # this only chooses a route, and sends nothing
            host = probe.getsockname()[0]
    except OSError:  # there is no route to other networks
        host = socket.gethostname()
    return f"http://{_host_in_address(host)}:{server.server_port}/"


def _host_in_address(host: str) -> str:
    return f"[{host}]" if ":" in host else host


class _Server(ThreadingHTTPServer):
    page = b""
    files: Mapping[str, Path | OpenableFile] = {}
    is_ended = False
    allowed_hosts: frozenset[str] | None = None  # in the header Host of requests, without the port; None for any

    @property
    def ip_address(self) -> ipaddress.IPv4Address | ipaddress.IPv6Address:
        """The address at which the server listens; for IPv4 addresses that IPv6 contains, the IPv4 address."""
        address = ipaddress.ip_address(str(self.server_address[0]))
        return getattr(address, "ipv4_mapped", None) or address

    def server_bind(self) -> None:
        """Bind the socket; `HTTPServer` also looks up a name of the host, which may wait for a name server."""
        socketserver.TCPServer.server_bind(self)
        self.server_port = self.server_address[1]

    def handle_error(self, request: Any, client_address: Any) -> None:
        if not isinstance(sys.exc_info()[1], (ConnectionError, TimeoutError)):  # the browser has closed the connection
            super().handle_error(request, client_address)


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    timeout = 60  # seconds, so that an idle connection does not occupy a thread for ever
    server: _Server

    def do_GET(self) -> None:
        if not self._is_host_allowed():
            self.send_error(
                HTTPStatus.FORBIDDEN,
                explain="Only browsers of this machine can open this page, by the name localhost. "
                "To open it on another machine, forward its port (ssh -L), or use 'hyrfpack view' with host 0.0.0.0.",
            )
            return
        if self.server.is_ended:
            self.send_error(
                HTTPStatus.SERVICE_UNAVAILABLE, explain="The command that served this page has ended; start it again."
            )
            return
        path = self.path.partition("?")[0]
        if path == "/":
            self._send_headers(HTTPStatus.OK, "text/html; charset=utf-8", len(self.server.page))
            if self.command == "GET":
                self.wfile.write(self.server.page)
        elif path in self.server.files:
            self._send_file(self.server.files[path])
        else:
            self.send_error(HTTPStatus.NOT_FOUND)

    do_HEAD = do_GET

    def _is_host_allowed(self) -> bool:
        """Return whether the server may answer for the host that the request names. Browsers always name one."""
        allowed, requested = self.server.allowed_hosts, self.headers.get("Host")
        return allowed is None or requested is None or re.sub(r":\d*$", "", requested.strip()).lower() in allowed

    def _send_file(self, served: Path | OpenableFile) -> None:
        try:
            file, size, tag = _open_on_disk(served) if isinstance(served, Path) else served.open()
        except (OSError, HyrfError) as error:
            if isinstance(error, HyrfError):
                _LOG.warning(f"{error}")
            self.send_error(HTTPStatus.NOT_FOUND, explain="The file that was served here is gone or cannot be read.")
            return
        with file:
            shared = {"Accept-Ranges": "bytes", "ETag": tag}
            part = self._requested_range(size, tag)
            if part is None:
                self._send_headers(HTTPStatus.OK, BINARY_CONTENT_TYPE, size, shared)
                part = range(size)
            elif part:
                more = {**shared, "Content-Range": f"bytes {part.start}-{part.stop - 1}/{size}"}
                self._send_headers(HTTPStatus.PARTIAL_CONTENT, BINARY_CONTENT_TYPE, len(part), more)
            else:
                more = {**shared, "Content-Range": f"bytes */{size}"}
                self._send_headers(HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE, BINARY_CONTENT_TYPE, 0, more)
            if self.command == "GET":
                self._send_range(file, part)

    def _requested_range(self, size: int, tag: str) -> range | None:
        """Return the requested bytes of a file of `size` bytes.

        Returns:
            The range, which is empty for a request beyond the end; None for the whole file, also where the request
            names no range, has a form that is not supported, or is for another version of the file.
        """
        requested, only_if = self.headers.get("Range"), self.headers.get("If-Range")
        match = _RANGE_PATTERN.fullmatch(requested.strip()) if requested else None
        if match is None or self.command != "GET" or (only_if is not None and only_if.strip() != tag):
            return None
        first, last = match.groups()
        if not first:
            return None if not last else range(max(0, size - int(last)), size)
        if last and int(last) < int(first):
            return None
        return range(min(int(first), size), min(int(last) + 1, size) if last else size)

    def _send_range(self, file: BinaryIO, part: range) -> None:
        """Send a range of a file; if the file has become shorter meanwhile, close the connection after its end."""
        file.seek(part.start)
        left = len(part)
        while left and (chunk := file.read(min(CHUNK_BYTES, left))):
            self.wfile.write(chunk)
            left -= len(chunk)
        self.close_connection = self.close_connection or left > 0

    def _send_headers(self, status: HTTPStatus, kind: str, length: int, more: Mapping[str, str] | None = None) -> None:
        self.send_response(status)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(length))
        self.send_header("Cache-Control", "no-store")
        self.send_header("X-Content-Type-Options", "nosniff")
        for name, value in (more or {}).items():
            self.send_header(name, value)
        self.end_headers()

    def log_message(self, format: str, *args: object) -> None:
        """Print nothing, because users need no log of requests."""


def _open_on_disk(path: Path) -> tuple[BinaryIO, int, str]:
    """Open a file for reading and return it with its length in bytes and its ETag.

    Raises:
        OSError: it is not a regular file, or cannot be opened.
    """
    if not path.is_file():  # checked before opening, because opening a pipe would wait for a writer
        raise FileNotFoundError(path)
    file = path.open("rb")
    status = os.fstat(file.fileno())
    return file, status.st_size, f'"{status.st_ino:x}-{status.st_mtime_ns:x}-{status.st_size:x}"'


def _create_server(host: str, port: int, page: bytes, files: ServedFiles) -> _Server:
    """Create a server that listens but does not answer yet."""

    class Server(_Server):
        address_family = socket.AF_INET6 if ":" in host else socket.AF_INET
        allow_reuse_address = os.name != "nt"  # with it, Windows lets several programs listen at one port

    if not host.strip():  # a socket would listen at every address
        raise HyrfError(
            f"'{host}' is not an address to listen at",
            fix=f"use {LOCAL_HOST}, or 0.0.0.0 to allow connections from other machines",
        )
    if not 0 <= port <= MAX_PORT:
        raise HyrfError(f"{port} is not a port", fix=f"name one from 1 to {MAX_PORT}, or 0 for any free one")
    try:
        server = Server((host, port), _Handler)
    except (OSError, TypeError, UnicodeError) as error:  # a malformed host name gives the last two
        if getattr(error, "errno", None) == errno.EADDRINUSE:
            raise HyrfError(
                f"port {port} of {host} is taken by another program",
                fix="name another, or 0 for any free one",
            ) from error
        reason = getattr(error, "strerror", None) or error
        raise HyrfError(
            f"nothing can listen at port {port} of {host} ({reason})",
            fix="name another port or host",
        ) from error
    if server.ip_address.is_loopback:
        own_names = {_host_in_address(name).lower() for name in (host, str(server.ip_address))}
        server.allowed_hosts = _LOCAL_NAMES | own_names
    server.page = page
    server.files = {
        f"/{name}": Path(file) if isinstance(file, (str, os.PathLike)) else file for name, file in files.items()
    }
    return server
