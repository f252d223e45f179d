"""The server serves a page and its file only to this machine, supports ranges and ends at an interrupt."""

from __future__ import annotations

import http.client
import logging
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from hyrfpack.errors import HyrfError
from hyrfpack.web import serve as serving
from hyrfpack.web.serve import CHUNK_BYTES, MemoryFile, serve

PAGE_HTML = b"<!DOCTYPE html><title>served</title>"
FILE_DATA = np.random.default_rng(0).bytes(3 * CHUNK_BYTES + 17)


@pytest.fixture
def scene_file(tmp_path: Path) -> Path:
    path = tmp_path / "room.hyrf"
    path.write_bytes(FILE_DATA)
    return path


@pytest.fixture
def port(scene_file: Path) -> Iterator[int]:
    """Start a server with a page and a file; yield its port."""
    with serving._create_server("127.0.0.1", 0, PAGE_HTML, {"scene.hyrf": scene_file}) as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.02,))
        thread.start()
        yield server.server_port
        server.shutdown()
        thread.join()


def send_request(
    port: int, path: str = "/scene.hyrf", method: str = "GET", **headers: str
) -> tuple[int, dict[str, str], bytes]:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=20)
    try:
        connection.request(method, path, headers={name.replace("_", "-"): value for name, value in headers.items()})
        answer = connection.getresponse()
        return answer.status, dict(answer.headers), answer.read()
    finally:
        connection.close()


def port_from_address(address: str) -> int:
    return int(address.rstrip("/").rpartition(":")[2])


def test_only_the_page_and_its_file_are_served(port, scene_file):
    status, headers, body = send_request(port, "/?content=any")
    assert (status, headers["Content-Type"], body) == (200, "text/html; charset=utf-8", PAGE_HTML)
    status, headers, body = send_request(port)
    assert (status, headers["Content-Type"], body) == (200, "application/octet-stream", FILE_DATA)
    assert headers["Accept-Ranges"] == "bytes" and headers["ETag"] and headers["X-Content-Type-Options"] == "nosniff"
    for path in ("/other", f"/{scene_file.name}", "/../room.hyrf", "/%2e%2e/room.hyrf", str(scene_file)):
        assert send_request(port, path)[0] == 404, path
    assert send_request(port, method="POST")[0] == 501


def test_a_head_request_returns_headers_without_a_body(port):
    for path, length in (("/", len(PAGE_HTML)), ("/scene.hyrf", len(FILE_DATA))):
        status, headers, body = send_request(port, path, "HEAD")
        assert (status, headers["Content-Length"], body) == (200, str(length), b"")


LAST_BYTE = len(FILE_DATA) - 1
FIRST_AND_LAST_BYTE_BY_RANGE = {
    "bytes=0-0": (0, 0),
    "bytes=5-9": (5, 9),
    f"bytes={CHUNK_BYTES - 1}-{2 * CHUNK_BYTES}": (CHUNK_BYTES - 1, 2 * CHUNK_BYTES),
    "bytes=100-": (100, LAST_BYTE),
    "bytes=-7": (LAST_BYTE - 6, LAST_BYTE),
    f"bytes=-{10 * len(FILE_DATA)}": (0, LAST_BYTE),
    f"bytes=10-{10 * len(FILE_DATA)}": (10, LAST_BYTE),
    f"bytes={LAST_BYTE}-": (LAST_BYTE, LAST_BYTE),
}


@pytest.mark.parametrize("byte_range", FIRST_AND_LAST_BYTE_BY_RANGE)
def test_a_range_request_returns_the_requested_bytes(byte_range, port):
    first, last = FIRST_AND_LAST_BYTE_BY_RANGE[byte_range]
    status, headers, body = send_request(port, Range=byte_range)
    assert (status, headers["Content-Range"], body) == (
        206,
        f"bytes {first}-{last}/{len(FILE_DATA)}",
        FILE_DATA[first : last + 1],
    )


@pytest.mark.parametrize("byte_range", [f"bytes={len(FILE_DATA)}-", f"bytes={10**30}-", "bytes=-0"])
def test_a_range_beyond_the_end_is_refused_with_the_length(byte_range, port):
    status, headers, body = send_request(port, Range=byte_range)
    assert (status, headers["Content-Range"], body) == (416, f"bytes */{len(FILE_DATA)}", b"")


@pytest.mark.parametrize(
    "byte_range",
    ["bytes=9-5", "bytes=", "bytes=-", "bytes=a-b", "lines=0-1", "bytes=0-1,5-6", "٣-٤", f"bytes={'9' * 5000}-"],
)
def test_an_invalid_range_is_ignored(byte_range, port):
    status, _, body = send_request(port, Range=byte_range.encode().decode("latin-1"))
    assert (status, body) == (200, FILE_DATA)


def test_a_changed_file_is_sent_whole_when_the_rest_of_the_old_one_is_requested(port, scene_file):
    tag = send_request(port)[1]["ETag"]
    assert send_request(port, Range="bytes=10-", If_Range=tag)[0] == 206
    scene_file.write_bytes(FILE_DATA[:1000])
    status, headers, body = send_request(port, Range="bytes=10-", If_Range=tag)
    assert (status, body) == (200, FILE_DATA[:1000]) and headers["ETag"] != tag


def test_a_deleted_file_is_not_found_until_it_exists_again(port, scene_file):
    scene_file.unlink()
    assert send_request(port)[0] == send_request(port, method="HEAD")[0] == 404
    scene_file.mkdir()
    assert send_request(port)[0] == 404
    scene_file.rmdir()
    scene_file.write_bytes(b"again")
    assert send_request(port)[2] == b"again"


def test_an_empty_file_is_served_and_has_no_ranges(port, scene_file):
    scene_file.write_bytes(b"")
    assert send_request(port)[::2] == (200, b"") and send_request(port, Range="bytes=0-")[0] == 416


def test_a_file_that_shrinks_while_it_is_sent_closes_the_connection_early(port, scene_file):
    with scene_file.open("r+b") as file:
        file.truncate(1 << 28)  # larger than the buffers of sockets
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=20)
    connection.request("GET", "/scene.hyrf")
    answer = connection.getresponse()
    os.truncate(scene_file, CHUNK_BYTES)
    with pytest.raises(http.client.IncompleteRead):
        answer.read()
    connection.close()


@pytest.mark.acceptance
def test_a_large_file_is_not_held_in_memory(tmp_path):
    large = tmp_path / "large.hyrf"
    with large.open("wb") as file:
        file.truncate(1 << 30)
    program = """
import resource, socket, sys, threading
from hyrfpack.web import serve
from pathlib import Path
with serve._create_server("127.0.0.1", 0, b"", {"scene.hyrf": Path(sys.argv[1])}) as server:
    threading.Thread(target=server.serve_forever, daemon=True).start()
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with socket.create_connection(("127.0.0.1", server.server_port)) as client:
        client.sendall(b"GET /scene.hyrf HTTP/1.0\\r\\n\\r\\n")
        total = 0
        while piece := client.recv(1 << 20):
            total += len(piece)
    print(total, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)
    server.shutdown()
"""
    done = subprocess.run(
        [sys.executable, "-c", program, large], capture_output=True, text=True, check=True, timeout=120
    )
    total, grown = map(int, done.stdout.split())
    assert total > 1 << 30 and grown < 32 << 10  # ru_maxrss is in kB


@pytest.mark.usefixtures("signals")
def test_serve_opens_the_browser_and_ends_at_an_interrupt_without_error(monkeypatch: pytest.MonkeyPatch):
    messages, received = [], []

    def visit(address: str) -> None:
        try:
            received.append(address)
            received.append(send_request(int(address.rsplit(":")[-1].strip("/")), "/")[2])
        finally:
            os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr("webbrowser.open", visit)
    serve(PAGE_HTML, open_browser=True, on_ready=messages.append)
    assert messages[0].startswith("http://127.0.0.1:") and received == [messages[0], PAGE_HTML]


def test_a_port_in_use_is_reported_in_one_sentence():
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(HyrfError, match=rf"^port {port} of 127.0.0.1 is taken by another program; [^\n]*$"):
            serve(PAGE_HTML, port=port, open_browser=False, on_ready=lambda address: None)


def test_on_windows_no_second_program_can_listen_at_the_same_port(monkeypatch: pytest.MonkeyPatch):
    with monkeypatch.context() as patch:
        patch.setattr(os, "name", "nt")
        server = serving._create_server("127.0.0.1", 0, PAGE_HTML, {})
    with server:
        assert server.socket.getsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR) == 0


def test_serve_looks_up_no_name_of_the_host(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(socket, "getfqdn", None)
    with serving.serve_in_thread(PAGE_HTML, {}) as address:
        assert send_request(port_from_address(address), "/")[2] == PAGE_HTML


def skip_without_ipv6(host: str) -> None:
    if ":" in host:
        try:
            socket.create_server((host, 0), family=socket.AF_INET6).close()
        except OSError:
            pytest.skip("there is no IPv6 here")


def replaced_getsockname(network_host: str) -> Callable[[socket.socket], tuple]:
    """Return a `getsockname` with which UDP sockets have this address."""
    getsockname = socket.socket.getsockname
    return lambda self: (network_host, 1) if self.type == socket.SOCK_DGRAM else getsockname(self)


@pytest.mark.parametrize(
    ("host", "local_name", "network_name"), [("0.0.0.0", "127.0.0.1", "198.51.100.7"), ("::", "[::1]", "[2001:db8::7]")]
)
def test_a_server_for_all_addresses_names_one_for_this_machine_and_one_for_others(
    host: str, local_name: str, network_name: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
):
    opened, said, is_opened = [], [], threading.Event()
    skip_without_ipv6(host)
    monkeypatch.setattr("webbrowser.open", lambda address: (opened.append(address), is_opened.set()))
    monkeypatch.setattr(serving._Server, "serve_forever", lambda server: is_opened.wait(60))
    monkeypatch.setattr(socket.socket, "connect", lambda probe, address: None)
    monkeypatch.setattr(socket.socket, "getsockname", replaced_getsockname(network_name.strip("[]")))
    with caplog.at_level(logging.INFO, "hyrfpack"):
        serve(PAGE_HTML, host=host, open_browser=True, on_ready=said.append)
    port = port_from_address(said[0])
    assert said == opened == [f"http://{local_name}:{port}/"]
    assert caplog.messages == [f"other machines can open http://{network_name}:{port}/"]


def test_without_a_network_the_server_names_its_machine(monkeypatch, caplog):
    def no_route(probe: socket.socket, address: tuple) -> None:
        raise OSError("Network is unreachable")

    said = []
    monkeypatch.setattr(serving._Server, "serve_forever", lambda server: None)
    monkeypatch.setattr(socket.socket, "connect", no_route)
    monkeypatch.setattr(socket, "gethostname", lambda: "studio")
    with caplog.at_level(logging.INFO, "hyrfpack"):
        serve(PAGE_HTML, host="0.0.0.0", open_browser=False, on_ready=said.append)
    assert caplog.messages == [f"other machines can open http://studio:{port_from_address(said[0])}/"]


# -- the header Host ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("path", ["/", "/scene.hyrf", "/other"])
@pytest.mark.parametrize("host", ["evil.example", "evil.example:80", "localhost.evil.example", "127.0.0.1.evil:1", ""])
def test_a_request_for_another_host_is_refused(host, path, port):
    status, headers, body = send_request(port, path, Host=host)
    assert status == 403 and b"by the name localhost" in body and "ETag" not in headers
    assert send_request(port, path, "HEAD", Host=host)[::2] == (403, b"")


@pytest.mark.parametrize(
    "host", ["localhost", "LocalHost:1234", "127.0.0.1:{port}", "127.0.0.1:8080", "[::1]", "[::1]:9"]
)
def test_a_request_for_this_machine_is_answered_also_through_a_forwarded_port(host, port):
    assert send_request(port, Host=host.format(port=port))[::2] == (200, FILE_DATA)


def test_a_request_that_names_no_host_is_answered(port):
    with socket.create_connection(("127.0.0.1", port), timeout=20) as client:
        client.sendall(b"GET / HTTP/1.0\r\n\r\n")
        assert client.makefile("rb").read().endswith(PAGE_HTML)


def test_any_host_is_answered_if_other_machines_can_connect():
    with serving._create_server("0.0.0.0", 0, PAGE_HTML, {}) as server:
        threading.Thread(target=server.serve_forever, args=(0.02,), daemon=True).start()
        assert send_request(server.server_port, "/", Host="studio.local")[0] == 200
        server.shutdown()


def test_a_name_of_this_machine_that_the_user_gave_is_answered(monkeypatch: pytest.MonkeyPatch):
    bind = socket.socket.bind
    monkeypatch.setattr(socket.socket, "bind", lambda self, address: bind(self, ("127.0.0.1", address[1])))
    with serving._create_server("Studio", 0, PAGE_HTML, {}) as server:
        threading.Thread(target=server.serve_forever, args=(0.02,), daemon=True).start()
        assert send_request(server.server_port, "/", Host=f"studio:{server.server_port}")[0] == 200
        assert send_request(server.server_port, "/", Host="studio.local")[0] == 403
        server.shutdown()


# -- addresses that cannot be used -------------------------------------------------------------------------------------


@pytest.mark.parametrize("host", ["192.0.2.1", "no such name", "a" * 70, "é..x"])
def test_an_unusable_host_is_reported_in_one_sentence(host):
    with pytest.raises(HyrfError, match=rf"^nothing can listen at port 0 of {host} [^\n]*$"):
        serve(PAGE_HTML, host=host, open_browser=False, on_ready=lambda address: None)


@pytest.mark.parametrize("port", [-1, 65_536, 70_000])
def test_a_number_that_is_no_port_is_refused(port):
    with pytest.raises(HyrfError, match=f"^{port} is not a port; name one from 1 to 65535, or 0"):
        serve(PAGE_HTML, port=port, open_browser=False, on_ready=lambda address: None)


@pytest.mark.parametrize("host", ["", " "])
def test_an_empty_host_is_refused(host):
    with pytest.raises(HyrfError, match="not an address to listen at.*127.0.0.1.*0.0.0.0"):
        serve(PAGE_HTML, host=host, open_browser=False, on_ready=lambda address: None)


@pytest.mark.usefixtures("signals")
def test_a_closed_connection_prints_nothing(capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch):
    def visit_in_a_hurry(address: str) -> None:
        try:
            for request in (b"GET / HTTP/1.1\r\n\r\n", b"GET"):
                with socket.create_connection(("127.0.0.1", int(address.rsplit(":")[-1].strip("/")))) as client:
                    # Closing resets the connection.
                    client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\1\0\0\0\0\0\0\0")
                    client.sendall(request)
            time.sleep(0.3)
        finally:
            os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr(
        "webbrowser.open", lambda address: threading.Thread(target=visit_in_a_hurry, args=[address]).start()
    )
    serve(bytes(20_000_000), open_browser=True, on_ready=lambda address: None)
    assert capsys.readouterr().err == ""


# -- files in memory ---------------------------------------------------------------------------------------------------


def test_a_file_in_memory_is_served_whole_and_in_ranges():
    with serving.serve_in_thread(PAGE_HTML, {"scene.hyrf": MemoryFile(FILE_DATA)}) as address:
        port = port_from_address(address)
        assert send_request(port, "/")[2] == PAGE_HTML and send_request(port)[2] == FILE_DATA
        status, headers, body = send_request(port, Range="bytes=5-9")
        assert (status, headers["Content-Range"], body) == (206, f"bytes 5-9/{len(FILE_DATA)}", FILE_DATA[5:10])


def test_a_replaced_file_in_memory_has_another_tag_and_is_sent_whole():
    file = MemoryFile(FILE_DATA)
    with serving.serve_in_thread(PAGE_HTML, {"scene.hyrf": file}) as address:
        tag = send_request(port_from_address(address))[1]["ETag"]
        file.replace(FILE_DATA[::-1])
        status, headers, body = send_request(port_from_address(address), Range="bytes=5-9", If_Range=tag)
        assert status == 200 and body == FILE_DATA[::-1] and headers["ETag"] != tag


def test_serve_in_thread_stops_at_the_end_of_the_block():
    with serving.serve_in_thread(PAGE_HTML, {"scene.hyrf": MemoryFile(FILE_DATA)}) as address:
        kept = {
            path: http.client.HTTPConnection("127.0.0.1", port_from_address(address), timeout=20)
            for path in ("/", "/scene.hyrf")
        }
        for connection in kept.values():
            connection.request("GET", "/scene.hyrf")
            assert connection.getresponse().read() == FILE_DATA
    with pytest.raises(OSError):
        send_request(port_from_address(address), "/")
    for path, connection in kept.items():
        connection.request("GET", path)  # on the connection of the first request
        answer = connection.getresponse()
        assert (answer.status, answer.headers["Connection"]) == (503, "close")
        assert b"The command that served this page has ended" in answer.read()
        connection.close()
