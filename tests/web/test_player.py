"""The player moves its camera by mouse, touch and keys, and reports what the browser cannot do."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from web.pages import (
    CAMERA_CASES,
    SCENE_CENTER,
    UP_DIRECTION,
    Browser,
    camera_json,
    make_camera,
    make_splats_page,
    open_page,
    random_splats,
    wait_for_message,
    wait_until,
    wait_until_at_rest,
    wait_until_still,
    window_camera,
)

from hyrfpack.cameras.paths import look_at
from hyrfpack.scene import Camera

pytestmark = pytest.mark.in_turn


def test_the_address_can_set_the_camera(browser: Browser, tmp_path: Path):
    open_page(browser, tmp_path, make_splats_page(random_splats()), "#camera=" + camera_json(make_camera(1.0)))
    np.testing.assert_allclose(window_camera(browser).camera_from_world, make_camera(1.0).camera_from_world, atol=1e-9)


def test_the_window_starts_at_the_first_camera_and_draws_only_when_something_changes(browser: Browser, tmp_path: Path):
    wait_until_still(open_page(browser, tmp_path, make_splats_page(random_splats())))
    np.testing.assert_allclose(window_camera(browser).camera_from_world, make_camera().camera_from_world, atol=1e-9)
    frames = browser.evaluate("hyrfpack.frames()")
    time.sleep(0.3)
    assert browser.evaluate("hyrfpack.frames()") == frames


@pytest.mark.smoke
def test_mouse_and_keys_move_the_camera(browser: Browser, tmp_path: Path):
    browser.prefer(reduced_motion=True)  # the camera jumps to its target, which a test below shows to be the same
    open_page(browser, tmp_path, make_splats_page(random_splats()))
    home = window_camera(browser)

    browser.drag((120, 90), (170, 90))
    orbited = window_camera(browser)
    assert np.linalg.norm(orbited.position - SCENE_CENTER) == pytest.approx(
        np.linalg.norm(home.position - SCENE_CENTER)
    )
    assert (orbited.position - home.position) @ home.rotation[0] < -0.3  # the scene follows the pointer
    assert orbited.position @ UP_DIRECTION == pytest.approx(home.position @ UP_DIRECTION, abs=1e-6)

    for _ in range(5):  # the drags lead far beyond the pole
        browser.drag((120, 20), (120, 170))
    assert 0.99 < -window_camera(browser).forward @ UP_DIRECTION < 1.0

    browser.press("r")
    np.testing.assert_allclose(window_camera(browser).camera_from_world, home.camera_from_world, atol=1e-9)
    browser.drag((120, 90), (140, 90), button="right")
    panned = window_camera(browser).position - home.position
    assert panned @ home.rotation[0] < -0.1 and abs(panned @ home.forward) < 1e-9

    browser.press("r")
    browser.wheel(120, 90, -300)
    assert np.linalg.norm(window_camera(browser).position - SCENE_CENTER) < 2.0
    browser.press("w", seconds=0.3)
    wait_until_still(browser)
    assert np.linalg.norm(window_camera(browser).position - SCENE_CENTER) < 1.6

    browser.press("n")
    np.testing.assert_allclose(window_camera(browser).camera_from_world, make_camera(1.5).camera_from_world, atol=1e-9)
    browser.press("p")
    browser.press("p")
    np.testing.assert_allclose(window_camera(browser).camera_from_world, make_camera(4.0).camera_from_world, atol=1e-9)
    visible = "document.getElementById('toolbar').checkVisibility()"
    assert browser.evaluate(visible)
    browser.press("h")
    assert not browser.evaluate(visible)
    assert browser.list_errors() == []


def test_the_scene_follows_the_pointer_when_the_camera_is_upside_down(browser: Browser, tmp_path: Path):
    open_page(browser, tmp_path, make_splats_page(random_splats(), cameras=[CAMERA_CASES["turned upside down"]]))
    home = window_camera(browser)
    browser.drag((120, 90), (170, 90))
    assert (window_camera(browser).position - home.position) @ home.rotation[0] < -0.3


def test_the_speed_in_the_middle_of_the_scene_follows_its_size(browser: Browser, tmp_path: Path):
    open_page(
        browser,
        tmp_path,
        make_splats_page(random_splats(), cameras=[make_camera(0.01), make_camera(2.5), make_camera(4.0)]),
    )
    home = window_camera(browser)
    browser.drag((120, 90), (140, 90), button="right")
    assert np.linalg.norm(window_camera(browser).position - home.position) > 0.05


def test_the_wheel_zooms_towards_the_pointer(browser: Browser, tmp_path: Path):
    open_page(browser, tmp_path, make_splats_page(random_splats()))
    home = window_camera(browser)
    ray = np.array([(60 - home.cx) / home.fx, (110 - home.cy) / home.fy, 1.0])
    point = home.position + 2.5 * ray @ home.rotation
    browser.wheel(60, 110, -200)
    near = window_camera(browser)
    x, y, z = near.rotation @ point + near.camera_from_world[:3, 3]
    assert z < 2.2
    assert (near.fx * x / z + near.cx, near.fy * y / z + near.cy) == pytest.approx((60, 110), abs=1e-6)


def test_two_fingers_pan_and_pinch(browser: Browser, tmp_path: Path):
    open_page(browser, tmp_path, make_splats_page(random_splats()))
    browser.resize(240, 180, phone=True)
    try:
        home = window_camera(browser)
        browser.touch("touchStart", (100, 90), (140, 90))
        browser.touch("touchMove", (80, 90), (160, 90))
        browser.touch("touchEnd")
        assert np.linalg.norm(window_camera(browser).position - SCENE_CENTER) == pytest.approx(1.25, abs=0.05)
        near = window_camera(browser)
        browser.touch("touchStart", (100, 90))
        browser.touch("touchMove", (140, 90))
        browser.touch("touchEnd")
        assert (window_camera(browser).position - near.position) @ home.rotation[0] < -0.1
    finally:
        browser.resize(240, 180)


def press_twice(browser: Browser, x: float, y: float, pointer: str) -> None:
    """Double-click or double-tap. The page sends the events, because on a busy machine the driver's come too late."""
    browser.evaluate(f"""((view) => {{
      const capture = view.setPointerCapture;
      view.setPointerCapture = () => {{}}; // there is no real pointer to capture
      for (const name of ['down', 'up', 'down', 'up']) {{
        const place = {{ pointerId: 9, pointerType: '{pointer}', clientX: {x}, clientY: {y} }};
        view.dispatchEvent(new PointerEvent(`pointer${{name}}`, place));
      }}
      view.setPointerCapture = capture;
    }})(document.getElementById('view'))""")


@pytest.mark.parametrize("reduced_motion", [False, True], ids=["glide", "jump"])
def test_a_double_click_brings_its_place_to_the_center_and_orbits_it(
    browser: Browser, tmp_path: Path, reduced_motion: bool
):
    browser.prefer(reduced_motion=reduced_motion)
    one = random_splats(1, 0)
    place = SCENE_CENTER + 0.4 * make_camera().rotation[0] - 0.5 * make_camera().forward
    one = replace(one, positions=place[None], scales=np.full((1, 3), 0.05, np.float32), opacities=np.ones(1))
    wait_until_still(open_page(browser, tmp_path, make_splats_page(one)))
    at = window_camera(browser)
    x, y, z = at.rotation @ place + at.camera_from_world[:3, 3]
    spot = at.fx * x / z + at.cx, at.fy * y / z + at.cy
    assert abs(spot[0] - 120) > 20
    press_twice(browser, *spot, "mouse")
    near = window_camera(browser)
    x, y, z = near.rotation @ place + near.camera_from_world[:3, 3]
    assert (near.fx * x / z, near.fy * y / z) == pytest.approx((0, 0), abs=1.5)
    distance = np.linalg.norm(near.position - place)
    assert distance == pytest.approx(0.5 * np.linalg.norm(at.position - place), rel=0.02)
    assert abs(near.rotation[0] @ UP_DIRECTION) < 1e-6, "the horizon is tilted"
    browser.drag((120, 90), (160, 100))
    after = window_camera(browser)
    assert np.linalg.norm(after.position - near.position) > 0.15
    assert np.linalg.norm(after.position - place) == pytest.approx(distance, rel=0.01)


def test_missing_webgl_damaged_pages_and_invalid_cameras_are_reported(browser: Browser, tmp_path: Path):
    file = tmp_path / "page.html"
    page = make_splats_page(random_splats(50))
    file.write_bytes(page)
    with browser.before_every_page("HTMLCanvasElement.prototype.getContext = () => null"):
        browser.open(file.as_uri())
        assert "needs WebGL 2" in wait_for_message(browser)
    file.write_bytes(re.sub(rb'(class="payload">.{400}).{40}', rb"\1", page))
    browser.open(file.as_uri())
    assert "cannot be shown" in wait_for_message(browser)
    file.write_bytes(page)
    browser.open(file.as_uri() + "#camera={}")
    assert "needs width" in wait_for_message(browser)


def test_the_page_cannot_fetch_anything(browser: Browser, tmp_path: Path):
    open_page(browser, tmp_path, make_splats_page(random_splats(3)))
    refused = "fetch('data:,x').then(() => 'fetched', () => 'refused')"
    assert browser.evaluate(refused) == "refused"


@pytest.fixture(autouse=True)
def reset_window(browser: Browser) -> Iterator[None]:
    """Reset the window size and the user's preferences after each test."""
    yield
    browser.resize(240, 180)
    browser.prefer()


def current_position(browser: Browser) -> np.ndarray:
    """Return the current position of the camera, which may still be moving."""
    return Camera(**{**browser.evaluate("hyrfpack.camera()"), "camera_from_world": np.array(
        browser.evaluate("hyrfpack.camera().camera_from_world")
    )}).position  # fmt: skip


def test_a_damped_drag_ends_exactly_where_an_undamped_one_does(browser: Browser, tmp_path: Path):
    ends = {}
    for reduced_motion in (True, False):
        browser.prefer(reduced_motion=reduced_motion)
        open_page(browser, tmp_path, make_splats_page(random_splats(50)))
        browser.drag((120, 90), (150, 110))
        wait_until_at_rest(browser).drag((120, 90), (110, 93), button="right")
        wait_until_at_rest(browser).wheel(60, 150, -200)
        ends[reduced_motion] = window_camera(browser).camera_from_world
    np.testing.assert_allclose(ends[True], ends[False], atol=1e-9)


def test_no_frames_are_drawn_after_damping_ends(browser: Browser, tmp_path: Path):
    wait_until_still(open_page(browser, tmp_path, make_splats_page(random_splats(50))))
    before = browser.evaluate("hyrfpack.frames()")
    browser.wheel(120, 90, -200)
    wait_until_still(browser)
    frames = browser.evaluate("hyrfpack.frames()")
    assert frames - before > 3
    time.sleep(0.5)
    assert browser.evaluate("hyrfpack.frames()") == frames
    assert not browser.evaluate("hyrfpack.player.driven")


def test_the_glide_to_another_camera_stops_at_user_input(browser: Browser, tmp_path: Path):
    open_page(browser, tmp_path, make_splats_page(random_splats(50)))
    far, near = make_camera(2.5).position, make_camera(1.5).position
    browser.evaluate("(window.way = [], hyrfpack.player.addEventListener('frame', () => way.push(hyrfpack.camera())))")
    browser.press("n")
    np.testing.assert_allclose(window_camera(browser).camera_from_world, make_camera(1.5).camera_from_world, atol=1e-9)
    on_its_way = [np.linalg.norm(np.array(at["camera_from_world"])[:3, 3]) for at in browser.evaluate("way")]
    assert len(set(np.round(on_its_way, 6))) > 3
    # The second frame of the glide is the last one before the input, so that a slow machine does not end it before.
    browser.evaluate(
        "((player) => { let frames = 0; player.addEventListener('moved', () => ++frames === 2 && player.pause()); })"
        "(hyrfpack.player)"
    )
    browser.press("p")
    wait_until(browser, "hyrfpack.player.paused")
    browser.button_down(120, 90)
    stopped = current_position(browser)
    browser.button_up(120, 90)
    browser.evaluate("hyrfpack.player.resume()")
    time.sleep(0.4)
    np.testing.assert_allclose(current_position(browser), stopped, atol=1e-9)
    assert np.linalg.norm(stopped - far) > 1e-3 and np.linalg.norm(stopped - near) > 1e-3


def test_a_glide_passes_between_its_ends_and_reduced_motion_jumps(browser: Browser, tmp_path: Path):
    turned = replace(
        make_camera(), camera_from_world=look_at(SCENE_CENTER + np.array([-2.0, -0.5, 1.5]), SCENE_CENTER, UP_DIRECTION)
    )
    browser.prefer(reduced_motion=True)
    open_page(browser, tmp_path, make_splats_page(random_splats(50), cameras=[make_camera(), turned]))
    browser.press("n")
    np.testing.assert_array_equal(current_position(browser), window_camera(browser).position)
    assert np.linalg.norm(current_position(browser) - turned.position) < 1e-9
    # The script stops half-way: both cameras look at the same target, and the distance lies between theirs.
    browser.prefer()
    script = """(() => {
        const { player } = hyrfpack, glide = player.movers.find((mover) => "path" in mover);
        player.choose(0);
        glide.to(() => player.choose(1));
        glide.advance(0.4);
        const camera = hyrfpack.camera();
        glide.advance(9);
        return [camera, glide.active];
    })()"""
    (half, active) = browser.evaluate(script)
    pose = np.array(half["camera_from_world"])
    position = -pose[:3, :3].T @ pose[:3, 3]
    distances = sorted(np.linalg.norm(at.position - SCENE_CENTER) for at in (make_camera(), turned))
    assert distances[0] * 0.7 < np.linalg.norm(position - SCENE_CENTER) < distances[1] * 1.05
    np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-9)
    ahead = pose[:3, :3] @ SCENE_CENTER + pose[:3, 3]
    assert np.abs(ahead[:2]).max() < 0.05 * ahead[2], "the target is not in the middle"
    assert not active


def test_autorotation_pauses_at_user_input_and_can_be_stopped(browser: Browser, tmp_path: Path):
    open_page(browser, tmp_path, make_splats_page(random_splats(50)), "?autorotate")
    start = current_position(browser)
    time.sleep(0.6)
    turning = current_position(browser)
    assert np.linalg.norm(turning - start) > 0.05
    assert np.linalg.norm(turning - SCENE_CENTER) == pytest.approx(np.linalg.norm(start - SCENE_CENTER), rel=1e-6)
    browser.drag((120, 90), (125, 90))
    paused = window_camera(browser).position
    time.sleep(0.5)
    np.testing.assert_array_equal(current_position(browser), paused)
    ends = time.monotonic() + 10
    while np.array_equal(current_position(browser), paused):
        assert time.monotonic() < ends, "the rotation does not resume"
        time.sleep(0.1)
    browser.press("t")
    stopped = window_camera(browser).position
    wait_until_still(browser)
    np.testing.assert_array_equal(current_position(browser), stopped)


def test_autorotation_waits_while_a_finger_is_down(browser: Browser, tmp_path: Path):
    open_page(browser, tmp_path, make_splats_page(random_splats(50)), "?autorotate")
    browser.touch("touchStart", (120, 90))
    time.sleep(0.1)
    turntable = "hyrfpack.player.movers.find((mover) => 'resumesAt' in mover)"
    browser.evaluate(f"{turntable}.resumesAt = 0")  # as if the finger had been still for 4 s
    held = current_position(browser)
    time.sleep(0.3)
    np.testing.assert_array_equal(current_position(browser), held)
    browser.touch("touchEnd")
    browser.evaluate(f"{turntable}.resumesAt = 0, hyrfpack.player.changed()")
    time.sleep(0.3)
    assert np.linalg.norm(current_position(browser) - held) > 0.02


def test_reduced_motion_prevents_autorotation_until_it_is_requested(browser: Browser, tmp_path: Path):
    browser.prefer(reduced_motion=True)
    open_page(browser, tmp_path, make_splats_page(random_splats(50)), "?autorotate")
    start = current_position(browser)
    time.sleep(0.3)
    np.testing.assert_array_equal(current_position(browser), start)
    browser.press("t")
    time.sleep(0.4)
    assert np.linalg.norm(current_position(browser) - start) > 0.02


def test_keys_zoom_orbit_and_set_the_center_of_the_orbit(browser: Browser, tmp_path: Path):
    wait_until_still(open_page(browser, tmp_path, make_splats_page(random_splats())))
    home = window_camera(browser)
    browser.press("+", seconds=0.3)
    near = window_camera(browser)
    assert np.linalg.norm(near.position - SCENE_CENTER) < 0.9 * np.linalg.norm(home.position - SCENE_CENTER)
    browser.press("-", seconds=0.3)
    assert np.linalg.norm(window_camera(browser).position - SCENE_CENTER) > np.linalg.norm(near.position - SCENE_CENTER)
    before = window_camera(browser)
    browser.press("ArrowLeft", seconds=0.3, shift=True)
    after = window_camera(browser)
    assert np.linalg.norm(after.position - before.position) > 0.1
    assert np.linalg.norm(after.position - SCENE_CENTER) == pytest.approx(
        np.linalg.norm(before.position - SCENE_CENTER)
    )
    browser.press("ArrowLeft", seconds=0.3)
    rotated = window_camera(browser)
    np.testing.assert_allclose(rotated.position, after.position, atol=1e-9)
    assert not np.allclose(rotated.forward, after.forward, atol=1e-3)
    browser.press("r")
    wait_until_at_rest(browser).press("o")
    wait_until(browser, "!document.getElementById('ring').hidden")
    assert browser.list_errors() == []


def test_a_short_key_press_moves_the_camera_at_any_frame_rate(browser: Browser, tmp_path: Path):
    open_page(browser, tmp_path, make_splats_page(random_splats(50)))
    home = window_camera(browser)
    browser.press("ArrowUp")
    assert not np.array_equal(window_camera(browser).camera_from_world, home.camera_from_world)
    wait_until_still(browser)
    at = current_position(browser)
    browser.press("w")
    step = np.linalg.norm(window_camera(browser).position - at)
    assert 0.01 < step < 0.7


def test_a_double_tap_marks_its_position(browser: Browser, tmp_path: Path):
    wait_until_still(open_page(browser, tmp_path, make_splats_page(random_splats())))
    # The ring stays for a moment only, so the page itself measures it when it is shown.
    browser.evaluate("""((ring) => {
      new MutationObserver(() => {
        const { left, right, top, bottom } = ring.getBoundingClientRect();
        if (!ring.hidden) window.ringSums ??= [left + right, top + bottom];
      }).observe(ring, { attributes: true });
    })(document.getElementById('ring'))""")
    press_twice(browser, 120, 90, "touch")
    wait_until(browser, "window.ringSums")
    assert browser.evaluate("window.ringSums") == pytest.approx([240, 180], abs=3)
    wait_until(browser, "document.getElementById('ring').hidden")
