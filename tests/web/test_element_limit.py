"""A page may have any number of <hyrf-viewer>: those near the window draw, and the others hold no graphics context."""

from __future__ import annotations

import base64

import pytest
from web.pages import Browser, wait_until
from web.site import Site
from web.test_element import hold, wait_for_request

ELEMENT_COUNT = 20
MAX_SCENES = 12  # must equal MAX_SCENES in element_limit.js
CHROMIUM_CONTEXT_LIMIT = 16
PIXEL_DATA = base64.b64decode("R0lGODlhAQABAIAAAAAAAP///yH5BAEAAAAALAAAAAABAAEAAAIBRAA7")
PAGE_TEMPLATE = """<!DOCTYPE html><link rel="icon" href="data:,">
<style>body {{ margin: 0; }} hyrf-viewer {{ height: {height}px; margin-bottom: {gap}px; }}</style>
<script>
  window.contexts = new Set();
  window.mostContexts = 0;
  window.errors = [];
  const getContext = HTMLCanvasElement.prototype.getContext;
  window.countContexts = () => [...contexts].filter((context) => !context.isContextLost()).length;
  HTMLCanvasElement.prototype.getContext = function (kind, ...options) {{
    const context = getContext.call(this, kind, ...options);
    if (kind === "webgl2") contexts.add(context);
    mostContexts = Math.max(mostContexts, countContexts());
    return context;
  }};
  window.elementAt = (number) => document.querySelectorAll("hyrf-viewer")[number];
  window.partOf = (number, selector) => elementAt(number).shadowRoot.querySelector(selector);
  window.isDrawn = (number) => {{
    const canvas = partOf(number, ".drawn canvas");
    return Boolean(canvas) && elementAt(number).viewer.isReady && !canvas.getContext("webgl2").isContextLost();
  }};
  document.addEventListener("error", ({{ detail }}) => errors.push(detail), true);
</script><script src="/hyrf-viewer.js"></script>"""


def open_elements(
    browser: Browser, host: Site, attributes: str = "", *, count: int = ELEMENT_COUNT, height: int = 150, gap: int = 500
) -> None:
    element = f'<hyrf-viewer src="cloud.spz" poster="poster.gif" {attributes}></hyrf-viewer>'
    host.files["/poster.gif"] = PIXEL_DATA
    host.files["/post.html"] = (PAGE_TEMPLATE.format(height=height, gap=gap) + count * element).encode()
    browser.open(f"{host.address}/post.html")


def show_element(browser: Browser, number: int) -> None:
    browser.evaluate(f"elementAt({number}).scrollIntoView()")
    wait_until(browser, f"isDrawn({number})")


@pytest.mark.parametrize("attributes", ["", 'loading="lazy"'])
def test_each_of_many_elements_is_drawn_when_it_is_visible(one_browser: Browser, host: Site, attributes: str):
    open_elements(one_browser, host, attributes)
    for number in [*range(ELEMENT_COUNT), 0]:
        show_element(one_browser, number)
    assert one_browser.evaluate("mostContexts") <= MAX_SCENES and one_browser.evaluate("errors") == []
    closed = [number for number in range(ELEMENT_COUNT) if one_browser.evaluate(f"elementAt({number}).viewer === null")]
    assert len(closed) == ELEMENT_COUNT - MAX_SCENES
    assert one_browser.evaluate(f"partOf({closed[0]}, 'img').checkVisibility()"), "the poster is not shown"
    assert one_browser.list_errors() == []


def test_a_lazy_element_has_no_context_until_it_is_near_the_window(one_browser: Browser, host: Site):
    open_elements(one_browser, host, 'loading="lazy"')
    wait_until(one_browser, "isDrawn(0)")
    assert one_browser.evaluate("mostContexts") == 1 and one_browser.evaluate("elementAt(1).viewer") is None


def test_an_element_that_comes_back_keeps_its_camera(one_browser: Browser, host: Site):
    open_elements(one_browser, host)
    wait_until(one_browser, "isDrawn(0)")
    camera = "0.5,0.2,-3,1,0,0,0,1.2,3"
    one_browser.evaluate(f"elementAt(0).viewer.camera = '{camera}'")
    text = one_browser.evaluate("elementAt(0).viewer.cameraText")
    for number in range(1, MAX_SCENES + 2):
        show_element(one_browser, number)
    assert one_browser.evaluate("elementAt(0).viewer") is None
    show_element(one_browser, 0)
    found = one_browser.evaluate("elementAt(0).viewer.cameraText")
    assert [float(part) for part in found.split(",")] == pytest.approx([float(part) for part in text.split(",")])


def test_an_element_that_comes_back_shows_the_scene_that_a_script_has_loaded(one_browser: Browser, host: Site):
    open_elements(one_browser, host)
    wait_until(one_browser, "isDrawn(0)")
    one_browser.evaluate("elementAt(0).viewer.load('some scene.hyrf', { name: 'another' })")
    one_browser.evaluate("elementAt(0).viewer.camera = '0.5,0.2,-3,1,0,0,0,1.2,3'")
    text = one_browser.evaluate("elementAt(0).viewer.cameraText")
    for number in range(1, MAX_SCENES + 2):
        show_element(one_browser, number)
    assert one_browser.evaluate("elementAt(0).viewer") is None
    show_element(one_browser, 0)
    title, found = one_browser.evaluate("(({ viewer }) => [viewer.scene.title, viewer.cameraText])(elementAt(0))")
    assert title == "another"
    assert [float(part) for part in found.split(",")] == pytest.approx([float(part) for part in text.split(",")])


def test_an_element_that_is_suspended_while_another_scene_loads_opens_it_at_its_own_camera(
    one_browser: Browser, host: Site
):
    open_elements(one_browser, host)
    wait_until(one_browser, "isDrawn(0)")
    one_browser.evaluate("elementAt(0).viewer.camera = '0.5,0.2,-3,1,0,0,0,1.2,3'")
    server = hold(host, "/some scene.hyrf")
    one_browser.evaluate("elementAt(0).setAttribute('src', 'some scene.hyrf')")
    wait_for_request(host, "/some scene.hyrf")
    for number in range(1, MAX_SCENES + 2):
        show_element(one_browser, number)
    assert one_browser.evaluate("elementAt(0).viewer") is None
    server.release()
    show_element(one_browser, 0)
    first, chosen = one_browser.evaluate(
        "(({ viewer }, first = viewer.cameraText) => (viewer.camera = 0, [first, viewer.cameraText]))(elementAt(0))"
    )
    assert [float(part) for part in first.split(",")] == pytest.approx([float(part) for part in chosen.split(",")])


def test_a_visible_element_beyond_the_limit_says_that_it_waits(one_browser: Browser, host: Site):
    open_elements(one_browser, host, count=MAX_SCENES + 1, height=10, gap=0)
    wait_until(one_browser, f"partOf({MAX_SCENES}, 'p').checkVisibility()")
    assert "12 scenes" in one_browser.evaluate(f"partOf({MAX_SCENES}, 'p').textContent")
    one_browser.evaluate("elementAt(0).remove()")
    wait_until(one_browser, f"isDrawn({MAX_SCENES - 1})")
    assert not one_browser.evaluate(f"partOf({MAX_SCENES - 1}, 'p').checkVisibility()")


TAKE_CONTEXTS_JS = (
    f"window.others = Array.from({{ length: {CHROMIUM_CONTEXT_LIMIT} }},"
    " () => document.createElement('canvas').getContext('webgl2')), 0"
)


def test_an_element_whose_context_was_taken_away_says_so_over_the_poster(one_browser: Browser, host: Site):
    open_elements(one_browser, host, count=1)
    wait_until(one_browser, "isDrawn(0)")
    one_browser.evaluate(TAKE_CONTEXTS_JS)
    wait_until(one_browser, "partOf(0, 'p').checkVisibility()")
    assert "graphics device was lost" in one_browser.evaluate("partOf(0, 'p').textContent")
    assert one_browser.evaluate("partOf(0, 'img').checkVisibility() && !isDrawn(0)")


def test_a_distant_element_whose_context_was_taken_away_is_drawn_when_it_is_visible(one_browser: Browser, host: Site):
    open_elements(one_browser, host, count=2)
    wait_until(one_browser, "isDrawn(0) && elementAt(1).viewer.isReady")
    one_browser.evaluate(TAKE_CONTEXTS_JS)
    wait_until(one_browser, "elementAt(1).viewer === null")
    show_element(one_browser, 1)


def test_an_element_that_comes_back_without_its_context_gets_a_new_viewer(one_browser: Browser, host: Site):
    open_elements(one_browser, host, count=3, gap=2000)
    wait_until(one_browser, "isDrawn(0)")
    one_browser.evaluate(TAKE_CONTEXTS_JS)
    wait_until(one_browser, "partOf(0, 'p').checkVisibility()")
    show_element(one_browser, 2)
    show_element(one_browser, 0)
    assert not one_browser.evaluate("partOf(0, 'p').checkVisibility()")
