"""The interface of the page: toolbar, cameras, settings, messages, help, links and pictures, also by keyboard alone."""

from __future__ import annotations

import base64
import io
import itertools
import json
import re
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from web.native_models import run_statements
from web.pages import (
    Browser,
    camera_json,
    make_camera,
    make_splats_page,
    open_page,
    psnr,
    random_splats,
    rasterize_reference,
    render_in_page,
    wait_for_message,
    wait_until,
    wait_until_at_rest,
    wait_until_still,
    window_camera,
)  # fmt: skip
from web.scripts import run_script

from hyrfpack.cameras.view_sampling import shrink_camera
from hyrfpack.rotations import IDENTITY, rotation_matrix
from hyrfpack.web.html import decode_splats_page
from hyrfpack.web.serve import serve_in_thread

pytestmark = pytest.mark.in_turn
PHONE_OPTIONS = {"pixel_ratio": 2.0, "phone": True}


@pytest.fixture(autouse=True)
def reset_window(browser: Browser) -> Iterator[None]:
    """Reset the window size and the user's preferences after each test."""
    yield
    browser.resize(240, 180)
    browser.prefer()


CURRENT_CAMERA_JS = (
    "[...document.getElementById('strip').children].findIndex((it) => it.getAttribute('aria-pressed') === 'true')"
)


def find_box(browser: Browser, name: str) -> list[float]:
    """Return left, top, right and bottom of an element in CSS pixels."""
    sides = "({ left, top, right, bottom }) => [left, top, right, bottom]"
    return browser.evaluate(f"({sides})(document.getElementById('{name}').getBoundingClientRect())")


def is_hidden(browser: Browser, name: str) -> bool:
    return browser.evaluate(f"!document.getElementById('{name}').checkVisibility()")


# ---- layout


@pytest.mark.parametrize("size", [(390, 844), (844, 390), (300, 200), (1280, 800)], ids=str)
def test_the_toolbar_is_a_thin_strip_with_large_buttons(browser: Browser, tmp_path: Path, size: tuple[int, int]):
    browser.resize(*size, phone=size[0] < 1280)
    open_page(browser, tmp_path, make_splats_page(random_splats(50)))
    assert is_hidden(browser, "strip") == (size != (1280, 800))  # only a large window has room for it
    left, top, right, bottom = find_box(browser, "toolbar")
    assert left >= 0 and right <= size[0] and bottom <= size[1] and bottom - top <= 48
    widths = browser.evaluate(
        "[...document.querySelectorAll('#toolbar button')].filter((button) => button.checkVisibility())"
        ".map((button) => button.getBoundingClientRect()).map(({ width, height }) => [width, height])"
    )
    assert len(widths) >= 4 and np.min(widths) >= 44
    hidden = "button => !button.checkVisibility() && button.id !== 'fullscreen'"
    missing = f"[...document.querySelectorAll('#toolbar button')].filter({hidden}).map((it) => it.dataset.key)"
    browser.evaluate("document.getElementById('menu').click()")
    in_sheet = "[...document.querySelectorAll('#settings button')].filter((it) => it.checkVisibility())"
    assert set(browser.evaluate(missing)) <= set(browser.evaluate(f"{in_sheet}.map((it) => it.dataset.key ?? '')"))
    left, top, right, bottom = find_box(browser, "settings")
    assert left >= 0 and top >= 0 and right <= size[0] and bottom <= size[1]


@pytest.mark.parametrize(("name", "button"), [("strip", "views"), ("settings", "menu")])
def test_buttons_open_and_close_the_cameras_and_the_settings(browser: Browser, tmp_path: Path, name: str, button: str):
    open_page(browser, tmp_path, make_splats_page(random_splats(50)))
    for is_open in (True, False):
        browser.evaluate(f"document.getElementById('{button}').click()")
        assert is_hidden(browser, name) != is_open
        expanded = browser.evaluate(f"document.getElementById('{button}').getAttribute('aria-expanded')")
        assert expanded == str(is_open).lower()


def test_the_settings_close_by_escape_and_by_a_press_on_the_scene(browser: Browser, tmp_path: Path):
    browser.resize(1280, 800)
    open_page(browser, tmp_path, make_splats_page(random_splats(50)))
    for close in (lambda: browser.press("Escape"), lambda: browser.click(300, 300)):
        browser.press("m")
        assert not is_hidden(browser, "settings")
        close()
        assert is_hidden(browser, "settings")


def test_the_toolbar_of_a_small_frame_disappears_until_the_next_input(browser: Browser, tmp_path: Path):
    opacity = "Number(getComputedStyle(document.getElementById('toolbar')).opacity)"
    for size, is_small in {(300, 200): True, (800, 600): False}.items():
        browser.resize(*size)
        open_page(browser, tmp_path, make_splats_page(random_splats(50)))
        browser.move(100, 100)
        assert browser.evaluate(opacity) == 1
        wait_until(browser, "document.body.classList.contains('idle')")
        wait_until(browser, f"{opacity} === {0 if is_small else 1}")
        browser.move(120, 110)
        wait_until(browser, f"{opacity} === 1")
    assert browser.evaluate("document.body.classList.contains('idle')") is False


def test_a_focused_button_shows_its_name_and_key(browser: Browser, tmp_path: Path):
    browser.resize(1280, 800)
    open_page(browser, tmp_path, make_splats_page(random_splats(50)))
    tip = "getComputedStyle(document.getElementById('turn'), '::after').visibility"
    assert browser.evaluate(tip) == "hidden"
    browser.press("Tab")
    browser.evaluate("document.getElementById('turn').focus()")
    assert browser.evaluate(tip) == "visible"


def test_a_picture_at_rest_follows_the_pixel_ratio_of_the_window(browser: Browser, tmp_path: Path):
    open_page(browser, tmp_path, make_splats_page(random_splats(50)))
    wait_until(browser, "hyrfpack.player.idle")
    for ratio in (2.0, 1.5, 1.0):
        browser.resize(240, 180, pixel_ratio=ratio)
        wait_until(browser, f"hyrfpack.player.canvas.width === {240 * ratio:.0f}")


# ---- the strip of cameras


def find_current_camera(browser: Browser) -> int:
    """Return the index of the camera that the strip marks."""
    return browser.evaluate(CURRENT_CAMERA_JS)


def test_the_strip_shows_what_each_camera_sees_and_moves_there(browser: Browser, tmp_path: Path):
    browser.resize(1280, 800)
    page = make_splats_page(random_splats())
    open_page(browser, tmp_path, page)
    wait_until(browser, "document.querySelectorAll('#strip canvas').length === 3")
    splats = decode_splats_page(page, "page")[0]
    for number, distance in enumerate((2.5, 1.5, 4.0)):
        data = browser.evaluate(
            f"document.querySelectorAll('#strip canvas')[{number}].toDataURL('image/png').split(',')[1]"
        )
        with Image.open(io.BytesIO(base64.b64decode(data))) as picture:
            seen = np.asarray(picture.convert("RGB"), np.float64)
        assert psnr(seen, rasterize_reference(splats, shrink_camera(make_camera(distance), 96))) > 30
    home = window_camera(browser)
    np.testing.assert_allclose(home.camera_from_world, make_camera().camera_from_world, atol=1e-9)
    wait_until_still(browser)
    assert psnr(render_in_page(browser, home), rasterize_reference(splats, home)) > 40, "the order is of another view"
    browser.evaluate("document.querySelectorAll('#strip button')[1].click()")
    np.testing.assert_allclose(window_camera(browser).camera_from_world, make_camera(1.5).camera_from_world, atol=1e-9)
    assert find_current_camera(browser) == 1
    assert browser.list_errors() == []


def test_a_strip_that_is_reopened_while_it_is_drawn_is_drawn_once(browser: Browser, tmp_path: Path):
    browser.resize(600, 400)
    open_page(browser, tmp_path, make_splats_page(random_splats(50)))
    run_statements(
        browser,
        "const { player } = hyrfpack, { preview } = player, button = document.getElementById('views');"
        " window.previews = 0; player.preview = (views) => { window.previews++; return preview.call(player, views); };"
        " for (let k = 0; k < 3; k++) button.click();",
    )
    wait_until(browser, "document.querySelectorAll('#strip canvas').length === 3")
    wait_until_still(browser)
    assert browser.evaluate("previews") == 1


def test_a_scene_with_one_camera_has_no_strip(browser: Browser, tmp_path: Path):
    browser.resize(1280, 800)
    open_page(browser, tmp_path, make_splats_page(random_splats(50), cameras=[make_camera()]))
    browser.press("v")
    assert is_hidden(browser, "strip") and is_hidden(browser, "views")


# ---- layout of all parts


@pytest.mark.parametrize("size", [(800, 600), (390, 844), (844, 390), (320, 480)], ids=str)
def test_no_element_overlaps_another_or_leaves_the_window(browser: Browser, tmp_path: Path, size: tuple[int, int]):
    browser.resize(*size)
    has_strip = size[1] > 500
    names = ["heading", "toolbar", "loading", "hint", "remark", "message", *(["strip"] if has_strip else [])]
    open_page(
        browser,
        tmp_path,
        make_splats_page(random_splats(50), title="a_very_long_name_of_a_scene " * 8 + "without_any_space" * 9),
    )
    browser.evaluate(
        "document.getElementById('hint').hidden = false,"
        "document.getElementById('exposure').hidden = false,"
        "document.getElementById('remark').textContent = 'Drawn with harmonics: this device is too weak.',"
        "document.getElementById('remark').hidden = false,"
        f"document.getElementById('strip').hidden = {json.dumps(not has_strip)}"
    )
    browser.evaluate("location.hash = 'camera=no'")
    assert "camera" in wait_for_message(browser)
    browser.evaluate("document.getElementById('loading').hidden = false")
    boxes = browser.evaluate(
        f"{names}.map((name) => {{"
        "  const box = document.getElementById(name).getBoundingClientRect();"
        "  return [name, box.left, box.top, box.right, box.bottom];"
        "})"
    )
    for name, left, top, right, bottom in boxes:
        assert left >= 0 and top >= 0 and right <= size[0] and bottom <= size[1] and right - left > 20, name
    for (one, *a), (other, *b) in itertools.combinations(boxes, 2):
        assert a[2] <= b[0] or b[2] <= a[0] or a[3] <= b[1] or b[3] <= a[1], f"{one} overlaps {other}"


def test_the_page_shows_title_count_and_speed(browser: Browser, tmp_path: Path):
    browser.resize(1280, 800)
    open_page(browser, tmp_path, make_splats_page(random_splats(1500), title="<b>& co"))
    text = "document.getElementById('{}').textContent"
    assert browser.evaluate(text.format("title")) == "<b>& co"
    assert browser.evaluate(text.format("count")) == "1,500 splats"
    ends = time.monotonic() + 20
    while not re.fullmatch(r"\d+ fps", browser.evaluate(text.format("speed"))):
        assert time.monotonic() < ends, "the settings show no speed"
        browser.press("w", seconds=0.5)  # a frame may take longer than half a second


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_text_has_enough_contrast_in_light_and_dark(browser: Browser, tmp_path: Path, scheme: str):
    browser.prefer(scheme)
    browser.resize(1280, 800)
    open_page(browser, tmp_path, make_splats_page(random_splats(3)))
    script = """(() => {
        const style = getComputedStyle(document.documentElement);
        const context = new OffscreenCanvas(1, 1).getContext("2d", { willReadFrequently: true });
        const read = (layers) => {
            for (const layer of layers) {
                context.fillStyle = layer.startsWith("--") ? style.getPropertyValue(layer) : layer;
                context.fillRect(0, 0, 1, 1);
            }
            return [...context.getImageData(0, 0, 1, 1).data.slice(0, 3)];
        };
        return ["white", "black"].flatMap((scene) => [
            [read(["--ink"]), read([scene, "--glass"])], [read(["--dim"]), read([scene, "--glass"])],
            [read(["--ink"]), read([scene, "--glass", "--button"])],
            [read(["--accent"]), read([scene, "--glass", "--button"])],
            [read(["--dim"]), read(["--solid"])], [read(["--light"]), read([scene, "--pill"])],
            [read(["--ink"]), read(["--page"])],
        ]);
    })()"""
    for ink, paper in browser.evaluate(script):
        light, dark = sorted(map(relative_luminance, (ink, paper)), reverse=True)
        assert (light + 0.05) / (dark + 0.05) >= 4.5, (ink, paper)
    dark_page = relative_luminance(browser.evaluate(script)[-1][1]) < 0.1
    assert dark_page == (scheme == "dark")


def relative_luminance(color: list[int]) -> float:
    """Return the relative luminance of sRGB bytes (WCAG 2)."""
    values = np.array(color) / 255
    linear = np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)
    return float(linear @ [0.2126, 0.7152, 0.0722])


def test_noui_hides_everything_but_the_canvas_and_messages(browser: Browser, tmp_path: Path):
    browser.resize(1280, 800)
    open_page(browser, tmp_path, make_splats_page(random_splats(50)), "?noui#camera=77")
    assert all(is_hidden(browser, name) for name in ("heading", "toolbar", "strip", "hint", "invitation", "loading"))
    assert "no camera 77, only 3" in wait_for_message(browser) and not is_hidden(browser, "message")


# ---- messages


def test_a_message_is_dismissed_by_button_by_escape_and_by_a_valid_address(browser: Browser, tmp_path: Path):
    browser.resize(480, 360)
    open_page(browser, tmp_path, make_splats_page(random_splats(50)), "#camera={}")
    assert "needs width" in wait_for_message(browser)
    browser.evaluate("document.getElementById('dismiss').click()")
    assert is_hidden(browser, "message")
    for bad, way_out in {
        "%zz": lambda: browser.press("Escape"),
        "0": lambda: browser.evaluate("location.hash = 'camera=2'"),
    }.items():
        browser.evaluate(f"location.hash = 'camera={bad}'")
        assert "camera in the address cannot be used" in wait_for_message(browser)
        box = browser.evaluate("document.getElementById('message').getBoundingClientRect().top")
        assert box > 200, "the message covers the middle of the window"
        way_out()
        wait_until(browser, "document.getElementById('message').hidden")


ERROR_BY_INVALID_CAMERA = {
    "0": "no camera 0, only 3", "4": "no camera 4, only 3", "-1": "9 numbers", "1,2,3": "9 numbers",
    "1,2,3,0,0,0,0,1": "no unit quaternion", "1,2,3,1,0,0,0,1e9": "focal length", "1,2,3,1,0,0,0,nan": "9 numbers",
    "1,2,3,1,0,0,0,": "9 numbers", "{": "cannot be used", "[1]": "9 numbers", "null": "9 numbers",
    '{"width": 1}': "needs width", "%E0%A4%A": "cannot be used", "<b>x</b>": "9 numbers",
}  # fmt: skip


def test_invalid_cameras_in_the_address_are_reported_and_the_scene_is_shown(browser: Browser, tmp_path: Path):
    open_page(browser, tmp_path, make_splats_page(random_splats(50)))
    home = window_camera(browser)
    for text, words in ERROR_BY_INVALID_CAMERA.items():
        browser.evaluate(f"location.hash = 'camera=' + {json.dumps(text)}")
        message = wait_for_message(browser)
        assert words in message and message.startswith("The camera in the address cannot be used: "), text
        browser.press("Escape")
        wait_until(browser, "document.getElementById('message').hidden")
        np.testing.assert_array_equal(window_camera(browser).camera_from_world, home.camera_from_world)
    assert browser.list_errors() == []


# ---- the address and shared links


@pytest.mark.smoke
def test_a_shared_link_restores_the_view(browser: Browser, tmp_path: Path):
    open_page(browser, tmp_path, make_splats_page(random_splats()))
    browser.drag((120, 90), (161, 103))
    browser.wheel(60, 150, -150)
    browser.drag((120, 90), (107, 93), button="right")
    before = window_camera(browser)
    browser.press("l")
    wait_until(browser, "!document.getElementById('toast').hidden")
    fragment = browser.evaluate("location.hash")
    assert len(fragment) < 110, fragment
    open_page(browser, tmp_path, make_splats_page(random_splats()), fragment)
    after = window_camera(browser)
    assert np.linalg.norm(after.position - before.position) < 1e-4
    assert np.abs(after.rotation - before.rotation).max() < 1e-4
    assert after.fx == pytest.approx(before.fx, rel=1e-4)
    turned = [(120, 90), (160, 90)]
    browser.drag(*turned)  # orbits the same point as before
    there = window_camera(browser)
    open_page(browser, tmp_path, make_splats_page(random_splats()), "#camera=" + camera_json(before))
    browser.drag(*turned)
    assert np.linalg.norm(there.position - window_camera(browser).position) < 0.5
    assert browser.list_errors() == []


def test_links_are_exact_for_any_unit_and_rotation(tmp_path: Path):
    rng = np.random.default_rng(5)
    cases = []
    for _ in range(300):
        rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        rotation *= np.sign(np.linalg.det(rotation))
        unit = float(10.0 ** rng.uniform(-5, 6))
        case = {
            "rows": rotation.tolist(),
            "eye": (rng.normal(size=3) * 3).tolist(),
            "fy": float(rng.uniform(100, 3000)),
        }
        quat = rng.normal(size=4)
        turned = {"rotation": (quat / np.linalg.norm(quat)).tolist()} if len(cases) % 2 else {}
        cases.append({**case, "unit": unit, "center": (rng.normal(size=3) * unit * 10).tolist(), **turned})
    (tmp_path / "cases.json").write_text(json.dumps(cases))
    answers = run_script(Path(__file__).with_name("links.mjs"), tmp_path / "cases.json")
    for case, answer in zip(cases, answers, strict=True):
        expected = answer["expected"]
        assert np.abs(np.array(answer["rows"]) - case["rows"]).max() < 1e-5, answer
        assert np.abs(np.array(answer["eye"]) - case["eye"]).max() < 1e-5 * expected["pace"], answer
        axes = rotation_matrix(case.get("rotation", IDENTITY))
        place = np.array(case["center"]) + case["unit"] * axes @ case["eye"]  # links are in world units
        written = np.array(answer["text"].split(",")[:3], float)
        assert np.abs(written - place).max() < 1e-4 * expected["pace"] * case["unit"], answer
        assert answer["focal"] == pytest.approx(expected["focal"], rel=1e-5)
        assert answer["depth"] == pytest.approx(expected["depth"], rel=1e-4) and len(answer["text"]) < 140, answer


def test_the_link_of_a_camera_far_from_real_lenses_is_accepted(browser: Browser, tmp_path: Path):
    ratio = 60_000 / (800 * 600) ** 0.5  # a focal length of 60,000 pixels in a picture of 800 x 600
    page = make_splats_page(random_splats(50))
    open_page(browser, tmp_path, page, f"#camera=1000,-50,15,1,0,0,0,{ratio:.6g},5")
    camera = window_camera(browser)
    assert camera.fy / (camera.width * camera.height) ** 0.5 == pytest.approx(ratio, rel=1e-4)
    assert is_hidden(browser, "message")


@pytest.fixture
def served_page() -> Iterator[str]:
    """Serve a page with a scene inside; yield its address."""
    with serve_in_thread(make_splats_page(random_splats(50)), {}) as address:
        yield address


def test_the_link_is_shown_selected_where_the_clipboard_is_unavailable(browser: Browser, served_page: str):
    with browser.before_every_page("Object.defineProperty(Navigator.prototype, 'clipboard', { value: undefined })"):
        browser.open(served_page)
        browser.evaluate("hyrfpack.ready")
        browser.press("l")
        wait_until(browser, "!document.getElementById('toast').hidden")
        selected = "((field) => field.value.slice(field.selectionStart, field.selectionEnd))(document.activeElement)"
        assert browser.evaluate(selected) == browser.evaluate("location.href")
        home = window_camera(browser)
        browser.press("w", seconds=0.1)  # is typed into the text field
        assert np.array_equal(window_camera(browser).camera_from_world, home.camera_from_world)
        browser.press("Escape")
        assert is_hidden(browser, "toast")


def test_a_copied_link_equals_the_address(browser: Browser, served_page: str):
    clipboard = "{ value: { writeText: async (text) => { window.copied = text; } } }"
    with browser.before_every_page(f"Object.defineProperty(Navigator.prototype, 'clipboard', {clipboard})"):
        browser.open(served_page)
        browser.evaluate("hyrfpack.ready")
        browser.press("l")
        wait_until(browser, "window.copied !== undefined")
        assert browser.evaluate("copied === location.href && location.hash.startsWith('#camera=')")
        assert "copied" in browser.evaluate("document.getElementById('done').textContent")


@pytest.mark.parametrize("where", ["?camera=2", "#camera=2", "?camera=3#camera=2"])
def test_the_address_can_select_a_camera_by_number(browser: Browser, tmp_path: Path, where: str):
    open_page(browser, tmp_path, make_splats_page(random_splats(50)), where)
    np.testing.assert_allclose(window_camera(browser).camera_from_world, make_camera(1.5).camera_from_world, atol=1e-9)
    assert find_current_camera(browser) == 1


def test_the_address_can_set_the_title(browser: Browser, tmp_path: Path):
    open_page(browser, tmp_path, make_splats_page(random_splats(50)), "?title=%3Ci%3Emine")
    assert browser.evaluate("document.title") == "<i>mine"
    assert browser.evaluate("document.getElementById('title').children.length") == 0


# ---- pictures


def test_a_saved_picture_equals_the_window(browser: Browser, tmp_path: Path):
    script = (
        "const make = URL.createObjectURL; URL.createObjectURL = (blob) => { window.saved = blob; return make(blob); };"
        "HTMLAnchorElement.prototype.click = function () { window.savedName = this.download; }"
    )
    with browser.before_every_page(script):
        page = make_splats_page(random_splats(), title="a/scene: 1")
        wait_until_still(open_page(browser, tmp_path, page))
        browser.press("c")
        wait_until(browser, "window.savedName !== undefined")
        assert browser.evaluate("savedName") == "a_scene_ 1.png"
        text = "((bytes) => btoa(Array.from(bytes, (byte) => String.fromCharCode(byte)).join('')))"
        data = base64.b64decode(browser.evaluate(f"saved.arrayBuffer().then((all) => {text}(new Uint8Array(all)))"))
    with Image.open(io.BytesIO(data)) as picture:
        assert picture.format == "PNG"
        seen = np.asarray(picture.convert("RGB"), np.float64)
    at = window_camera(browser)
    assert seen.shape == (at.height, at.width, 3) == (180, 240, 3)
    assert psnr(seen, rasterize_reference(decode_splats_page(page, "page")[0], at)) > 40
    assert np.abs(render_in_page(browser, at) - seen).max() <= 3


ONE_PIXEL_POSTER = base64.b64decode(b"UklGRh4AAABXRUJQVlA4TBEAAAAvAAAAAAdQ//73v/+BiOh/AAA=")  # one pixel


def test_a_picture_that_cannot_be_made_is_reported(browser: Browser, tmp_path: Path):
    open_page(browser, tmp_path, make_splats_page(random_splats(50)))
    browser.evaluate("void (hyrfpack.player.canvas.toBlob = (done) => done(null))")
    browser.press("c")
    assert wait_for_message(browser) == "The picture is too large for this browser; try again in a smaller window."


def test_a_picture_saved_while_others_are_drawn_has_the_order_of_its_own_view(browser: Browser, tmp_path: Path):
    open_page(browser, tmp_path, make_splats_page(random_splats()))
    home = wait_until_still(browser).evaluate("hyrfpack.player.capture().then((blob) => blob.text())")
    statements = (
        "const { player } = hyrfpack, { cameras: [view], renderer } = player, { rows, translation } = view;"
        "const turn = ([x, y, z]) => [-x, y, -z];"
        "const behind = { ...view, rows: [turn(rows[0]), rows[1], turn(rows[2])] };"
        "const { read } = renderer;"
        "renderer.read = (...values) => {"  # the renderer has the order of the other view now
        "  const picture = read.apply(renderer, values);"
        "  window.saved ??= player.capture().then((blob) => blob.text());"
        "  return picture; };"
        "return player.settled.then(() => player.preview([behind])).then(() => saved);"
    )
    assert browser.evaluate(f"(() => {{ {statements} }})()") == home


def test_the_poster_is_shown_until_the_first_picture(browser: Browser, tmp_path: Path):
    (tmp_path / "page.html").write_bytes(make_splats_page(random_splats(), poster=ONE_PIXEL_POSTER))
    watch = (
        "addEventListener('DOMContentLoaded', () => { window.posters = [Boolean(document.getElementById('poster'))]; })"
    )
    with browser.before_every_page(watch):
        browser.open((tmp_path / "page.html").as_uri())
    browser.evaluate("hyrfpack.ready")
    assert browser.evaluate("posters") == [True]
    wait_until(browser, "!document.getElementById('poster') && hyrfpack.player.times.first !== null")


def test_without_webgl_the_poster_and_a_message_are_shown_and_no_buttons(browser: Browser, tmp_path: Path):
    browser.resize(1280, 800)
    (tmp_path / "page.html").write_bytes(make_splats_page(random_splats(50), poster=ONE_PIXEL_POSTER))
    with browser.before_every_page("HTMLCanvasElement.prototype.getContext = () => null"):
        browser.open((tmp_path / "page.html").as_uri())
        assert "needs WebGL 2" in wait_for_message(browser)
    assert not is_hidden(browser, "poster")
    assert all(is_hidden(browser, name) for name in ("heading", "toolbar", "loading"))
    assert browser.evaluate("document.getElementById('message').getBoundingClientRect().top") > 600


# ---- help


def test_help_describes_only_the_available_input_devices(browser: Browser, tmp_path: Path):
    parts = (
        "[...document.querySelectorAll('#help [data-with]')].filter((part) => part.checkVisibility())"
        ".map((part) => part.dataset.with)"
    )
    browser.resize(390, 844, **PHONE_OPTIONS)
    open_page(browser, tmp_path, make_splats_page(random_splats(3)))
    ask = "document.querySelector('[data-key=\"?\"]').click()"
    browser.evaluate(ask)
    assert browser.evaluate(parts) == ["touch"]
    browser.press("Escape")
    browser.evaluate(ask)  # the Escape key has shown that there is a keyboard
    assert browser.evaluate(parts) == ["touch", "keys"]
    browser.resize(1280, 800)
    open_page(browser, tmp_path, make_splats_page(random_splats(3)))
    browser.press("?")
    assert browser.evaluate(parts) == ["mouse", "keys"]


def test_escape_closes_the_help_alone(browser: Browser, tmp_path: Path):
    browser.resize(1280, 800)
    open_page(browser, tmp_path, make_splats_page(random_splats(3)))
    browser.press("m")
    browser.press("?")
    browser.press("Escape")
    assert is_hidden(browser, "help") and not is_hidden(browser, "settings")
    browser.press("Escape")
    assert is_hidden(browser, "settings")


def test_escape_closes_the_settings_in_the_moment_after_it_has_closed_the_help(browser: Browser, tmp_path: Path):
    browser.resize(1280, 800)
    open_page(browser, tmp_path, make_splats_page(random_splats(3)))
    browser.press("m")
    browser.press("?")
    # A closed dialog keeps the focus until the browser draws the next frame.
    browser.evaluate(
        "(({ activeElement: button }) => { document.getElementById('help').close();"
        " const key = { key: 'Escape', code: 'Escape', bubbles: true };"
        " button.dispatchEvent(new KeyboardEvent('keydown', key)); })(document)"
    )
    assert is_hidden(browser, "help") and is_hidden(browser, "settings")


def test_text_that_is_dropped_is_left_to_the_browser(browser: Browser, tmp_path: Path):
    open_page(browser, tmp_path, make_splats_page(random_splats(3)))
    assert browser.evaluate(
        "(() => { const carried = new DataTransfer(); carried.setData('text/plain', '12');"
        " return dispatchEvent(new DragEvent('drop', { dataTransfer: carried, bubbles: true, cancelable: true })); })()"
    )


def test_the_hint_of_a_first_visit_disappears_with_the_first_input(browser: Browser, tmp_path: Path):
    open_page(browser, tmp_path, make_splats_page(random_splats(3)))
    browser.evaluate("localStorage.clear()")
    open_page(browser, tmp_path, make_splats_page(random_splats(3)))
    assert browser.evaluate("document.getElementById('hint').textContent").startswith("Drag to turn")
    assert not is_hidden(browser, "hint")
    browser.drag((120, 90), (125, 90))
    wait_until(browser, "document.getElementById('hint').hidden")
    open_page(browser, tmp_path, make_splats_page(random_splats(3)))
    assert is_hidden(browser, "hint")


def test_a_page_works_without_local_storage(browser: Browser, tmp_path: Path):
    with browser.before_every_page(
        "Object.defineProperty(window, 'localStorage', { get() { throw new Error('no'); } })"
    ):
        open_page(browser, tmp_path, make_splats_page(random_splats(3)))
        assert not is_hidden(browser, "hint")
        browser.drag((120, 90), (125, 90))
        wait_until(browser, "document.getElementById('hint').hidden")
    assert browser.list_errors() == []


# ---- keyboard and screen readers


def test_the_tab_key_visibly_focuses_every_control_and_leaves_the_page(browser: Browser, tmp_path: Path):
    browser.resize(1280, 800)
    open_page(browser, tmp_path, make_splats_page(random_splats(50)))
    browser.evaluate("(localStorage.setItem('hyrfpack.hinted', '1'), document.getElementById('menu').click())")
    controls = browser.evaluate(
        "[...document.querySelectorAll('#view, button, input')].filter((part) =>"
        " part.checkVisibility() && !part.disabled)"
        ".map((part) => (part.dataset.number = Math.random(), part.dataset.number))"
    )
    assert len(controls) == 15  # canvas, 3 settings, 3 cameras and 8 buttons of the toolbar
    focused = []
    for _ in range(len(controls)):
        browser.press("Tab")
        number, outline = browser.evaluate(
            "((part) => [part.dataset.number, getComputedStyle(part).outlineStyle])(document.activeElement)"
        )
        focused.append(number)
        assert outline != "none", "the focus is not visible"
    assert focused == controls
    browser.press("Tab")
    assert browser.evaluate("document.activeElement === document.body || !document.hasFocus()"), (
        "the focus cannot leave the page"
    )


def test_every_button_has_a_working_key(browser: Browser, tmp_path: Path):
    browser.resize(1280, 800)
    open_page(browser, tmp_path, make_splats_page(random_splats(50)))
    keys = browser.evaluate("[...document.querySelectorAll('[data-key]')].map((button) => button.dataset.key)")
    assert set(keys) == set("VRTCLM?FX")
    for key, effect in {
        "t": "document.getElementById('turn').getAttribute('aria-pressed') === 'true'",
        "3": f"{CURRENT_CAMERA_JS} === 2",
        "9": f"{CURRENT_CAMERA_JS} === 2",
        "v": "document.getElementById('strip').hidden",
        "m": "!document.getElementById('settings').hidden",
        "h": "!document.getElementById('toolbar').checkVisibility()",
        "l": "!document.getElementById('toast').hidden",
        "?": "document.getElementById('help').open",
    }.items():
        browser.press(key)
        wait_until(browser, effect)
    browser.press("Escape")
    wait_until(browser, "!document.getElementById('help').open")


def test_screen_readers_get_labels_and_status_messages(browser: Browser, tmp_path: Path):
    watch = (
        "addEventListener('DOMContentLoaded', () => { window.heard = [];"
        "  const status = document.getElementById('status');"
        "  new MutationObserver(() => heard.push(status.textContent)).observe(status, { childList: true });"
        "})"
    )
    with browser.before_every_page(watch):
        open_page(browser, tmp_path, make_splats_page(random_splats(50), title="bonsai"))
    browser.evaluate("hyrfpack.player.settled.then(() => true)")
    heard = browser.evaluate("heard")
    assert any("percent" in sentence for sentence in heard) and heard[-1] == "bonsai is shown."
    assert len(heard) < 16, "too many status messages"
    browser.press("n")
    wait_until_at_rest(browser)
    assert browser.evaluate("heard.at(-1)") == "Camera 2 of 3"
    nameless = browser.evaluate(
        "[...document.querySelectorAll('button, input:not([hidden]), #view, progress')].filter((it) =>"
        " !(it.getAttribute('aria-label') || it.textContent.trim() || it.labels?.length)).map((it) => it.outerHTML)"
    )
    assert nameless == []
    live = "[...document.querySelectorAll('[role=status], [role=alert]')].map((it) => it.id)"
    assert {"status", "message", "done"} <= set(browser.evaluate(live))
