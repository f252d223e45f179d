"""<hyrf-viewer> draws a scene in the page itself, without an iframe."""

from __future__ import annotations

import io
import threading
import time
from pathlib import Path

import pytest
from PIL import Image
from web.pages import Browser, wait_until
from web.site import GOLDEN_FILE_DATA, Site
from web.viewer_pages import serve_modules

pytestmark = [pytest.mark.in_turn, pytest.mark.usefixtures("reset_window")]
SCENE_FOLDER = Path(__file__).parents[1] / "golden" / "scene"
ELEMENT_JS = "document.querySelector('hyrf-viewer')"
PAGE = (
    '<!DOCTYPE html><link rel="icon" href="data:,">'
    "<script>window.fired = []; for (const name of ['load', 'error', 'progress', 'camera'])"
    " document.addEventListener(name, (event) =>"
    " event instanceof CustomEvent && fired.push([name, event.detail]), true);</script>"
    '<script src="/hyrf-viewer.js"></script>{body}'
)
LOADED_JS = "fired.some(([name, detail]) => name === 'load' && detail === '')"


def open_element(browser: Browser, host: Site, attributes: str = 'src="cloud.spz"') -> None:
    host.files["/post.html"] = PAGE.format(body=f"<hyrf-viewer {attributes}></hyrf-viewer>").encode()
    browser.open(f"{host.address}/post.html")


def is_shown(browser: Browser, selector: str) -> bool:
    return browser.evaluate(f"{ELEMENT_JS}.shadowRoot.querySelector('{selector}').checkVisibility()")


def test_the_element_draws_in_the_page_and_fires_events(browser: Browser, host: Site):
    open_element(browser, host)
    wait_until(browser, LOADED_JS)
    assert not browser.evaluate(f"{ELEMENT_JS}.shadowRoot.querySelector('iframe')")
    assert browser.evaluate(f"{ELEMENT_JS}.viewer.scene.count") == 300
    wait_until(browser, "fired.some(([name]) => name === 'camera')")
    parts = browser.evaluate("fired.filter(([name]) => name === 'progress').map(([, part]) => part)")
    assert parts == sorted(parts) and parts[-1] == 1
    wait_until(browser, f"getComputedStyle({ELEMENT_JS}.shadowRoot.querySelector('.scene')).opacity === '1'")
    assert not is_shown(browser, "progress") and not is_shown(browser, "p")
    box = browser.evaluate(f"(({{ width, height }}) => [width, height])({ELEMENT_JS}.getBoundingClientRect())")
    assert box[0] / box[1] == pytest.approx(4 / 3, rel=0.01)
    assert browser.list_errors() == []


def test_changed_attributes_are_followed_without_a_new_viewer(browser: Browser, host: Site):
    open_element(browser, host)
    wait_until(browser, LOADED_JS)
    browser.evaluate(f"window.viewer = {ELEMENT_JS}.viewer, fired.length = 0")
    browser.evaluate(
        f"(({{ attributes }} = {ELEMENT_JS}) => {{ {ELEMENT_JS}.setAttribute('src', 'some scene.hyrf');"
        f" {ELEMENT_JS}.setAttribute('exposure', 'consistent'); {ELEMENT_JS}.toggleAttribute('autorotate'); }})()"
    )
    wait_until(browser, LOADED_JS)
    assert browser.evaluate(f"{ELEMENT_JS}.viewer === viewer && viewer.scene.kind === 'hyrf'")
    assert browser.evaluate("[viewer.exposure, viewer.autorotate]") == ["consistent", True]
    browser.evaluate(f"{ELEMENT_JS}.setAttribute('camera', '77')")
    wait_until(browser, "fired.some(([name, detail]) => name === 'error' && detail.includes('no camera 77'))")
    browser.evaluate(f"{ELEMENT_JS}.setAttribute('exposure', 'dark')")
    wait_until(browser, "fired.some(([name, detail]) => name === 'error' && detail.startsWith('The exposure must be'))")


@pytest.mark.parametrize(
    ("name", "wrong", "right"), [("camera", "77", "1"), ("camera", "77", None), ("exposure", "dark", "consistent")]
)
@pytest.mark.parametrize("at_first", [False, True])
def test_the_error_of_an_attribute_is_hidden_when_it_is_corrected(
    browser: Browser, host: Site, name: str, wrong: str, right: str | None, at_first: bool
):
    open_element(browser, host, f'src="cloud.spz" {name}="{wrong}"' if at_first else 'src="cloud.spz"')
    if not at_first:
        wait_until(browser, LOADED_JS)
        browser.evaluate(f"{ELEMENT_JS}.setAttribute('{name}', '{wrong}')")
    wait_until(browser, f"fired.some(([name, detail]) => name === 'error' && detail.includes('{wrong}'))")
    assert is_shown(browser, "p")
    change = f"removeAttribute('{name}')" if right is None else f"setAttribute('{name}', '{right}')"
    browser.evaluate(f"{ELEMENT_JS}.{change}")
    wait_until(browser, f"{LOADED_JS} && {ELEMENT_JS}.shadowRoot.querySelector('p').hidden")


def test_the_error_of_a_load_stays_when_an_attribute_is_corrected(browser: Browser, host: Site):
    open_element(browser, host)
    wait_until(browser, LOADED_JS)
    browser.evaluate(f"{ELEMENT_JS}.viewer.load('gone.hyrf').catch(() => 0)")
    browser.evaluate(f"{ELEMENT_JS}.setAttribute('camera', '1')")
    browser.evaluate("new Promise((done) => setTimeout(done, 50))")
    assert is_shown(browser, "p")


def test_an_invalid_exposure_does_not_prevent_the_load_of_another_scene(browser: Browser, host: Site):
    open_element(browser, host)
    wait_until(browser, LOADED_JS)
    browser.evaluate(
        f"fired.length = 0, {ELEMENT_JS}.setAttribute('exposure', 'dark'),"
        f"{ELEMENT_JS}.setAttribute('src', 'some scene.hyrf')"
    )
    wait_until(browser, LOADED_JS)
    assert browser.evaluate(f"{ELEMENT_JS}.viewer.scene.kind") == "hyrf"
    assert browser.evaluate("fired.some(([name, detail]) => name === 'error' && /exposure/.test(detail))")


def test_the_first_camera_is_that_of_the_attribute(browser: Browser, host: Site):
    open_element(browser, host, "src='some scene.hyrf'")
    wait_until(browser, LOADED_JS)
    text = browser.evaluate(f"{ELEMENT_JS}.viewer.moveTo(0, {{ seconds: 0 }}), {ELEMENT_JS}.viewer.cameraText")
    moved = ",".join([str(float(text.split(",")[0]) + 0.25), *text.split(",")[1:]])
    open_element(browser, host, f"src='some scene.hyrf' camera='{moved}'")
    wait_until(browser, LOADED_JS)
    shown = browser.evaluate(f"{ELEMENT_JS}.viewer.cameraText")
    assert float(shown.split(",")[0]) == pytest.approx(float(moved.split(",")[0]), abs=1e-3)


def test_a_camera_that_is_set_before_the_scene_is_loaded_is_the_first_one(browser: Browser, host: Site):
    open_element(browser, host, "")
    camera = "0.5,0.2,-3,1,0,0,0,1.2,3"
    was_loading = browser.evaluate(
        f"(async (element) => {{ element.setAttribute('src', 'some scene.hyrf'); await null; await null;"
        f" element.setAttribute('camera', '{camera}'); return element.viewer?.isReady === false; }})({ELEMENT_JS})"
    )
    assert was_loading
    wait_until(browser, LOADED_JS)
    shown = browser.evaluate(f"{ELEMENT_JS}.viewer.cameraText").split(",")
    assert [float(text) for text in shown[:7]] == pytest.approx([0.5, 0.2, -3, 1, 0, 0, 0], abs=1e-3)


def test_a_failed_load_is_shown_as_one_sentence_over_the_poster(browser: Browser, host: Site):
    file = io.BytesIO()
    Image.new("RGB", (8, 6), (0, 90, 0)).save(file, "PNG")
    host.files["/poster.png"] = file.getvalue()
    open_element(browser, host, 'src="gone.hyrf" poster="poster.png"')
    wait_until(browser, "fired.some(([name]) => name === 'error')")
    message = browser.evaluate(f"{ELEMENT_JS}.shadowRoot.querySelector('p').textContent")
    assert message.startswith("gone.hyrf could not be fetched (404")
    assert is_shown(browser, "p") and is_shown(browser, "img") and not is_shown(browser, "progress")
    assert browser.evaluate(f"getComputedStyle({ELEMENT_JS}.shadowRoot.querySelector('.scene')).opacity") == "0"
    host.files["/gone.hyrf"] = GOLDEN_FILE_DATA
    browser.evaluate(f"{ELEMENT_JS}.viewer.load('gone.hyrf')")
    assert not is_shown(browser, "p"), "the sentence stays after a later success"


def test_an_element_that_is_removed_is_freed_and_one_that_is_moved_stays(browser: Browser, host: Site):
    open_element(browser, host)
    wait_until(browser, LOADED_JS)
    browser.evaluate(f"window.element = {ELEMENT_JS}, window.viewer = element.viewer, 0")
    browser.evaluate(
        "document.body.append(document.createElement('main')), document.querySelector('main').append(element)"
    )
    browser.evaluate("new Promise((done) => setTimeout(done, 50))")
    assert browser.evaluate("element.viewer === viewer && viewer.isReady")
    browser.evaluate("window.gl = viewer.player.renderer.gl, element.remove(), fired.length = 0")
    wait_until(browser, "element.viewer === null && gl.isContextLost()")
    browser.evaluate("document.body.append(element)")
    wait_until(browser, LOADED_JS)
    assert browser.evaluate("element.viewer.scene.count") == 300


def test_an_element_switches_between_page_and_frame(browser: Browser, host: Site):
    open_element(browser, host, 'src="cloud.spz" frame')
    wait_until(browser, LOADED_JS)
    assert browser.evaluate(f"Boolean({ELEMENT_JS}.shadowRoot.querySelector('iframe')) && {ELEMENT_JS}.viewer === null")
    browser.evaluate(f"fired.length = 0, {ELEMENT_JS}.removeAttribute('frame')")
    wait_until(browser, LOADED_JS)
    assert browser.evaluate(f"!{ELEMENT_JS}.shadowRoot.querySelector('iframe') && {ELEMENT_JS}.viewer.isReady")


def test_a_lazy_frame_is_loaded_when_it_comes_near_the_window(browser: Browser, host: Site):
    host.files["/post.html"] = PAGE.format(
        body='<div style="height: 30000px"></div><hyrf-viewer src="cloud.spz" frame loading="lazy"></hyrf-viewer>'
    ).encode()
    browser.open(f"{host.address}/post.html")
    wait_until(browser, f"Boolean({ELEMENT_JS}.shadowRoot.querySelector('iframe'))")
    browser.evaluate("new Promise((done) => setTimeout(done, 300))")
    assert not any(path.startswith("/index.html") for path, _ in host.requests)
    browser.evaluate(f"{ELEMENT_JS}.scrollIntoView()")
    wait_until(browser, LOADED_JS)


def test_a_lazy_frame_waits_until_its_attribute_changes_and_begins_at_the_newest_camera(browser: Browser, host: Site):
    host.files["/post.html"] = PAGE.format(
        body='<div style="height: 30000px"></div>'
        '<hyrf-viewer src="cloud.spz" camera="0,0,3,0,0,0,0,1,0" frame loading="lazy"></hyrf-viewer>'
    ).encode()
    browser.open(f"{host.address}/post.html")
    frame = f"{ELEMENT_JS}.shadowRoot.querySelector('iframe')"
    wait_until(browser, f"Boolean({frame})")
    browser.evaluate(f"{ELEMENT_JS}.setAttribute('camera', '1,0,3,0,0,0,0,1,0')")
    browser.evaluate("new Promise((done) => setTimeout(done, 300))")
    assert not any(path.startswith("/index.html") for path, _ in host.requests)
    entries = browser.evaluate("history.length")
    browser.evaluate(f"{ELEMENT_JS}.removeAttribute('loading')")
    wait_until(browser, LOADED_JS)
    assert browser.evaluate(f"{frame}.contentWindow.location.hash").startswith("#camera=1,")
    assert browser.evaluate("history.length") == entries


def test_a_frame_whose_worker_fails_fires_an_error(browser: Browser, host: Site):
    open_element(browser, host, 'src="cloud.spz" frame')
    wait_until(browser, LOADED_JS)
    worker = "contentWindow.hyrfpack.player.loader.connection.shared.worker"
    browser.evaluate(
        f"{ELEMENT_JS}.shadowRoot.querySelector('iframe').{worker}"
        ".dispatchEvent(new ErrorEvent('error', { message: 'no memory' }))"
    )
    wait_until(browser, "fired.some(([name, detail]) => name === 'error' && detail.includes('no memory'))")


def test_a_frame_follows_the_camera_without_entries_in_the_history(browser: Browser, host: Site):
    open_element(browser, host, 'src="cloud.spz" camera="0,0,3,0,0,0,0,1,0" frame')
    wait_until(browser, LOADED_JS)
    frame = f"{ELEMENT_JS}.shadowRoot.querySelector('iframe')"
    browser.evaluate(f"window.entries = history.length, window.first = {frame}, 0")
    for x in (1, 2):
        browser.evaluate(f"{ELEMENT_JS}.setAttribute('camera', '{x},0,3,0,0,0,0,1,0')")
        wait_until(browser, f"{frame}.contentWindow.location.hash.startsWith('#camera={x},')")
    assert browser.evaluate(f"{frame} === first && history.length === entries")
    browser.evaluate(f"window.element = {ELEMENT_JS}, element.remove(), fired.length = 0")
    browser.evaluate("new Promise((done) => setTimeout(done, 50))")
    browser.evaluate("document.body.append(element)")
    wait_until(browser, LOADED_JS)
    assert browser.evaluate(f"{frame}.contentWindow.location.hash").startswith("#camera=2,")
    browser.evaluate("window.main = document.createElement('main'), document.body.append(main), fired.length = 0")
    browser.evaluate(f"{ELEMENT_JS}.setAttribute('camera', '3,0,3,0,0,0,0,1,0')")
    wait_until(browser, f"{frame}.contentWindow.location.hash.startsWith('#camera=3,')")
    browser.evaluate("main.append(element)")  # which loads the frame again
    wait_until(browser, f"{LOADED_JS} && {frame}.contentWindow.location.hash.startsWith('#camera=3,')")
    browser.evaluate(f"fired.length = 0, {ELEMENT_JS}.setAttribute('src', 'other.spz')")
    wait_until(browser, "fired.length > 0")
    assert browser.evaluate("history.length === entries")


def test_a_frame_stays_at_the_page_that_a_link_in_it_opens(browser: Browser, host: Site):
    host.files["/list.html"] = b"<!DOCTYPE html><title>list</title>"
    open_element(browser, host, 'src="cloud.spz" camera="0,0,3,0,0,0,0,1,0" frame')
    wait_until(browser, LOADED_JS)
    frame = f"{ELEMENT_JS}.shadowRoot.querySelector('iframe')"
    browser.evaluate(f"{ELEMENT_JS}.setAttribute('camera', '1,0,3,0,0,0,0,1,0')")
    wait_until(browser, f"{frame}.contentWindow.location.hash.startsWith('#camera=1,')")
    browser.evaluate(f"{frame}.contentWindow.location.href = '/list.html', 0")
    wait_until(browser, f"{frame}.contentDocument?.title === 'list'")
    browser.evaluate("new Promise((done) => setTimeout(done, 300))")
    assert browser.evaluate(f"{frame}.contentDocument.title") == "list"


def test_an_element_without_src_shows_nothing_and_waits(browser: Browser, host: Site):
    open_element(browser, host, "")
    browser.evaluate("new Promise((done) => setTimeout(done, 50))")
    assert browser.evaluate("fired") == []
    browser.evaluate(f"{ELEMENT_JS}.setAttribute('src', 'cloud.spz')")
    wait_until(browser, LOADED_JS)


def test_an_element_whose_src_is_removed_frees_its_scene(browser: Browser, host: Site):
    open_element(browser, host)
    wait_until(browser, LOADED_JS)
    browser.evaluate(f"window.gl = {ELEMENT_JS}.viewer.player.renderer.gl, {ELEMENT_JS}.removeAttribute('src')")
    wait_until(browser, f"{ELEMENT_JS}.viewer === null && gl.isContextLost()")
    assert browser.evaluate(f"{ELEMENT_JS}.shadowRoot.querySelector('canvas') === null")
    browser.evaluate(f"fired.length = 0, {ELEMENT_JS}.setAttribute('src', 'cloud.spz')")
    wait_until(browser, LOADED_JS)


def test_reduced_motion_prevents_autorotation_until_a_script_requests_it(browser: Browser, host: Site):
    browser.prefer(reduced_motion=True)
    try:
        open_element(browser, host, 'src="cloud.spz" autorotate')
        wait_until(browser, LOADED_JS)
        assert not browser.evaluate(f"{ELEMENT_JS}.viewer.autorotate")
        for _ in range(2):
            browser.evaluate(f"{ELEMENT_JS}.toggleAttribute('autorotate'), new Promise((done) => setTimeout(done, 50))")
            assert not browser.evaluate(f"{ELEMENT_JS}.viewer.autorotate")
        assert browser.evaluate(f"({ELEMENT_JS}.viewer.autorotate = true, {ELEMENT_JS}.viewer.autorotate)")
    finally:
        browser.prefer()


def test_a_wheel_that_scrolls_the_page_is_explained_for_a_moment(browser: Browser, host: Site):
    open_element(browser, host)
    wait_until(browser, LOADED_JS)
    browser.wheel(60, 60, 100)
    wait_until(browser, f"!{ELEMENT_JS}.shadowRoot.querySelector('p').hidden")
    assert "Click the scene" in browser.evaluate(f"{ELEMENT_JS}.shadowRoot.querySelector('p').textContent")
    wait_until(browser, f"{ELEMENT_JS}.shadowRoot.querySelector('p').hidden")


def test_the_hint_about_the_wheel_does_not_replace_an_error(browser: Browser, host: Site):
    open_element(browser, host, 'src="gone.hyrf"')
    wait_until(browser, "fired.some(([name]) => name === 'error')")
    browser.wheel(60, 60, 100)
    browser.evaluate("new Promise((done) => setTimeout(done, 3000))")
    assert is_shown(browser, "p")
    message = browser.evaluate(f"{ELEMENT_JS}.shadowRoot.querySelector('p').textContent")
    assert message.startswith("gone.hyrf could not be fetched")


@pytest.mark.parametrize("more", ["", "; require-trusted-types-for 'script'; trusted-types hyrf-viewer"])
def test_the_element_works_under_a_policy_of_self(browser: Browser, host: Site, more: str):
    script = PAGE.partition("<script>")[2].partition("</script>")[0]
    host.files["/watch.js"] = script.encode()
    host.files["/strict.html"] = (
        b'<!DOCTYPE html><script src="watch.js"></script><script src="hyrf-viewer.js"></script>'
        b'<hyrf-viewer src="some scene.hyrf"></hyrf-viewer>'
    )
    host.headers = {"Content-Security-Policy": f"default-src 'self'{more}"}
    browser.open(f"{host.address}/strict.html")
    wait_until(browser, LOADED_JS)
    assert not browser.evaluate("fired.some(([name]) => name === 'error')")


class HeldServer(dict):
    """Files of a server that answers requests for one path only after `release`."""

    def __init__(self, host: Site, path: str) -> None:
        super().__init__(host.files)
        self.path, self.released = path, threading.Event()

    def get(self, path: str, default: bytes | None = None) -> bytes | None:
        if path == self.path:
            self.released.wait(30)
        return super().get(path, default)

    def release(self) -> None:
        self.released.set()


def hold(host: Site, path: str) -> HeldServer:
    host.files = HeldServer(host, path)
    return host.files


def wait_for_request(host: Site, path: str) -> None:
    end = time.monotonic() + 20
    while not any(requested == path for requested, _ in host.requests):
        assert time.monotonic() < end, f"{path} was not requested"
        time.sleep(0.02)


def test_a_camera_that_is_set_while_another_scene_loads_is_its_first_one(browser: Browser, host: Site):
    open_element(browser, host)
    wait_until(browser, LOADED_JS)
    server = hold(host, "/some scene.hyrf")
    browser.evaluate(f"fired.length = 0, {ELEMENT_JS}.setAttribute('src', 'some scene.hyrf')")
    wait_for_request(host, "/some scene.hyrf")
    browser.evaluate(f"{ELEMENT_JS}.setAttribute('camera', '99')")  # which the scene that is shown lacks, too
    browser.evaluate("new Promise((done) => setTimeout(done, 50))")
    browser.evaluate(f"{ELEMENT_JS}.setAttribute('camera', '0.5,0.2,-3,1,0,0,0,1.2,3')")
    browser.evaluate("new Promise((done) => setTimeout(done, 50))")
    server.release()
    wait_until(browser, LOADED_JS)
    camera = browser.evaluate(f"{ELEMENT_JS}.viewer.cameraText").split(",")
    assert [float(text) for text in camera[:7]] == pytest.approx([0.5, 0.2, -3, 1, 0, 0, 0], abs=1e-3)
    assert not browser.evaluate("fired.some(([name]) => name === 'error')")


@pytest.mark.parametrize("attributes", ["", "frame"])
def test_an_element_with_an_empty_src_fetches_nothing(browser: Browser, host: Site, attributes: str):
    open_element(browser, host, f'src="" {attributes}')
    browser.evaluate("new Promise((done) => setTimeout(done, 300))")
    assert browser.evaluate("fired") == []
    assert [path for path, _ in host.requests].count("/post.html") == 1


def test_a_frame_whose_src_is_no_address_shows_nothing_until_it_is_corrected(browser: Browser, host: Site):
    open_element(browser, host, 'frame src="http://"')
    wait_until(browser, "fired.some(([name, detail]) => name === 'error' && detail.includes('no address of a file'))")
    assert browser.evaluate(f"{ELEMENT_JS}.shadowRoot.querySelector('iframe') === null")
    browser.evaluate(f"{ELEMENT_JS}.setAttribute('src', 'cloud.spz')")
    wait_until(browser, LOADED_JS)


def test_a_frame_reports_a_poster_that_is_no_address_once(browser: Browser, host: Site):
    open_element(browser, host, 'frame src="cloud.spz" poster="http://"')
    errors = "fired.filter(([name, detail]) => name === 'error' && detail.startsWith('poster is no address')).length"
    wait_until(browser, LOADED_JS)
    browser.evaluate(f"{ELEMENT_JS}.setAttribute('title', 'a title')")
    wait_until(browser, f"{ELEMENT_JS}.shadowRoot.querySelector('iframe').title === 'a title'")
    assert browser.evaluate(errors) == 1
    browser.evaluate(f"{ELEMENT_JS}.setAttribute('poster', 'http://[')")  # another mistake
    wait_until(browser, f"{errors} === 2")
    browser.evaluate(f"{ELEMENT_JS}.removeAttribute('poster')")
    browser.evaluate(f"{ELEMENT_JS}.setAttribute('poster', 'http://[')")  # the same again
    wait_until(browser, f"{errors} === 3")


@pytest.mark.parametrize(
    ("attribute", "words"),
    [('camera="99"', "no camera 99"), ('camera="%"', "The camera"), ('exposure="dark"', "exposure")],
)
def test_a_frame_fires_the_error_of_a_wrong_attribute_and_shows_the_scene(
    browser: Browser, host: Site, attribute: str, words: str
):
    open_element(browser, host, f'src="cloud.spz" frame {attribute}')
    wait_until(browser, LOADED_JS)
    wait_until(browser, f"fired.some(([name, detail]) => name === 'error' && detail.includes('{words}'))")


def test_an_element_in_a_module_of_any_name_has_its_worker_inside(browser: Browser, host: Site):
    serve_modules(host)
    host.files["/own/hyrf-viewer.js"] = (
        b'import { defineElement } from "/viewer/element.js"; import { setTextSource } from "/viewer/texts.js";'
        b'const texts = await (await fetch("/texts.json")).json(); setTextSource((name) => texts[name]);'
        b"defineElement();"
    )
    body = '<hyrf-viewer src="cloud.spz"></hyrf-viewer>'
    page = PAGE.replace('src="/hyrf-viewer.js"', 'type="module" src="/own/hyrf-viewer.js"').format(body=body)
    host.files["/post.html"] = page.encode()
    browser.open(f"{host.address}/post.html")
    wait_until(browser, "fired.some(([name]) => name === 'load' || name === 'error')")
    assert browser.evaluate(LOADED_JS), browser.evaluate("fired")


def test_a_missing_file_of_a_scene_folder_is_an_error_of_the_element_and_its_viewer(browser: Browser, host: Site):
    files = {f"/scene/{file.name}": file.read_bytes() for file in SCENE_FOLDER.iterdir()}
    host.files |= {path: data for path, data in files.items() if "chunk" not in path}
    sentence = "chunk-0000-0.hyrf cannot be shown: it is missing; the rest of the scene is shown."
    open_element(browser, host)
    wait_until(browser, LOADED_JS)
    browser.evaluate(
        f"fired.length = 0, window.options = [], {ELEMENT_JS}.setAttribute('src', 'scene/scene.json'),"
        f"{ELEMENT_JS}.viewer.on('error', ({{ option }}) => options.push(option)), 0"
    )
    wait_until(browser, LOADED_JS)
    wait_until(browser, f"fired.some(([name, detail]) => name === 'error' && detail === {sentence!r})")
    assert browser.evaluate(f"{ELEMENT_JS}.shadowRoot.querySelector('p').textContent") == sentence
    assert is_shown(browser, "p") and browser.evaluate("options") == ["src"]
    browser.evaluate(f"{ELEMENT_JS}.viewer.player.emit('problem', ''), 0")  # as when a lost connection is back
    assert not is_shown(browser, "p")
