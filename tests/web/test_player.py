"""The player in browsers: it can be moved by mouse, fingers and keys, and says what it cannot do."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from web.pages import (
    CASES,
    CENTER,
    UP,
    Browser,
    camera,
    cloud,
    eye,
    json_of,
    message,
    opened,
    page_of,
    rested,
    settled,
    until,
)

from hyrfpack.cameras.paths import look_at
from hyrfpack.scene import Camera

pytestmark = pytest.mark.in_turn


def test_the_address_can_name_the_camera(browser: Browser, tmp_path: Path):
    opened(browser, tmp_path, page_of(cloud()), "#camera=" + json_of(camera(1.0)))
    np.testing.assert_allclose(eye(browser).camera_from_world, camera(1.0).camera_from_world, atol=1e-9)


def test_the_window_starts_at_the_first_camera_and_draws_only_when_something_changes(browser: Browser, tmp_path: Path):
    settled(opened(browser, tmp_path, page_of(cloud())))
    np.testing.assert_allclose(eye(browser).camera_from_world, camera().camera_from_world, atol=1e-9)
    frames = browser.evaluate("hyrfpack.frames()")
    time.sleep(0.3)
    assert browser.evaluate("hyrfpack.frames()") == frames


def test_mouse_and_keys_move_the_eye(browser: Browser, tmp_path: Path):
    browser.prefer(less_motion=True)  # it gets there at once, and to the same places: see below
    opened(browser, tmp_path, page_of(cloud()))
    home = eye(browser)

    browser.drag((120, 90), (170, 90))
    orbited = eye(browser)
    assert np.linalg.norm(orbited.position - CENTER) == pytest.approx(np.linalg.norm(home.position - CENTER))
    assert (orbited.position - home.position) @ home.rotation[0] < -0.3  # the scene follows the pointer
    assert orbited.position @ UP == pytest.approx(home.position @ UP, abs=1e-6)

    for _ in range(5):  # far beyond the pole
        browser.drag((120, 20), (120, 170))
    assert 0.99 < -eye(browser).forward @ UP < 1.0

    browser.press("r")
    np.testing.assert_allclose(eye(browser).camera_from_world, home.camera_from_world, atol=1e-9)
    browser.drag((120, 90), (140, 90), button="right")
    panned = eye(browser).position - home.position
    assert panned @ home.rotation[0] < -0.1 and abs(panned @ home.forward) < 1e-9

    browser.press("r")
    browser.mouse("mouseWheel", 120, 90, deltaX=0, deltaY=-300)
    assert np.linalg.norm(eye(browser).position - CENTER) < 2.0
    browser.press("w", seconds=0.3)
    settled(browser)
    assert np.linalg.norm(eye(browser).position - CENTER) < 1.6

    browser.press("n")
    np.testing.assert_allclose(eye(browser).camera_from_world, camera(1.5).camera_from_world, atol=1e-9)
    browser.press("p")
    browser.press("p")
    np.testing.assert_allclose(eye(browser).camera_from_world, camera(4.0).camera_from_world, atol=1e-9)
    assert browser.evaluate("document.getElementById('cameras').selectedIndex") == 2
    hidden = "document.getElementById('panel').hidden"
    assert browser.evaluate(hidden)  # in a window so small
    browser.press("h")
    assert not browser.evaluate(hidden)
    assert browser.list_errors() == []


def test_the_scene_follows_the_pointer_where_the_camera_stands_on_its_head(browser: Browser, tmp_path: Path):
    opened(browser, tmp_path, page_of(cloud(), cameras=[CASES["turned upside down"]]))
    home = eye(browser)
    browser.drag((120, 90), (170, 90))
    assert (eye(browser).position - home.position) @ home.rotation[0] < -0.3


def test_a_camera_in_the_middle_of_the_scene_flies_as_fast_as_befits_its_size(browser: Browser, tmp_path: Path):
    opened(browser, tmp_path, page_of(cloud(), cameras=[camera(0.01), camera(2.5), camera(4.0)]))
    home = eye(browser)
    browser.drag((120, 90), (140, 90), button="right")
    assert np.linalg.norm(eye(browser).position - home.position) > 0.05


def test_the_wheel_zooms_towards_the_pointer(browser: Browser, tmp_path: Path):
    opened(browser, tmp_path, page_of(cloud()))
    home = eye(browser)
    ray = np.array([(60 - home.cx) / home.fx, (150 - home.cy) / home.fy, 1.0])
    point = home.position + 2.5 * ray @ home.rotation
    browser.mouse("mouseWheel", 60, 150, deltaX=0, deltaY=-200)
    near = eye(browser)
    x, y, z = near.rotation @ point + near.camera_from_world[:3, 3]
    assert z < 2.2
    assert (near.fx * x / z + near.cx, near.fy * y / z + near.cy) == pytest.approx((60, 150), abs=1e-6)


def test_two_fingers_pan_and_pinch(browser: Browser, tmp_path: Path):
    opened(browser, tmp_path, page_of(cloud()))
    browser.resize(240, 180, phone=True)
    try:
        home = eye(browser)
        browser.touch("touchStart", (100, 90), (140, 90))
        browser.touch("touchMove", (80, 90), (160, 90))
        browser.touch("touchEnd")
        assert np.linalg.norm(eye(browser).position - CENTER) == pytest.approx(1.25, abs=0.05)
        near = eye(browser)
        browser.touch("touchStart", (100, 90))
        browser.touch("touchMove", (140, 90))
        browser.touch("touchEnd")
        assert (eye(browser).position - near.position) @ home.rotation[0] < -0.1
    finally:
        browser.resize(240, 180)


def test_a_double_click_sets_what_is_orbited(browser: Browser, tmp_path: Path):
    one = cloud(1, 0)
    place = CENTER + 0.4 * camera().rotation[0] - 0.5 * camera().forward
    one = replace(one, positions=place[None], scales=np.full((1, 3), 0.05, np.float32), opacities=np.ones(1))
    settled(opened(browser, tmp_path, page_of(one)))
    at = eye(browser)
    x, y, z = at.rotation @ place + at.camera_from_world[:3, 3]
    spot = at.fx * x / z + at.cx, at.fy * y / z + at.cy
    for count in (1, 2):
        for kind in ("mousePressed", "mouseReleased"):
            browser.mouse(kind, *spot, button="left", clickCount=count)
    browser.drag((120, 90), (160, 100))
    after = eye(browser)
    assert np.linalg.norm(after.position - at.position) > 0.3
    assert np.linalg.norm(after.position - place) == pytest.approx(np.linalg.norm(at.position - place), rel=0.01)


def test_what_a_browser_cannot_do_is_said_in_a_sentence(browser: Browser, tmp_path: Path):
    file = tmp_path / "page.html"
    page = page_of(cloud(50))
    file.write_bytes(page)
    with browser.before_every_page("HTMLCanvasElement.prototype.getContext = () => null"):
        browser.open(file.as_uri())
        assert "no WebGL 2" in message(browser)
    file.write_bytes(re.sub(rb'(class="payload">.{400}).{40}', rb"\1", page))
    browser.open(file.as_uri())
    assert "cannot be unpacked" in message(browser)
    file.write_bytes(page)
    browser.open(file.as_uri() + "#camera={}")
    assert "needs width" in message(browser)


def test_the_page_may_not_use_the_network(browser: Browser, tmp_path: Path):
    opened(browser, tmp_path, page_of(cloud(3)))
    refused = "fetch('data:,x').then(() => 'fetched', () => 'refused')"
    assert browser.evaluate(refused) == "refused"


@pytest.fixture(autouse=True)
def usual(browser: Browser) -> Iterator[None]:
    """Tests may change the window and what a person prefers."""
    yield
    browser.resize(240, 180)
    browser.prefer()


def place(browser: Browser) -> np.ndarray:
    """Where the eye is now, perhaps on its way."""
    return Camera(**{**browser.evaluate("hyrfpack.camera()"), "camera_from_world": np.array(
        browser.evaluate("hyrfpack.camera().camera_from_world")
    )}).position  # fmt: skip


def test_a_drag_ends_softly_exactly_where_it_leads_without_movement(browser: Browser, tmp_path: Path):
    ends = {}
    for less_motion in (True, False):
        browser.prefer(less_motion=less_motion)
        opened(browser, tmp_path, page_of(cloud(50)))
        browser.drag((120, 90), (150, 110))
        rested(browser).drag((120, 90), (110, 93), button="right")
        rested(browser).mouse("mouseWheel", 60, 150, deltaX=0, deltaY=-200)
        ends[less_motion] = eye(browser).camera_from_world
    np.testing.assert_allclose(ends[True], ends[False], atol=1e-9)


def test_damping_takes_frames_and_then_there_are_none(browser: Browser, tmp_path: Path):
    settled(opened(browser, tmp_path, page_of(cloud(50))))
    before = browser.evaluate("hyrfpack.frames()")
    browser.mouse("mouseWheel", 120, 90, deltaX=0, deltaY=-200)
    settled(browser)
    frames = browser.evaluate("hyrfpack.frames()")
    assert frames - before > 3
    time.sleep(0.5)
    assert browser.evaluate("hyrfpack.frames()") == frames
    assert not browser.evaluate("hyrfpack.player.driven")


def test_the_eye_glides_to_another_camera_and_stops_for_a_person(browser: Browser, tmp_path: Path):
    opened(browser, tmp_path, page_of(cloud(50)))
    far, near = camera(2.5).position, camera(1.5).position
    browser.evaluate("(window.way = [], hyrfpack.player.addEventListener('frame', () => way.push(hyrfpack.camera())))")
    browser.press("n")
    np.testing.assert_allclose(eye(browser).camera_from_world, camera(1.5).camera_from_world, atol=1e-9)
    on_its_way = [np.linalg.norm(np.array(at["camera_from_world"])[:3, 3]) for at in browser.evaluate("way")]
    assert len(set(np.round(on_its_way, 6))) > 3
    browser.press("p")
    time.sleep(0.25)
    browser.mouse("mousePressed", 120, 90, button="left", buttons=1, clickCount=1)
    stopped = place(browser)
    browser.mouse("mouseReleased", 120, 90, button="left", clickCount=1)
    time.sleep(0.4)
    np.testing.assert_allclose(place(browser), stopped, atol=1e-9)
    assert np.linalg.norm(stopped - far) > 1e-3 and np.linalg.norm(stopped - near) > 1e-3


def test_glides_pass_between_their_ends_and_less_motion_jumps(browser: Browser, tmp_path: Path):
    turned = replace(camera(), camera_from_world=look_at(CENTER + np.array([-2.0, -0.5, 1.5]), CENTER, UP))
    browser.prefer(less_motion=True)
    opened(browser, tmp_path, page_of(cloud(50), cameras=[camera(), turned]))
    browser.press("n")
    np.testing.assert_array_equal(place(browser), eye(browser).position)
    assert np.linalg.norm(place(browser) - turned.position) < 1e-9
    # Half-way by the mover itself: about the target they share, at a distance between theirs.
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
    distances = sorted(np.linalg.norm(at.position - CENTER) for at in (camera(), turned))
    assert distances[0] * 0.7 < np.linalg.norm(position - CENTER) < distances[1] * 1.05
    np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-9)
    ahead = pose[:3, :3] @ CENTER + pose[:3, 3]
    assert np.abs(ahead[:2]).max() < 0.05 * ahead[2], "the target leaves the middle"
    assert not active


def test_it_turns_by_itself_pauses_for_a_person_and_can_be_stopped(browser: Browser, tmp_path: Path):
    opened(browser, tmp_path, page_of(cloud(50)), "?autorotate")
    start = place(browser)
    time.sleep(0.6)
    turning = place(browser)
    assert np.linalg.norm(turning - start) > 0.05
    assert np.linalg.norm(turning - CENTER) == pytest.approx(np.linalg.norm(start - CENTER), rel=1e-6)
    browser.drag((120, 90), (125, 90))
    paused = eye(browser).position
    time.sleep(0.5)
    np.testing.assert_array_equal(place(browser), paused)
    ends = time.monotonic() + 10
    while np.array_equal(place(browser), paused):
        assert time.monotonic() < ends, "it does not go on"
        time.sleep(0.1)
    browser.press("t")
    stopped = eye(browser).position
    settled(browser)
    np.testing.assert_array_equal(place(browser), stopped)


def test_who_wants_less_motion_is_not_turned_unasked(browser: Browser, tmp_path: Path):
    browser.prefer(less_motion=True)
    opened(browser, tmp_path, page_of(cloud(50)), "?autorotate")
    start = place(browser)
    time.sleep(0.3)
    np.testing.assert_array_equal(place(browser), start)
    browser.press("t")
    time.sleep(0.4)
    assert np.linalg.norm(place(browser) - start) > 0.02


def test_keys_zoom_orbit_and_choose_the_middle(browser: Browser, tmp_path: Path):
    settled(opened(browser, tmp_path, page_of(cloud())))
    home = eye(browser)
    browser.press("+", seconds=0.3)
    near = eye(browser)
    assert np.linalg.norm(near.position - CENTER) < 0.9 * np.linalg.norm(home.position - CENTER)
    browser.press("-", seconds=0.3)
    assert np.linalg.norm(eye(browser).position - CENTER) > np.linalg.norm(near.position - CENTER)
    before = eye(browser)
    browser.press("ArrowLeft", seconds=0.3, shift=True)
    after = eye(browser)
    assert np.linalg.norm(after.position - before.position) > 0.1
    assert np.linalg.norm(after.position - CENTER) == pytest.approx(np.linalg.norm(before.position - CENTER))
    browser.press("ArrowLeft", seconds=0.3)
    looked = eye(browser)
    np.testing.assert_allclose(looked.position, after.position, atol=1e-9)
    assert not np.allclose(looked.forward, after.forward, atol=1e-3)
    browser.press("r")
    rested(browser).press("o")
    until(browser, "!document.getElementById('ring').hidden")
    assert browser.list_errors() == []


def test_a_short_press_moves_however_slow_the_frames_are(browser: Browser, tmp_path: Path):
    opened(browser, tmp_path, page_of(cloud(50)))
    home = eye(browser)
    browser.press("ArrowUp")
    assert not np.array_equal(eye(browser).camera_from_world, home.camera_from_world)
    settled(browser)
    at = place(browser)
    browser.press("w")
    step = np.linalg.norm(eye(browser).position - at)
    assert 0.01 < step < 0.7


def test_a_double_tap_shows_where(browser: Browser, tmp_path: Path):
    settled(opened(browser, tmp_path, page_of(cloud())))
    for _ in range(2):
        browser.mouse("mousePressed", 120, 90, button="left", buttons=1, clickCount=1)
        browser.mouse("mouseReleased", 120, 90, button="left", clickCount=1)
    box = browser.evaluate("(({ left, right, top, bottom }) => [left + right, top + bottom])"
                           "(document.getElementById('ring').getBoundingClientRect())")  # fmt: skip
    assert box == pytest.approx([240, 180], abs=3)
    until(browser, "document.getElementById('ring').hidden")
