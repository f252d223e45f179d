"""A server whose answers tests choose, and files that are dropped on a page."""

from __future__ import annotations

import base64
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import unquote

from web.pages import Browser, random_splats

from hyrfpack.splats.formats import spz
from hyrfpack.splats.formats.hints import Hints
from hyrfpack.web.player import encode_element_script, encode_player, encode_player_files

GOLDEN_FILE_DATA = (Path(__file__).parents[1] / "golden" / "v1.1_compact.hyrf").read_bytes()


@dataclass
class Site:
    """The state of a server whose answers tests choose.

    Attributes:
        address: URL of the server, without a path.
        files: content of each path; the suffix determines the content type.
        headers: headers sent with every answer.
        breaks: number of bytes of a .hyrf file after which the connection breaks, or None.
        always: whether it breaks in every request and not only in those from the start of the file.
        ranges: whether the server honours Range headers.
        requests: (path, Range header or None) of each request, in order.
    """

    address: str = ""
    files: dict[str, bytes] = field(default_factory=dict)
    headers: dict[str, str] = field(default_factory=dict)
    breaks: int | None = None
    always: bool = False
    ranges: bool = True
    requests: list[tuple[str, str | None]] = field(default_factory=list)


@contextmanager
def serve_site() -> Iterator[Site]:
    server_state = Site()

    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def do_GET(self) -> None:
            path, byte_range = unquote(self.path.partition("?")[0]), self.headers.get("Range")
            server_state.requests.append((path, byte_range))
            data = server_state.files.get(path)
            if data is None:
                self.send_error(404)
                return
            start = (byte_range or "bytes=0-").removeprefix("bytes=").removesuffix("-")
            first = int(start) if server_state.ranges else 0
            self.send_response(206 if first else 200)
            kind = {"html": "text/html; charset=utf-8", "js": "text/javascript", "css": "text/css"}.get(
                path.rpartition(".")[2]
            )
            self.send_header("Content-Type", kind or "application/octet-stream")
            self.send_header("Content-Length", str(len(data) - first))
            if first:
                self.send_header("Content-Range", f"bytes {first}-{len(data) - 1}/{len(data)}")
            for name, value in server_state.headers.items():
                self.send_header(name, value)
            self.end_headers()
            if path.endswith(".hyrf") and server_state.breaks is not None and (server_state.always or not first):
                self.wfile.write(data[first : first + server_state.breaks])
                self.wfile.flush()
                time.sleep(0.2)
                self.close_connection = True
                self.connection.shutdown(2)
            else:
                self.wfile.write(data[first:])

        def log_message(self, format: str, *arguments: object) -> None:
            """Do not print requests."""

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        server_state.address = f"http://127.0.0.1:{server.server_port}"
        threading.Thread(target=server.serve_forever, daemon=True).start()
        try:
            yield server_state
        finally:
            server.shutdown()


@contextmanager
def serve_player() -> Iterator[Site]:
    """Serve a player, the script that embeds it, and two files."""
    with serve_site() as server_state:
        server_state.files = {
            "/index.html": encode_player("player"),
            "/some scene.hyrf": GOLDEN_FILE_DATA,
            "/cloud.spz": spz.encode(random_splats(300), Hints(spz_version=3)),
            "/hyrf-viewer.js": encode_element_script(),
            **{f"/{name}": data for name, data in encode_player_files().items()},
        }
        yield server_state


def drop_file(browser: Browser, data: bytes, name: str) -> None:
    """Drop a file with this content and name on the page."""
    browser.evaluate(
        f"""(() => {{
            const bytes = Uint8Array.from(atob("{base64.b64encode(data).decode()}"), (letter) => letter.charCodeAt(0));
            const carried = new DataTransfer();
            carried.items.add(new File([bytes], {name!r}));
            for (const type of ["dragover", "drop"]) {{
                const event = new DragEvent(type, {{ dataTransfer: carried, bubbles: true, cancelable: true }});
                document.getElementById("view").dispatchEvent(event);
                if (!event.defaultPrevented) throw new Error("the browser would leave the page");
            }}
        }})()"""
    )
