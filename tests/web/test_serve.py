"""A page is served to this machine alone, until interrupted."""

from __future__ import annotations

import os
import signal
import socket
import threading
import time
import urllib.error
import urllib.request

import pytest

from hyrfpack.errors import HyrfError
from hyrfpack.web.serve import serve

PAGE = b"<!DOCTYPE html><title>served</title>"


@pytest.mark.usefixtures("signals")
def test_the_page_is_served_to_the_browser_until_an_interrupt_which_is_no_error(monkeypatch: pytest.MonkeyPatch):
    said, seen = [], []

    def visit(address: str) -> None:
        try:
            seen.append(address)
            with urllib.request.urlopen(address + "?at=any", timeout=10) as answer:
                seen.append((answer.headers["Content-Type"], answer.read()))
            with urllib.request.urlopen(urllib.request.Request(address, method="HEAD"), timeout=10) as answer:
                seen.append((answer.headers["Content-Length"], answer.read()))
            try:
                urllib.request.urlopen(address + "other", timeout=10)
            except urllib.error.HTTPError as error:
                seen.append(error.code)
        finally:
            os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr("webbrowser.open", visit)
    serve(lambda: PAGE, open_browser=True, say=said.append)

    assert said[0].startswith("http://127.0.0.1:")
    assert seen == [said[0], ("text/html; charset=utf-8", PAGE), (str(len(PAGE)), b""), 404]


def test_a_port_in_use_is_one_sentence():
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(HyrfError, match=rf"^port {port} of 127.0.0.1 is taken by another program; [^\n]*$"):
            serve(lambda: PAGE, port=port, open_browser=False, say=lambda address: None)


@pytest.mark.parametrize("host", ["192.0.2.1", "no such name", "a" * 70])
def test_an_address_that_is_not_ours_is_one_sentence(host):
    with pytest.raises(HyrfError, match=rf"^nothing can listen at port 0 of {host} [^\n]*$"):
        serve(lambda: PAGE, host=host, open_browser=False, say=lambda address: None)


@pytest.mark.parametrize("host", ["", " "])
def test_no_address_is_one_sentence_and_does_not_mean_all(host):
    with pytest.raises(HyrfError, match="not an address to listen at.*127.0.0.1.*0.0.0.0"):
        serve(lambda: PAGE, host=host, open_browser=False, say=lambda address: None)


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
    serve(lambda: bytes(20_000_000), open_browser=True, say=lambda address: None)
    assert capsys.readouterr().err == ""
