"""Serve a folder and the project's files to a browser, which runs no modules from files on disk."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

PROJECT_FOLDER = Path(__file__).parents[2]


class _Handler(SimpleHTTPRequestHandler):
    extensions_map = {**SimpleHTTPRequestHandler.extensions_map, ".js": "text/javascript", ".mjs": "text/javascript"}

    def __init__(self, *arguments: object, own: Path) -> None:
        self.own = own
        super().__init__(*arguments, directory=str(PROJECT_FOLDER))

    def translate_path(self, path: str) -> str:
        if path.startswith("/own/"):
            return str(self.own / path.removeprefix("/own/").partition("?")[0])
        return super().translate_path(path)

    def end_headers(self) -> None:
        self.send_header("Cache-Control", "no-store")
        super().end_headers()

    def log_message(self, format: str, *arguments: object) -> None:
        """Do not print requests."""


@contextmanager
def serve_project(own: Path) -> Iterator[str]:
    """Serve the project's folder, and the folder `own` as `own/`; yield the address."""
    with ThreadingHTTPServer(("127.0.0.1", 0), partial(_Handler, own=own)) as server:
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        try:
            yield f"http://127.0.0.1:{server.server_port}"
        finally:
            server.shutdown()
            thread.join()
