"""A page and the file that it plays, served to browsers of this machine."""

from __future__ import annotations

import contextlib
import errno
import os
import re
import socket
import sys
import threading
import webbrowser
from collections.abc import Callable, Mapping
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, BinaryIO

from hyrfpack.errors import HyrfError

LOCAL = "127.0.0.1"
BINARY = "application/octet-stream"
PIECE = 1 << 18  # bytes of a file that are held at once
_RANGE = re.compile(r"bytes=(\d*)-(\d*)", re.ASCII)


def serve(
    page: bytes,
    files: Mapping[str, str | os.PathLike[str]] | None = None,
    *,
    host: str = LOCAL,
    port: int = 0,
    open_browser: bool,
    say: Callable[[str], None],
) -> None:
    """Serve a page, and files beside it, until interrupted (Ctrl-C), which is how it ends without an error.

    Files are read from disk in pieces as they are asked for, whole or in ranges of bytes (RFC 9110, one range a
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
    with _server(host, port) as server:
        server.page, server.files = page, {f"/{name}": Path(path) for name, path in (files or {}).items()}
        name = f"[{host}]" if ":" in host else host
        address = f"http://{name}:{server.server_port}/"
        say(address)
        if open_browser:  # beside us: some browsers do not return before they are closed
            threading.Thread(target=webbrowser.open, args=(address,), daemon=True).start()
        with contextlib.suppress(KeyboardInterrupt):
            server.serve_forever()


class _Server(ThreadingHTTPServer):
    page = b""
    files: Mapping[str, Path] = {}

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

    def _file(self, path: Path) -> None:
        try:
            if not path.is_file():  # asked before opening: opening a pipe would wait for a writer
                raise FileNotFoundError(path)
            file = path.open("rb")
        except OSError:
            self.send_error(HTTPStatus.NOT_FOUND, explain="The file that was served here is gone or cannot be read.")
            return
        with file:
            status = os.fstat(file.fileno())
            size, tag = status.st_size, f'"{status.st_ino:x}-{status.st_mtime_ns:x}-{status.st_size:x}"'
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


def _server(host: str, port: int) -> _Server:
    class Server(_Server):
        address_family = socket.AF_INET6 if ":" in host else socket.AF_INET

    if not host.strip():  # to the socket, this is every address
        raise HyrfError(f"'{host}' is not an address to listen at; name {LOCAL}, or 0.0.0.0 to let others look")
    try:
        return Server((host, port), _Handler)
    except (OSError, UnicodeError) as error:  # the latter of a name that can be none
        if getattr(error, "errno", None) == errno.EADDRINUSE:
            raise HyrfError(
                f"port {port} of {host} is taken by another program; name another, or 0 for any free one"
            ) from error
        reason = getattr(error, "strerror", None) or error
        raise HyrfError(f"nothing can listen at port {port} of {host} ({reason}); name another port or host") from error
