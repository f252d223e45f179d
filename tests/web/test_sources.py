"""Where a player's scene comes from: its address, a file dropped on it, other people's pages around it."""

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

import numpy as np
import pytest
from web.pages import CENTER, Browser, cloud, message, opened, page_of, until

from hyrfpack.splats.formats import spz
from hyrfpack.splats.formats.hints import Hints
from hyrfpack.web.player import encode_element_script, encode_player

pytestmark = pytest.mark.in_turn
GOLDEN = (Path(__file__).parents[1] / "golden" / "v1.1_compact.hyrf").read_bytes()
SHOWN = "hyrfpack.player.loaded && hyrfpack.player.scene.count"


@dataclass
class Site:
    """A server whose answers tests choose.

    Attributes:
        files: what lies at each path; HTML by its ending.
        headers: sent with everything.
        breaks: after so many bytes of a .hyrf file the connection ends, once or (with `always`) each time.
        asked: (path, Range header) of each request.
    """

    address: str = ""
    files: dict[str, bytes] = field(default_factory=dict)
    headers: dict[str, str] = field(default_factory=dict)
    breaks: int | None = None
    always: bool = False
    ranges: bool = True
    asked: list[tuple[str, str | None]] = field(default_factory=list)


@contextmanager
def site() -> Iterator[Site]:
    here = Site()

    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def do_GET(self) -> None:
            path, asked = unquote(self.path.partition("?")[0]), self.headers.get("Range")
            here.asked.append((path, asked))
            data = here.files.get(path)
            if data is None:
                self.send_error(404)
                return
            first = int(asked.removeprefix("bytes=").removesuffix("-")) if asked and here.ranges else 0
            self.send_response(206 if first else 200)
            kind = {"html": "text/html; charset=utf-8", "js": "text/javascript"}.get(path.rpartition(".")[2])
            self.send_header("Content-Type", kind or "application/octet-stream")
            self.send_header("Content-Length", str(len(data) - first))
            if first:
                self.send_header("Content-Range", f"bytes {first}-{len(data) - 1}/{len(data)}")
            for name, value in here.headers.items():
                self.send_header(name, value)
            self.end_headers()
            if path.endswith(".hyrf") and here.breaks is not None and (here.always or not first):
                self.wfile.write(data[first : first + here.breaks])
                self.wfile.flush()
                time.sleep(0.2)
                self.close_connection = True
                self.connection.shutdown(2)
            else:
                self.wfile.write(data[first:])

        def log_message(self, format: str, *arguments: object) -> None:
            """Requests are nobody's news."""

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        here.address = f"http://127.0.0.1:{server.server_port}"
        threading.Thread(target=server.serve_forever, daemon=True).start()
        try:
            yield here
        finally:
            server.shutdown()


@pytest.fixture
def host() -> Iterator[Site]:
    """A player to be hosted, beside two files."""
    with site() as here:
        here.files = {
            "/index.html": encode_player("player"),
            "/some scene.hyrf": GOLDEN,
            "/cloud.spz": spz.encode(cloud(300), Hints(spz_version=3)),
            "/hyrf-viewer.js": encode_element_script(),
        }
        yield here


@pytest.fixture(autouse=True)
def usual(browser: Browser) -> Iterator[None]:
    yield
    browser.resize(240, 180)


# ---- the address


def test_the_address_names_the_file(browser: Browser, host: Site):
    browser.open(f"{host.address}/index.html?content=some%20scene.hyrf&noui&title=Mine")
    browser.evaluate("hyrfpack.ready")
    assert browser.evaluate(SHOWN) > 0 and browser.evaluate("hyrfpack.player.scene.kind") == "hyrf"
    assert browser.evaluate("document.title") == "Mine"
    browser.open(f"{host.address}/index.html?content={host.address}/cloud.spz#camera=1")
    browser.evaluate("hyrfpack.ready")
    assert browser.evaluate("hyrfpack.player.scene.kind") == "splats"
    assert np.linalg.norm(np.array(browser.evaluate("hyrfpack.player.scene.target")) - CENTER) < 0.3
    assert browser.list_errors() == []


def test_a_file_beside_the_player_is_the_default(browser: Browser, host: Site):
    host.files["/index.html"] = encode_player("a title", content="some scene.hyrf", poster="poster.webp")
    host.files["/poster.webp"] = b"no picture"
    browser.open(f"{host.address}/index.html")
    browser.evaluate("hyrfpack.ready")
    assert browser.evaluate(SHOWN) > 0 and browser.evaluate("document.title") == "a title"
    browser.open(f"{host.address}/index.html?content=cloud.spz")
    browser.evaluate("hyrfpack.ready")
    assert browser.evaluate(SHOWN) == 300


def test_what_cannot_be_fetched_is_one_sentence(browser: Browser, host: Site):
    browser.open(f"{host.address}/index.html?content=not%20there.hyrf")
    assert message(browser).startswith("not there.hyrf could not be fetched (404 Not Found); check")
    until(browser, "document.getElementById('invitation').checkVisibility()")  # another may be chosen
    with site() as closed:  # it does not let pages of others read
        closed.files = {"/scene.hyrf": GOLDEN}
        browser.open(f"{host.address}/index.html?content={closed.address}/scene.hyrf")
        said = message(browser)
        assert said.startswith("scene.hyrf could not be fetched: 127.0.0.1:") and "other sites" in said
        closed.headers = {"Access-Control-Allow-Origin": "*"}
        browser.open(f"{host.address}/index.html?content={closed.address}/scene.hyrf")
        browser.evaluate("hyrfpack.ready")
        assert browser.evaluate(SHOWN) > 0


@pytest.mark.parametrize(
    "content", ["data:text/plain,hi", "javascript:alert(1)", "blob:x", "http://me:word@127.0.0.1/x", "http://["]
)
def test_only_web_addresses_are_fetched(browser: Browser, host: Site, content: str):
    host.files["/index.html"] = encode_player("a title", content="some scene.hyrf")
    browser.open(f"{host.address}/index.html?content={content}")
    assert message(browser).startswith("The content in the address")
    time.sleep(0.2)
    assert [path for path, _ in host.asked] == ["/index.html"]


def test_an_address_that_cannot_be_a_poster_does_not_stop_the_scene(browser: Browser, host: Site):
    browser.open(f"{host.address}/index.html?content=cloud.spz&poster=javascript:0")
    browser.evaluate("hyrfpack.ready")
    assert browser.evaluate(SHOWN) == 300 and message(browser).startswith("The poster in the address")


def test_a_file_that_is_none_is_one_sentence(browser: Browser, host: Site):
    host.files["/x.hyrf"] = b"<!DOCTYPE html><title>Sorry</title>" * 50
    browser.open(f"{host.address}/index.html?content=x.hyrf")
    said = message(browser)
    assert said.startswith("x.hyrf cannot be opened: ") and "\n" not in said


def test_a_connection_that_breaks_is_taken_up_where_it_broke(browser: Browser, host: Site):
    host.breaks = len(GOLDEN) // 3
    browser.open(f"{host.address}/index.html?content=some%20scene.hyrf")
    browser.evaluate("hyrfpack.ready")
    assert browser.evaluate(SHOWN) > 0
    asked = [ranges for path, ranges in host.asked if path.endswith("hyrf")]
    assert asked[0] is None and asked[-1] == f"bytes={host.breaks}-"


@pytest.mark.parametrize("why", ["it breaks again", "there are no ranges"])
def test_a_connection_that_breaks_for_good_is_one_sentence(browser: Browser, host: Site, why: str):
    host.breaks, host.always, host.ranges = len(GOLDEN) // 3, True, why != "there are no ranges"
    host.files["/x.hyrf"] = GOLDEN
    browser.open(f"{host.address}/index.html?content=x.hyrf")
    said = message(browser)
    assert "the connection broke after" in said and said.startswith("x.hyrf cannot be opened: ")


# ---- a person's files


def drop(browser: Browser, data: bytes, name: str) -> None:
    """Drop a file on the page."""
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


def test_an_empty_player_asks_for_a_file_and_takes_what_is_dropped(browser: Browser, host: Site):
    browser.resize(1280, 800)
    browser.open(f"{host.address}/index.html")
    browser.evaluate("hyrfpack.ready")
    invitation = "document.getElementById('invitation').checkVisibility()"
    assert browser.evaluate(invitation)
    assert not browser.evaluate("document.getElementById('loading').checkVisibility()")
    browser.press("w", seconds=0.1)  # nothing to move in
    browser.drag((120, 90), (130, 90))
    drop(browser, host.files["/cloud.spz"], "my cloud.spz")
    until(browser, SHOWN + " === 300")
    assert not browser.evaluate(invitation)
    assert browser.evaluate("document.title") == "my cloud"
    until(browser, "document.getElementById('panel').checkVisibility()")
    drop(browser, GOLDEN, "model.hyrf")
    until(browser, "hyrfpack.player.scene.kind === 'hyrf'")
    until(browser, "document.getElementById('count').textContent.startsWith('hybrid field, ')")
    assert browser.list_errors() == []


def test_a_bad_file_leaves_the_scene_and_says_so(browser: Browser, host: Site):
    browser.open(f"{host.address}/index.html?content=cloud.spz")
    browser.evaluate("hyrfpack.ready")
    drop(browser, GOLDEN[:300], "half.hyrf")
    assert message(browser).startswith("half.hyrf cannot be opened: ")
    assert browser.evaluate(SHOWN) == 300 and browser.evaluate("document.title") == "cloud"
    drop(browser, b"", "empty.ply")
    until(browser, "document.getElementById('sentence').textContent.startsWith('empty.ply cannot be opened: ')")


def test_a_page_with_a_scene_inside_takes_files_as_well(browser: Browser, tmp_path: Path):
    opened(browser, tmp_path, page_of(cloud(50)))
    drop(browser, GOLDEN, "model.hyrf")
    until(browser, "hyrfpack.player.scene.kind === 'hyrf'")
    browser.press("l")
    until(browser, "/does not hold the file|Copy this link/.test(document.getElementById('done').textContent)")


# ---- other people's pages

TALL = '<!DOCTYPE html><body style="margin: 0; height: 3000px">'


def test_a_frame_leaves_the_wheel_to_the_page_until_it_is_clicked(browser: Browser, host: Site):
    frame = '<iframe src="index.html?content=cloud.spz" style="border: 0; width: 240px; height: 180px"></iframe>'
    host.files["/around.html"] = (TALL + frame).encode()
    browser.open(f"{host.address}/around.html")
    inside = "document.querySelector('iframe').contentWindow"
    until(browser, f"{inside}.hyrfpack?.player?.loaded")
    where = f"JSON.stringify({inside}.hyrfpack.camera())"
    home = browser.evaluate(where)
    browser.mouse("mouseWheel", 120, 90, deltaX=0, deltaY=30)
    until(browser, "scrollY > 0")
    assert browser.evaluate(where) == home
    assert "Click" in browser.evaluate(f"{inside}.document.getElementById('done').textContent")
    browser.evaluate("scrollTo(0, 0)")
    for kind in ("mousePressed", "mouseReleased"):
        browser.mouse(kind, 120, 90, button="left", clickCount=1)
    browser.mouse("mouseWheel", 120, 90, deltaX=0, deltaY=30)
    until(browser, f"{where} !== '{home}'")
    assert browser.evaluate("scrollY") == 0


def test_in_a_frame_a_finger_moves_the_page_until_the_scene_is_tapped(browser: Browser, host: Site):
    frame = '<iframe src="index.html?content=cloud.spz" style="border: 0; width: 240px; height: 180px"></iframe>'
    host.files["/around.html"] = ('<meta name="viewport" content="width=device-width">' + TALL + frame).encode()
    browser.resize(240, 360, phone=True)
    browser.open(f"{host.address}/around.html")
    inside = "document.querySelector('iframe').contentWindow"
    until(browser, f"{inside}.hyrfpack?.player?.loaded")
    where = f"JSON.stringify({inside}.hyrfpack.camera())"
    home = browser.evaluate(where)
    touches = f"getComputedStyle({inside}.document.getElementById('view')).touchAction"
    assert browser.evaluate(touches) in ("pan-x pan-y", "pan-y pan-x")

    def swipe() -> None:
        browser.touch("touchStart", (120, 120))
        for y in range(110, 39, -10):
            browser.touch("touchMove", (120, y))
        browser.touch("touchEnd")

    swipe()
    settle = f"new Promise((done) => {inside}.setTimeout(done, 300))"
    browser.evaluate(settle)
    assert browser.evaluate(where) == home
    browser.evaluate("scrollTo(0, 0)")
    browser.touch("touchStart", (120, 90))
    browser.touch("touchEnd")
    until(browser, f"{touches} === 'none'")
    ends = time.monotonic() + 20
    while browser.evaluate(where) == home:  # until the browser has made up its mind who scrolls
        assert time.monotonic() < ends, "a finger does not move the scene"
        browser.evaluate("scrollTo(0, 0)")
        browser.evaluate(settle)
        swipe()
        browser.evaluate(settle)


ELEMENT = "document.querySelector('hyrf-viewer')"
INSIDE = f"{ELEMENT}.shadowRoot.querySelector('iframe').contentWindow"


@pytest.mark.parametrize("kind", ["", ' type="module"'])
def test_the_element_plays_a_file_and_follows_its_attributes(browser: Browser, host: Site, kind: str):
    host.files["/blog/post.html"] = (
        "<!DOCTYPE html><meta http-equiv=Content-Security-Policy content=\"style-src 'none'\">"
        f"<script{kind} src=../hyrf-viewer.js></script>"
        "<script>window.told = []; for (const name of ['load', 'error'])"
        " document.addEventListener(name, (event) => told.push([name, event.detail]), true);</script>"
        '<hyrf-viewer src="../cloud.spz" camera="1" title="A cloud" noui></hyrf-viewer>'
    ).encode()
    browser.open(f"{host.address}/blog/post.html")
    until(browser, "told.some(([name, detail]) => name === 'load' && detail === '')")
    assert browser.evaluate(f"{INSIDE}.{SHOWN.split(' && ')[0]}")
    assert browser.evaluate(f"{INSIDE}.document.title") == "A cloud"
    assert browser.evaluate(f"{INSIDE}.document.body.classList.contains('bare')")
    box = browser.evaluate(f"(({{ width, height }}) => [width, height])({ELEMENT}.getBoundingClientRect())")
    assert box[0] / box[1] == pytest.approx(4 / 3, rel=0.01)
    browser.evaluate(f"({INSIDE}.marked = true, {ELEMENT}.setAttribute('camera', '77'))")
    until(browser, f"{INSIDE}.document.getElementById('sentence').textContent.includes('no camera 77')")
    assert browser.evaluate(f"{INSIDE}.marked"), "it was loaded anew"
    browser.evaluate(f"({ELEMENT}.setAttribute('src', '../some scene.hyrf'), {ELEMENT}.removeAttribute('noui'))")
    until(browser, f"{INSIDE}.hyrfpack?.player?.scene?.kind === 'hyrf'")
    assert not browser.evaluate(f"{INSIDE}.document.body.classList.contains('bare')")
    browser.evaluate(f"{ELEMENT}.setAttribute('src', '../nothing.hyrf')")
    until(browser, "told.some(([name, detail]) => name === 'error' && String(detail).includes('404'))")


def test_the_element_names_nothing_in_the_page(browser: Browser, host: Site):
    host.files["/post.html"] = b"<!DOCTYPE html>" + 2 * b"<script src=hyrf-viewer.js></script>"
    host.files["/plain.html"] = b"<!DOCTYPE html>"
    names = "Object.getOwnPropertyNames(window).filter((name) => !/^\\d+$/.test(name)).sort()"
    browser.open(f"{host.address}/plain.html")
    plain = browser.evaluate(names)
    browser.open(f"{host.address}/post.html")
    assert browser.evaluate(names) == plain
    assert browser.evaluate("Boolean(customElements.get('hyrf-viewer'))")
