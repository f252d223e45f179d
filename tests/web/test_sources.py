"""The player loads scenes from its address, from dropped files, and inside frames and elements of other pages."""

from __future__ import annotations

import gzip
import subprocess
import time
from pathlib import Path

import numpy as np
import pytest
from web.pages import SCENE_CENTER, Browser, make_splats_page, open_page, random_splats, wait_for_message, wait_until
from web.site import GOLDEN_FILE_DATA, Site, drop_file, serve_site

from hyrfpack.web.player import encode_element_script, encode_player
from tools.browser.node_programs import PROGRAMS_FOLDER

pytestmark = [pytest.mark.in_turn, pytest.mark.usefixtures("reset_window")]
LOADED_COUNT_JS = "hyrfpack.player.loaded && hyrfpack.player.scene.count"


# ---- the address


def test_the_address_selects_the_file(browser: Browser, host: Site):
    browser.open(f"{host.address}/index.html?content=some%20scene.hyrf&noui&title=Mine")
    browser.evaluate("hyrfpack.ready")
    assert browser.evaluate(LOADED_COUNT_JS) > 0 and browser.evaluate("hyrfpack.player.scene.kind") == "hyrf"
    assert browser.evaluate("document.title") == "Mine"
    browser.open(f"{host.address}/index.html?content={host.address}/cloud.spz#camera=1")
    browser.evaluate("hyrfpack.ready")
    assert browser.evaluate("hyrfpack.player.scene.kind") == "splats"
    assert np.linalg.norm(np.array(browser.evaluate("hyrfpack.player.scene.target")) - SCENE_CENTER) < 0.3
    assert browser.list_errors() == []


def test_a_file_beside_the_player_is_the_default(browser: Browser, host: Site):
    host.files["/index.html"] = encode_player("a title", content="some scene.hyrf", poster="poster.webp")
    host.files["/poster.webp"] = b"no picture"
    browser.open(f"{host.address}/index.html")
    browser.evaluate("hyrfpack.ready")
    assert browser.evaluate(LOADED_COUNT_JS) > 0 and browser.evaluate("document.title") == "a title"
    browser.open(f"{host.address}/index.html?content=cloud.spz")
    browser.evaluate("hyrfpack.ready")
    assert browser.evaluate(LOADED_COUNT_JS) == 300


def test_the_credit_is_shown_only_with_the_files_of_the_page(browser: Browser, host: Site):
    host.files["/index.html"] = encode_player("a title", content="some scene.hyrf", credit="Photos: A. B.")
    visible = "document.getElementById('credit').checkVisibility()"
    browser.open(f"{host.address}/index.html")
    browser.evaluate("hyrfpack.ready")
    assert browser.evaluate(visible)
    drop_file(browser, host.files["/cloud.spz"], "cloud.spz")
    wait_until(browser, f"!{visible}")
    browser.open(f"{host.address}/index.html?content=cloud.spz")
    browser.evaluate("hyrfpack.ready")
    assert not browser.evaluate(visible)


@pytest.mark.acceptance
@pytest.mark.smoke
def test_a_failed_fetch_is_reported_in_one_sentence(browser: Browser, host: Site):
    browser.open(f"{host.address}/index.html?content=not%20there.hyrf")
    assert wait_for_message(browser).startswith("not there.hyrf could not be fetched (404 Not Found); check")
    invitation = "document.getElementById('invitation').checkVisibility()"
    assert not browser.evaluate(invitation), "visitors have no file to drop"
    with serve_site() as other_site:  # without CORS headers, other sites cannot read it
        other_site.files = {"/scene.hyrf": GOLDEN_FILE_DATA}
        browser.open(f"{host.address}/index.html?content={other_site.address}/scene.hyrf")
        message = wait_for_message(browser)
        assert message.startswith("scene.hyrf could not be fetched: 127.0.0.1:") and "other sites" in message
        other_site.headers = {"Access-Control-Allow-Origin": "*"}
        browser.open(f"{host.address}/index.html?content={other_site.address}/scene.hyrf")
        browser.evaluate("hyrfpack.ready")
        assert browser.evaluate(LOADED_COUNT_JS) > 0


@pytest.mark.parametrize(
    "content", ["data:text/plain,hi", "javascript:alert(1)", "blob:x", "http://me:word@127.0.0.1/x", "http://["]
)
def test_only_web_addresses_are_fetched(browser: Browser, host: Site, content: str):
    host.files["/index.html"] = encode_player("a title", content="some scene.hyrf")
    browser.open(f"{host.address}/index.html?content={content}")
    assert wait_for_message(browser).startswith("The content in the address")
    time.sleep(0.2)
    assert [path for path, _ in host.requests] == ["/index.html"]


def test_an_invalid_poster_address_is_reported_and_the_scene_is_shown(browser: Browser, host: Site):
    browser.open(f"{host.address}/index.html?content=cloud.spz&poster=javascript:0")
    browser.evaluate("hyrfpack.ready")
    assert browser.evaluate(LOADED_COUNT_JS) == 300 and wait_for_message(browser).startswith(
        "The poster in the address"
    )


def test_a_file_of_another_kind_is_reported_in_one_sentence(browser: Browser, host: Site):
    host.files["/x.hyrf"] = b"<!DOCTYPE html><title>Sorry</title>" * 50
    browser.open(f"{host.address}/index.html?content=x.hyrf")
    message = wait_for_message(browser)
    assert message.startswith("x.hyrf cannot be opened: ") and "\n" not in message


def test_a_broken_download_resumes_where_it_broke(browser: Browser, host: Site):
    host.breaks = len(GOLDEN_FILE_DATA) // 3
    browser.open(f"{host.address}/index.html?content=some%20scene.hyrf")
    browser.evaluate("hyrfpack.ready")
    assert browser.evaluate(LOADED_COUNT_JS) > 0
    ranges = [byte_range for path, byte_range in host.requests if path.endswith("hyrf")]
    assert ranges[0] is None and ranges[-1] == f"bytes={host.breaks}-"


@pytest.mark.parametrize("why", ["it breaks again", "there are no ranges"])
def test_a_download_that_cannot_resume_is_reported_in_one_sentence(browser: Browser, host: Site, why: str):
    host.breaks, host.always, host.ranges = len(GOLDEN_FILE_DATA) // 3, True, why != "there are no ranges"
    host.files["/x.hyrf"] = GOLDEN_FILE_DATA
    browser.open(f"{host.address}/index.html?content=x.hyrf")
    message = wait_for_message(browser)
    assert "the connection broke after" in message and message.startswith("x.hyrf cannot be opened: ")


def test_a_compressed_transfer_of_another_server_may_be_longer_than_the_file(browser: Browser, host: Site):
    with serve_site() as other_site:  # it does not reveal Content-Encoding
        other_site.files = {"/scene.hyrf": gzip.compress(GOLDEN_FILE_DATA, compresslevel=0)}
        other_site.headers = {"Access-Control-Allow-Origin": "*", "Content-Encoding": "gzip"}
        assert len(other_site.files["/scene.hyrf"]) > len(GOLDEN_FILE_DATA)
        browser.open(f"{host.address}/index.html?content={other_site.address}/scene.hyrf")
        assert browser.evaluate("hyrfpack.ready.then(() => '', (error) => error.message)") == ""
        assert browser.evaluate(LOADED_COUNT_JS) > 0


# ---- dropped files


def test_an_empty_player_asks_for_a_file_and_opens_dropped_files(browser: Browser, host: Site):
    browser.resize(1280, 800)
    browser.open(f"{host.address}/index.html")
    browser.evaluate("hyrfpack.ready")
    invitation = "document.getElementById('invitation').checkVisibility()"
    assert browser.evaluate(invitation)
    assert not browser.evaluate("document.getElementById('loading').checkVisibility()")
    browser.press("w", seconds=0.1)  # must do nothing without a scene
    browser.drag((120, 90), (130, 90))
    drop_file(browser, host.files["/cloud.spz"], "my cloud.spz")
    wait_until(browser, LOADED_COUNT_JS + " === 300")
    assert not browser.evaluate(invitation)
    assert browser.evaluate("document.title") == "my cloud"
    wait_until(browser, "document.getElementById('toolbar').checkVisibility()")
    drop_file(browser, GOLDEN_FILE_DATA, "model.hyrf")
    wait_until(browser, "hyrfpack.player.scene.kind === 'hyrf'")
    wait_until(browser, "document.getElementById('count').textContent.startsWith('hybrid field, ')")
    assert browser.list_errors() == []


def test_a_damaged_file_is_reported_and_the_scene_stays(browser: Browser, host: Site):
    browser.open(f"{host.address}/index.html?content=cloud.spz")
    browser.evaluate("hyrfpack.ready")
    drop_file(browser, GOLDEN_FILE_DATA[:300], "half.hyrf")
    assert wait_for_message(browser).startswith("half.hyrf cannot be opened: ")
    assert browser.evaluate(LOADED_COUNT_JS) == 300 and browser.evaluate("document.title") == "cloud"
    drop_file(browser, b"", "empty.ply")
    wait_until(browser, "document.getElementById('sentence').textContent.startsWith('empty.ply cannot be opened: ')")


HOLD_FETCHES_JS = (
    "(() => { const real = fetch; const held = new Promise((done) => { window.release = done; });"
    " window.fetch = async (...request) => { const answer = await real(...request), bytes = await answer.arrayBuffer();"
    " const start = async (controller) => {"
    "   await held; controller.enqueue(new Uint8Array(bytes)); controller.close(); };"
    " return new Response(new ReadableStream({ start })); }; })()"
)


def test_a_damaged_file_that_is_dropped_early_does_not_rename_the_scene(browser: Browser, host: Site):
    host.files["/index.html"] = encode_player("a title", content="some scene.hyrf", credit="Photos: A. B.")
    with browser.before_every_page(HOLD_FETCHES_JS):
        browser.open(f"{host.address}/index.html")
        wait_until(browser, "window.hyrfpack?.player.next")
        drop_file(browser, b"no scene", "bad.hyrf")
        wait_until(browser, "document.getElementById('sentence').textContent.startsWith('bad.hyrf cannot be opened: ')")
        browser.evaluate("release()")
        wait_until(browser, LOADED_COUNT_JS)
    assert browser.evaluate("document.title") == "a title"
    assert browser.evaluate("document.getElementById('credit').checkVisibility()")


def test_a_page_with_a_scene_inside_opens_dropped_files(browser: Browser, tmp_path: Path):
    open_page(browser, tmp_path, make_splats_page(random_splats(50)))
    drop_file(browser, GOLDEN_FILE_DATA, "model.hyrf")
    wait_until(browser, "hyrfpack.player.scene.kind === 'hyrf'")
    browser.press("l")
    wait_until(browser, "/not include the opened file/.test(document.getElementById('done').textContent)")


# ---- inside other pages

TALL_PAGE_HTML = '<!DOCTYPE html><body style="margin: 0; height: 3000px">'


def test_in_a_frame_the_wheel_scrolls_the_page_until_the_scene_is_clicked(browser: Browser, host: Site):
    frame = '<iframe src="index.html?content=cloud.spz" style="border: 0; width: 240px; height: 180px"></iframe>'
    host.files["/around.html"] = (TALL_PAGE_HTML + frame).encode()
    browser.open(f"{host.address}/around.html")
    inside = "document.querySelector('iframe').contentWindow"
    wait_until(browser, f"{inside}.hyrfpack?.player?.loaded")
    where = f"JSON.stringify({inside}.hyrfpack.camera())"
    home = browser.evaluate(where)
    browser.wheel(120, 90, 30)
    wait_until(browser, "scrollY > 0")
    assert browser.evaluate(where) == home
    assert "Click" in browser.evaluate(f"{inside}.document.getElementById('done').textContent")
    browser.evaluate("scrollTo(0, 0)")
    browser.click(120, 90)
    browser.wheel(120, 90, 30)
    wait_until(browser, f"{where} !== '{home}'")
    assert browser.evaluate("scrollY") == 0


def open_framed_on_a_phone(browser: Browser, host: Site, address: str, *, height: int = 180) -> str:
    """Open a tall page on a phone with a player in a frame; return an expression for the frame's window."""
    frame = f'<iframe src="{address}" style="border: 0; width: 240px; height: {height}px"></iframe>'
    host.files["/around.html"] = f'<meta name="viewport" content="width=device-width">{TALL_PAGE_HTML}{frame}'.encode()
    browser.resize(240, 360, phone=True)
    browser.open(f"{host.address}/around.html")
    return "document.querySelector('iframe').contentWindow"


def test_in_a_frame_a_pinch_zooms_the_page_until_the_scene_is_tapped(one_browser: Browser, host: Site):
    inside = open_framed_on_a_phone(one_browser, host, "index.html?content=cloud.spz")
    wait_until(one_browser, f"{inside}.hyrfpack?.player?.loaded")
    where = f"JSON.stringify({inside}.hyrfpack.camera())"
    home = one_browser.evaluate(where)
    one_browser.touch("touchStart", (110, 90), (130, 90))
    for distance in range(20, 101, 10):
        one_browser.touch("touchMove", (120 - distance, 90), (120 + distance, 90))
    one_browser.touch("touchEnd")
    wait_until(one_browser, "visualViewport.scale > 1.2")
    assert one_browser.evaluate(where) == home


def test_in_a_frame_a_tap_that_picks_a_point_lets_fingers_move_the_scene(browser: Browser, host: Site):
    host.files["/edit.html"] = encode_player("a title", content="some scene.hyrf", editable=True)
    inside = open_framed_on_a_phone(browser, host, "edit.html", height=300)
    wait_until(browser, f"{inside}.hyrfpack?.player?.whole")
    browser.evaluate(f"{inside}.hyrfpack.editor.toggle(true), {inside}.hyrfpack.editor.choose('measure')")
    browser.touch("touchStart", (120, 60))
    browser.touch("touchEnd")
    wait_until(browser, f"{inside}.getComputedStyle({inside}.document.getElementById('view')).touchAction === 'none'")


def test_in_a_frame_a_touch_scrolls_the_page_until_the_scene_is_tapped(browser: Browser, host: Site):
    inside = open_framed_on_a_phone(browser, host, "index.html?content=cloud.spz")
    wait_until(browser, f"{inside}.hyrfpack?.player?.loaded")
    where = f"JSON.stringify({inside}.hyrfpack.camera())"
    home = browser.evaluate(where)
    touches = f"getComputedStyle({inside}.document.getElementById('view')).touchAction"
    assert browser.evaluate(touches) == "manipulation"

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
    wait_until(browser, f"{touches} === 'none'")
    ends = time.monotonic() + 20
    while browser.evaluate(where) == home:  # the browser needs some touches to switch from scrolling the page
        assert time.monotonic() < ends, "a touch does not move the scene"
        browser.evaluate("scrollTo(0, 0)")
        browser.evaluate(settle)
        swipe()
        browser.evaluate(settle)


ELEMENT_JS = "document.querySelector('hyrf-viewer')"
ELEMENT_WINDOW_JS = f"{ELEMENT_JS}.shadowRoot.querySelector('iframe').contentWindow"


@pytest.mark.parametrize("kind", [pytest.param("", marks=pytest.mark.smoke), ' type="module"'])
def test_the_element_shows_a_file_and_follows_its_attributes(browser: Browser, host: Site, kind: str):
    host.files["/blog/post.html"] = (
        "<!DOCTYPE html><meta http-equiv=Content-Security-Policy content=\"style-src 'none'\">"
        f"<script{kind} src=../hyrf-viewer.js></script>"
        "<script>window.fired = []; for (const name of ['load', 'error'])"
        " document.addEventListener(name, (event) => fired.push([name, event.detail]), true);</script>"
        '<hyrf-viewer frame src="../cloud.spz" camera="1" title="A cloud" noui></hyrf-viewer>'
    ).encode()
    browser.open(f"{host.address}/blog/post.html")
    wait_until(browser, "fired.some(([name, detail]) => name === 'load' && detail === '')")
    assert browser.evaluate(f"{ELEMENT_WINDOW_JS}.{LOADED_COUNT_JS.split(' && ')[0]}")
    assert browser.evaluate(f"{ELEMENT_WINDOW_JS}.document.title") == "A cloud"
    assert browser.evaluate(f"{ELEMENT_WINDOW_JS}.document.body.classList.contains('bare')")
    box = browser.evaluate(f"(({{ width, height }}) => [width, height])({ELEMENT_JS}.getBoundingClientRect())")
    assert box[0] / box[1] == pytest.approx(4 / 3, rel=0.01)
    browser.evaluate(f"({ELEMENT_WINDOW_JS}.marked = true, {ELEMENT_JS}.setAttribute('camera', '77'))")
    wait_until(browser, f"{ELEMENT_WINDOW_JS}.document.getElementById('sentence').textContent.includes('no camera 77')")
    assert browser.evaluate(f"{ELEMENT_WINDOW_JS}.marked"), "the frame was reloaded"
    browser.evaluate(f"({ELEMENT_JS}.setAttribute('src', '../some scene.hyrf'), {ELEMENT_JS}.removeAttribute('noui'))")
    wait_until(browser, f"{ELEMENT_WINDOW_JS}.hyrfpack?.player?.scene?.kind === 'hyrf'")
    assert not browser.evaluate(f"{ELEMENT_WINDOW_JS}.document.body.classList.contains('bare')")
    browser.evaluate(f"{ELEMENT_JS}.setAttribute('src', '../nothing.hyrf')")
    wait_until(browser, "fired.some(([name, detail]) => name === 'error' && String(detail).includes('404'))")


WATCH_EVENTS_HTML = (
    "<!DOCTYPE html><script>window.fired = []; for (const name of ['load', 'error'])"
    " document.addEventListener(name, (event) => fired.push([name, event.detail]), true);</script>"
)
BUNDLED_SCRIPT_KINDS = {"module": " type=module", "classic": " defer"}


def bundle_element(folder: Path, player_attribute: str) -> bytes:
    """Bundle hyrf-viewer.js with a script that adds an element, by esbuild if it is here."""
    add = f"document.body.innerHTML = `<hyrf-viewer frame src='cloud.spz' noui {player_attribute}></hyrf-viewer>`;"
    (folder / "hyrf-viewer.js").write_bytes(encode_element_script())
    (folder / "entry.js").write_text(f'import "./hyrf-viewer.js";\n{add}\n')
    if not (PROGRAMS_FOLDER / "esbuild").exists():
        return encode_element_script() + b"\n" + add.encode()
    command = [PROGRAMS_FOLDER / "esbuild", folder / "entry.js", "--bundle", "--format=iife"]
    return subprocess.run(command, stdout=subprocess.PIPE, check=True).stdout


@pytest.mark.parametrize("kind", BUNDLED_SCRIPT_KINDS)
def test_a_bundled_element_needs_the_address_of_its_player_and_says_so(
    browser: Browser, host: Site, tmp_path: Path, kind: str
):
    host.files["/player/index.html"] = host.files["/index.html"]
    host.files["/index.html"] = b"<!DOCTYPE html>another page"
    for name, attribute in {"bad": "", "good": "player=player/index.html"}.items():
        host.files[f"/{name}.js"] = bundle_element(tmp_path, attribute)
        script = f"<script{BUNDLED_SCRIPT_KINDS[kind]} src=/{name}.js></script>"
        host.files[f"/{name}.html"] = (WATCH_EVENTS_HTML + script + "<body>").encode()
    browser.open(f"{host.address}/bad.html")
    wait_until(browser, "fired.some(([name, detail]) => name === 'error' && /attribute player/.test(detail))")
    assert kind != "module" or not any(path == "/index.html" for path, _ in host.requests)
    browser.open(f"{host.address}/good.html")
    wait_until(browser, "fired.some(([name, detail]) => name === 'load' && detail === '')")
    browser.evaluate("new Promise((done) => setTimeout(done, 3500))")  # longer than the element waits for an answer
    assert not browser.evaluate("fired.some(([name, detail]) => name === 'error')")


def test_an_element_whose_player_may_not_run_fires_an_error(browser: Browser, host: Site):
    host.headers = {"Content-Security-Policy": "script-src 'self'"}
    host.files["/watch.js"] = WATCH_EVENTS_HTML.partition("<script>")[2].removesuffix("</script>").encode()
    host.files["/post.html"] = (
        b"<!DOCTYPE html><script src=watch.js></script><script src=hyrf-viewer.js></script>"
        b'<hyrf-viewer frame src="cloud.spz"></hyrf-viewer>'
    )
    browser.open(f"{host.address}/post.html")
    wait_until(browser, "fired.some(([name, detail]) => name === 'error' && /not allowed to run here/.test(detail))")


def test_the_element_has_no_sandbox_which_would_protect_nothing(browser: Browser, host: Site):
    host.files["/post.html"] = (
        WATCH_EVENTS_HTML + '<script src=hyrf-viewer.js></script><hyrf-viewer frame src="cloud.spz"></hyrf-viewer>'
    ).encode()
    browser.open(f"{host.address}/post.html")
    wait_until(browser, "fired.some(([name, detail]) => name === 'load' && detail === '')")
    frame = f"{ELEMENT_JS}.shadowRoot.querySelector('iframe')"
    assert not browser.evaluate(f"{frame}.hasAttribute('sandbox')")
    assert "clipboard-write" in browser.evaluate(f"{frame}.allow")


def test_the_element_adds_no_global_names(browser: Browser, host: Site):
    host.files["/post.html"] = b"<!DOCTYPE html>" + 2 * b"<script src=hyrf-viewer.js></script>"
    host.files["/plain.html"] = b"<!DOCTYPE html>"
    names = "Object.getOwnPropertyNames(window).filter((name) => !/^\\d+$/.test(name)).sort()"
    browser.open(f"{host.address}/plain.html")
    plain = browser.evaluate(names)
    browser.open(f"{host.address}/post.html")
    assert browser.evaluate(names) == plain
    assert browser.evaluate("Boolean(customElements.get('hyrf-viewer'))")
