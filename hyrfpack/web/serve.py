"""A page and the files that it plays, from disk or from memory, served to browsers of this machine."""

from __future__ import annotations

import contextlib
import errno
import io
import os
import re
import socket
import sys
import threading
import webbrowser
from collections.abc import Callable, Iterator, Mapping
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, BinaryIO

from hyrfpack.errors import HyrfError

LOCAL = "127.0.0.1"
BINARY = "application/octet-stream"
PIECE = 1 << 18  # bytes of a file that are held at once
POLL_SECONDS = 0.1  # that a server in a thread takes to end, at most
_RANGE = re.compile(r"bytes=(\d*)-(\d*)", re.ASCII)


class MemoryFile:
    """A file that is served from memory and may be replaced meanwhile; each request gets one whole version of it."""

    def __init__(self, data: bytes) -> None:
        self._version = 0, data

    def replace(self, data: bytes) -> None:
        """Give it another content: its ETag changes, too."""
        self._version = self._version[0] + 1, data

    def open(self) -> tuple[BinaryIO, int, str]:
        """The present version to be read, its length in bytes and its ETag."""
        number, data = self._version
        return io.BytesIO(data), len(data), f'"{number:x}-{len(data):x}"'


Files = Mapping[str, str | os.PathLike[str] | MemoryFile]


def serve(
    page: bytes,
    files: Files | None = None,
    *,
    host: str = LOCAL,
    port: int = 0,
    open_browser: bool,
    say: Callable[[str], None],
) -> None:
    """Serve a page, and files beside it, until interrupted (Ctrl-C), which is how it ends without an error.

    Files on disk are read in pieces as they are asked for, whole or in ranges of bytes (RFC 9110, one range a
    request); one that has changed meanwhile has another ETag, and one that has gone is not found.

    Args:
        page: HTML, UTF-8, at "/".
        files: what else there is, by the name that follows "/" in its address.
        host: the address to listen at. Others than the default let other machines look.
        port: to listen at, 0 to 65535; 0 takes a free one.
        open_browser: whether to open the page in the person's browser.
        say: told the page's address, once it can be opened.

    Raises:
        HyrfError: nothing can listen there.
    """
    with _server(host, port, page, files or {}) as server:
        address = _address(host, server)
        say(address)
        if open_browser:  # beside us: some browsers do not return before they are closed
            threading.Thread(target=webbrowser.open, args=(address,), daemon=True).start()
        with contextlib.suppress(KeyboardInterrupt):
            server.serve_forever()


@contextlib.contextmanager
def serving(page: bytes, files: Files, *, port: int = 0) -> Iterator[str]:
    """Serve a page and files to this machine in a thread, while the block runs; gives the page's address.

    Args:
        page, files, port: as of `serve`.

    Raises:
        HyrfError: nothing can listen at this port.
    """
    with _server(LOCAL, port, page, files) as server:
        thread = threading.Thread(target=server.serve_forever, args=(POLL_SECONDS,), daemon=True)
        thread.start()
        try:
            yield _address(LOCAL, server)
        finally:
            server.shutdown()
            thread.join()
            server.page, server.files = b"", {}  # for connections that browsers keep open


def _address(host: str, server: _Server) -> str:
    name = f"[{host}]" if ":" in host else host
    return f"http://{name}:{server.server_port}/"


class _Server(ThreadingHTTPServer):
    page = b""
    files: Mapping[str, Path | MemoryFile] = {}

    def handle_error(self, request: Any, client_address: Any) -> None:
        if not isinstance(sys.exc_info()[1], (ConnectionError, TimeoutError)):  # the browser went away
            super().handle_error(request, client_address)


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    timeout = 60  # s: a silent browser does not keep a thread for ever
    server: _Server

    def do_GET(self) -> None:
        path = self.path.partition("?")[0]
        if path == "/":
            self._head(HTTPStatus.OK, "text/html; charset=utf-8", len(self.server.page))
            if self.command == "GET":
                self.wfile.write(self.server.page)
        elif path in self.server.files:
            self._file(self.server.files[path])
        else:
            self.send_error(HTTPStatus.NOT_FOUND)

    do_HEAD = do_GET

    def _file(self, served: Path | MemoryFile) -> None:
        try:
            file, size, tag = served.open() if isinstance(served, MemoryFile) else _open_on_disk(served)
        except OSError:
            self.send_error(HTTPStatus.NOT_FOUND, explain="The file that was served here is gone or cannot be read.")
            return
        with file:
            shared = {"Accept-Ranges": "bytes", "ETag": tag}
            part = self._asked(size, tag)
            if part is None:
                self._head(HTTPStatus.OK, BINARY, size, shared)
                part = range(size)
            elif part:
                extent = f"bytes {part.start}-{part.stop - 1}/{size}"
                self._head(HTTPStatus.PARTIAL_CONTENT, BINARY, len(part), {**shared, "Content-Range": extent})
            else:
                none = {**shared, "Content-Range": f"bytes */{size}"}
                self._head(HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE, BINARY, 0, none)
            if self.command == "GET":
                self._send(file, part)

    def _asked(self, size: int, tag: str) -> range | None:
        """The bytes that are asked for; an empty range for some beyond the end; None for all, or what is not known."""
        asked, only_if = self.headers.get("Range"), self.headers.get("If-Range")
        match = _RANGE.fullmatch(asked.strip()) if asked else None
        if match is None or self.command != "GET" or (only_if is not None and only_if.strip() != tag):
            return None
        first, last = match.groups()
        if not first:
            return None if not last else range(max(0, size - int(last)), size)
        if last and int(last) < int(first):
            return None
        return range(min(int(first), size), min(int(last) + 1, size) if last else size)

    def _send(self, file: BinaryIO, part: range) -> None:
        """Send a part of a file; where it has become shorter meanwhile, what was promised ends with the connection."""
        file.seek(part.start)
        left = len(part)
        while left and (piece := file.read(min(PIECE, left))):
            self.wfile.write(piece)
            left -= len(piece)
        self.close_connection = self.close_connection or left > 0

    def _head(self, status: HTTPStatus, kind: str, length: int, more: Mapping[str, str] | None = None) -> None:
        self.send_response(status)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(length))
        self.send_header("Cache-Control", "no-store")
        self.send_header("X-Content-Type-Options", "nosniff")
        for name, value in (more or {}).items():
            self.send_header(name, value)
        self.end_headers()

    def log_message(self, format: str, *args: object) -> None:
        """Requests are nobody's news."""


def _open_on_disk(path: Path) -> tuple[BinaryIO, int, str]:
    """A file to be read, its length in bytes and its ETag. Raises OSError."""
    if not path.is_file():  # asked before opening: opening a pipe would wait for a writer
        raise FileNotFoundError(path)
    file = path.open("rb")
    status = os.fstat(file.fileno())
    return file, status.st_size, f'"{status.st_ino:x}-{status.st_mtime_ns:x}-{status.st_size:x}"'


def _server(host: str, port: int, page: bytes, files: Files) -> _Server:
    """A server that listens and does not answer yet."""

    class Server(_Server):
        address_family = socket.AF_INET6 if ":" in host else socket.AF_INET

    if not host.strip():  # to the socket, this is every address
        raise HyrfError(f"'{host}' is not an address to listen at; name {LOCAL}, or 0.0.0.0 to let others look")
    try:
        server = Server((host, port), _Handler)
    except (OSError, UnicodeError) as error:  # the latter of a name that can be none
        if getattr(error, "errno", None) == errno.EADDRINUSE:
            raise HyrfError(
                f"port {port} of {host} is taken by another program; name another, or 0 for any free one"
            ) from error
        reason = getattr(error, "strerror", None) or error
        raise HyrfError(f"nothing can listen at port {port} of {host} ({reason}); name another port or host") from error
    server.page = page
    server.files = {f"/{name}": file if isinstance(file, MemoryFile) else Path(file) for name, file in files.items()}
    return server
