"""A page and its file are served to this machine alone, in ranges if asked, until interrupted."""

from __future__ import annotations

import http.client
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from hyrfpack.errors import HyrfError
from hyrfpack.web import serve as serving
from hyrfpack.web.serve import CHUNK_BYTES, MemoryFile, serve

PAGE = b"<!DOCTYPE html><title>served</title>"
DATA = np.random.default_rng(0).bytes(3 * CHUNK_BYTES + 17)


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    path = tmp_path / "room.hyrf"
    path.write_bytes(DATA)
    return path


@pytest.fixture
def port(scene: Path) -> Iterator[int]:
    """Of a server with a page and a file."""
    with serving._create_server("127.0.0.1", 0, PAGE, {"scene.hyrf": scene}) as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.02,))
        thread.start()
        yield server.server_port
        server.shutdown()
        thread.join()


def ask(port: int, path: str = "/scene.hyrf", method: str = "GET", **headers: str) -> tuple[int, dict[str, str], bytes]:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=20)
    try:
        connection.request(method, path, headers={name.replace("_", "-"): value for name, value in headers.items()})
        answer = connection.getresponse()
        return answer.status, dict(answer.headers), answer.read()
    finally:
        connection.close()


def test_page_and_file_are_served_and_nothing_else(port, scene):
    status, headers, body = ask(port, "/?content=any")
    assert (status, headers["Content-Type"], body) == (200, "text/html; charset=utf-8", PAGE)
    status, headers, body = ask(port)
    assert (status, headers["Content-Type"], body) == (200, "application/octet-stream", DATA)
    assert headers["Accept-Ranges"] == "bytes" and headers["ETag"] and headers["X-Content-Type-Options"] == "nosniff"
    for path in ("/other", f"/{scene.name}", "/../room.hyrf", "/%2e%2e/room.hyrf", str(scene)):
        assert ask(port, path)[0] == 404, path
    assert ask(port, method="POST")[0] == 501


def test_a_head_is_the_answer_without_its_body(port):
    for path, length in (("/", len(PAGE)), ("/scene.hyrf", len(DATA))):
        status, headers, body = ask(port, path, "HEAD")
        assert (status, headers["Content-Length"], body) == (200, str(length), b"")


END = len(DATA) - 1
RANGES = {
    "bytes=0-0": (0, 0),
    "bytes=5-9": (5, 9),
    f"bytes={CHUNK_BYTES - 1}-{2 * CHUNK_BYTES}": (CHUNK_BYTES - 1, 2 * CHUNK_BYTES),
    "bytes=100-": (100, END),
    "bytes=-7": (END - 6, END),
    f"bytes=-{10 * len(DATA)}": (0, END),
    f"bytes=10-{10 * len(DATA)}": (10, END),
    f"bytes={END}-": (END, END),
}


@pytest.mark.parametrize("asked", RANGES)
def test_a_range_is_what_was_asked_for(asked, port):
    first, last = RANGES[asked]
    status, headers, body = ask(port, Range=asked)
    assert (status, headers["Content-Range"], body) == (
        206,
        f"bytes {first}-{last}/{len(DATA)}",
        DATA[first : last + 1],
    )


@pytest.mark.parametrize("asked", [f"bytes={len(DATA)}-", f"bytes={10**30}-", "bytes=-0"])
def test_a_range_beyond_the_end_is_refused_with_the_length(asked, port):
    status, headers, body = ask(port, Range=asked)
    assert (status, headers["Content-Range"], body) == (416, f"bytes */{len(DATA)}", b"")


@pytest.mark.parametrize("asked", ["bytes=9-5", "bytes=", "bytes=-", "bytes=a-b", "lines=0-1", "bytes=0-1,5-6", "٣-٤"])
def test_a_range_that_makes_no_sense_is_passed_over(asked, port):
    status, _, body = ask(port, Range=asked.encode().decode("latin-1"))
    assert (status, body) == (200, DATA)


def test_a_file_that_changed_is_sent_whole_to_who_asks_for_the_rest_of_the_old_one(port, scene):
    tag = ask(port)[1]["ETag"]
    assert ask(port, Range="bytes=10-", If_Range=tag)[0] == 206
    scene.write_bytes(DATA[:1000])
    status, headers, body = ask(port, Range="bytes=10-", If_Range=tag)
    assert (status, body) == (200, DATA[:1000]) and headers["ETag"] != tag


def test_a_file_that_is_gone_is_not_found_until_it_is_back(port, scene):
    scene.unlink()
    assert ask(port)[0] == ask(port, method="HEAD")[0] == 404
    scene.mkdir()
    assert ask(port)[0] == 404
    scene.rmdir()
    scene.write_bytes(b"again")
    assert ask(port)[2] == b"again"


def test_an_empty_file_is_empty(port, scene):
    scene.write_bytes(b"")
    assert ask(port)[::2] == (200, b"") and ask(port, Range="bytes=0-")[0] == 416


def test_a_file_that_shrinks_while_it_is_sent_ends_the_connection_short(port, scene):
    with scene.open("r+b") as file:
        file.truncate(1 << 28)  # more than sockets hold
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=20)
    connection.request("GET", "/scene.hyrf")
    answer = connection.getresponse()
    os.truncate(scene, CHUNK_BYTES)
    with pytest.raises(http.client.IncompleteRead):
        answer.read()
    connection.close()


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
    assert total > 1 << 30 and grown < 32 << 10  # kB


@pytest.mark.usefixtures("signals")
def test_it_serves_the_browser_until_an_interrupt_which_is_no_error(monkeypatch: pytest.MonkeyPatch):
    said, seen = [], []

    def visit(address: str) -> None:
        try:
            seen.append(address)
            seen.append(ask(int(address.rsplit(":")[-1].strip("/")), "/")[2])
        finally:
            os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr("webbrowser.open", visit)
    serve(PAGE, open_browser=True, say=said.append)
    assert said[0].startswith("http://127.0.0.1:") and seen == [said[0], PAGE]


def test_a_port_in_use_is_one_sentence():
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(HyrfError, match=rf"^port {port} of 127.0.0.1 is taken by another program; [^\n]*$"):
            serve(PAGE, port=port, open_browser=False, say=lambda address: None)


@pytest.mark.parametrize("host", ["192.0.2.1", "no such name", "a" * 70])
def test_an_address_that_is_not_ours_is_one_sentence(host):
    with pytest.raises(HyrfError, match=rf"^nothing can listen at port 0 of {host} [^\n]*$"):
        serve(PAGE, host=host, open_browser=False, say=lambda address: None)


@pytest.mark.parametrize("host", ["", " "])
def test_no_address_is_one_sentence_and_does_not_mean_all(host):
    with pytest.raises(HyrfError, match="not an address to listen at.*127.0.0.1.*0.0.0.0"):
        serve(PAGE, host=host, open_browser=False, say=lambda address: None)


@pytest.mark.usefixtures("signals")
def test_a_browser_that_goes_away_is_nobodys_news(capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch):
    def visit_in_a_hurry(address: str) -> None:
        try:
            for request in (b"GET / HTTP/1.1\r\n\r\n", b"GET"):
                with socket.create_connection(("127.0.0.1", int(address.rsplit(":")[-1].strip("/")))) as client:
                    client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\1\0\0\0\0\0\0\0")  # reset at the end
                    client.sendall(request)
            time.sleep(0.3)
        finally:
            os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr(
        "webbrowser.open", lambda address: threading.Thread(target=visit_in_a_hurry, args=[address]).start()
    )
    serve(bytes(20_000_000), open_browser=True, say=lambda address: None)
    assert capsys.readouterr().err == ""


# -- from memory -----------------------------------------------------------------------------------------------------


def port_of(address: str) -> int:
    return int(address.rstrip("/").rpartition(":")[2])


def test_a_file_in_memory_is_served_whole_and_in_ranges():
    with serving.serve_in_thread(PAGE, {"scene.hyrf": MemoryFile(DATA)}) as address:
        port = port_of(address)
        assert ask(port, "/")[2] == PAGE and ask(port)[2] == DATA
        status, headers, body = ask(port, Range="bytes=5-9")
        assert (status, headers["Content-Range"], body) == (206, f"bytes 5-9/{len(DATA)}", DATA[5:10])


def test_a_file_in_memory_that_is_replaced_has_another_tag_and_none_gets_parts_of_both():
    file = MemoryFile(DATA)
    with serving.serve_in_thread(PAGE, {"scene.hyrf": file}) as address:
        tag = ask(port_of(address))[1]["ETag"]
        file.replace(DATA[::-1])
        status, headers, body = ask(port_of(address), Range="bytes=5-9", If_Range=tag)
        assert status == 200 and body == DATA[::-1] and headers["ETag"] != tag


def test_serving_in_a_thread_ends_with_the_block():
    with serving.serve_in_thread(PAGE, {"scene.hyrf": MemoryFile(DATA)}) as address:
        kept = http.client.HTTPConnection("127.0.0.1", port_of(address), timeout=20)
        kept.request("GET", "/scene.hyrf")
        assert kept.getresponse().read() == DATA
    with pytest.raises(OSError):
        ask(port_of(address), "/")
    kept.request("GET", "/scene.hyrf")  # on a connection of before
    assert kept.getresponse().status == 404
    kept.close()
