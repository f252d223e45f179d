"""A page served to browsers of this machine."""

from __future__ import annotations

import contextlib
import errno
import socket
import sys
import threading
import webbrowser
from collections.abc import Callable
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

from hyrfpack.errors import HyrfError

LOCAL = "127.0.0.1"


def serve(
    make_page: Callable[[], bytes],
    *,
    host: str = LOCAL,
    port: int = 0,
    open_browser: bool,
    say: Callable[[str], None],
) -> None:
    """Serve a page until interrupted (Ctrl-C), which is how it ends without an error.

    Args:
        make_page: gives HTML, UTF-8; called once it is sure that it can be served.
        host: the address to listen at. Others than the default let other machines look.
        port: to listen at, 0 to 65535; 0 takes a free one.
        open_browser: whether to open the page in the person's browser.
        say: told the page's address, once it can be opened.

    Raises:
        HyrfError: nothing can listen there.
    """
    with _server(host, port) as server:
        server.page = make_page()
        name = f"[{host}]" if ":" in host else host
        address = f"http://{name}:{server.server_port}/"
        say(address)
        if open_browser:  # beside us: some browsers do not return before they are closed
            threading.Thread(target=webbrowser.open, args=(address,), daemon=True).start()
        with contextlib.suppress(KeyboardInterrupt):
            server.serve_forever()


class _Server(ThreadingHTTPServer):
    page = b""

    def handle_error(self, request: Any, client_address: Any) -> None:
        if not isinstance(sys.exc_info()[1], (ConnectionError, TimeoutError)):  # the browser went away
            super().handle_error(request, client_address)


def _server(host: str, port: int) -> _Server:
    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"
        timeout = 60  # s: a silent browser does not keep a thread for ever
        server: _Server

        def do_GET(self) -> None:
            self._answer(with_body=True)

        def do_HEAD(self) -> None:
            self._answer(with_body=False)

        def _answer(self, with_body: bool) -> None:
            if self.path.partition("?")[0] != "/":
                self.send_error(HTTPStatus.NOT_FOUND)
                return
            self.send_response(HTTPStatus.OK)
            self.send_header("Content-Type", "text/html; charset=utf-8")
            self.send_header("Content-Length", str(len(self.server.page)))
            self.send_header("Cache-Control", "no-store")
            self.send_header("X-Content-Type-Options", "nosniff")
            self.end_headers()
            if with_body:
                self.wfile.write(self.server.page)

        def log_message(self, format: str, *args: object) -> None:
            """Requests are nobody's news."""

    class Server(_Server):
        address_family = socket.AF_INET6 if ":" in host else socket.AF_INET

    if not host.strip():  # to the socket, this is every address
        raise HyrfError(f"'{host}' is not an address to listen at; name {LOCAL}, or 0.0.0.0 to let others look")
    try:
        return Server((host, port), Handler)
    except (OSError, UnicodeError) as error:  # the latter of a name that can be none
        if getattr(error, "errno", None) == errno.EADDRINUSE:
            raise HyrfError(
                f"port {port} of {host} is taken by another program; name another, or 0 for any free one"
            ) from error
        reason = getattr(error, "strerror", None) or error
        raise HyrfError(f"nothing can listen at port {port} of {host} ({reason}); name another port or host") from error
