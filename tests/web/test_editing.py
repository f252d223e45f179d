"""The editing panel of pages: crop box, sliders, up, distances, views and undo, with a mouse, fingers and keys."""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from web.editing_pages import (
    TURNED_FRAME,
    catch_downloads,
    click,
    fill,
    list_actions,
    load_editable_page,
    make_ball_model,
    make_editable_page,
    make_model,
    middle_of,
    place_on_axis,
    project,
    read_saved_bytes,
    read_saved_text,
    read_text,
    wait_until_applied,
)
from web.native_models import SCENE_CENTER, UP_DIRECTION, make_cameras, render_reference
from web.pages import (
    Browser,
    make_splats_page,
    open_page,
    psnr,
    random_splats,
    render_in_page,
    wait_for_message,
    wait_until,
    wait_until_at_rest,
    window_camera,
)
from web.site import GOLDEN_FILE_DATA, Site, drop_file
from web.test_merged import make_page as make_merged_page
from web.test_merged import make_parts

from hyrfpack.cameras.files import cameras_from_json
from hyrfpack.format import load_model
from hyrfpack.web.player import encode_player

pytestmark = pytest.mark.in_turn


@pytest.fixture(autouse=True)
def window(browser: Browser) -> Iterator[None]:
    """Give the window room for the panel and the scene, and reset it after each test."""
    browser.resize(1000, 700)
    yield
    browser.resize(240, 180)
    browser.prefer()


# ---- which pages have the panel


def test_only_editable_pages_have_the_panel_and_its_script(browser: Browser, tmp_path: Path):
    assert b"edit-button" not in encode_player("a") and b"edit-button" in encode_player("a", editable=True)
    page = make_editable_page(make_model())
    load_editable_page(browser, tmp_path, page)
    assert browser.evaluate("document.getElementById('edit').checkVisibility()")
    browser.press("i")
    assert not browser.evaluate("document.getElementById('edit').checkVisibility()")
    open_page(browser, tmp_path, make_splats_page(random_splats(50)))
    browser.press("i")
    assert browser.evaluate("document.getElementById('edit') === null && hyrfpack.editor === undefined")
    assert browser.list_errors() == []


def test_merged_files_can_be_measured_but_not_edited(browser: Browser, tmp_path: Path):
    model = make_parts()
    page = make_merged_page(model, make_cameras()[:1], editable_file="parts.hyrf")
    load_editable_page(browser, tmp_path, page)
    assert "--part" in read_text(browser, "edit-refusal")
    assert not browser.evaluate("document.getElementById('edit-add-box').checkVisibility()")
    click(browser, "[data-tool=measure]")
    assert browser.evaluate("document.getElementById('edit-clear').checkVisibility()")
    assert not browser.evaluate("document.getElementById('edit-rescale').checkVisibility()"), "a scale is an edit"


# ---- cropping and cleaning


@pytest.mark.parametrize("device", ["mouse", "finger"])
def test_a_face_of_the_box_follows_the_pointer_along_its_axis(browser: Browser, tmp_path: Path, device: str):
    browser.resize(1000, 700, phone=device == "finger")
    load_editable_page(browser, tmp_path, make_editable_page(make_model()))
    click(browser, "#edit-add-box")
    before = list_actions(browser)[0]["value"]
    camera = window_camera(browser)
    start, end = drag_handle(browser, 1, (40, -15), device)  # maximum x

    after = list_actions(browser)[0]["value"]
    middle = np.array([before[3], (before[1] + before[4]) / 2, (before[2] + before[5]) / 2])
    ratio = camera.width / 1000
    moved = [place_on_axis(camera, np.array(place) * ratio, middle, 0) for place in (start, end)]
    assert after[:3] == before[:3] and after[4:] == before[4:]
    assert abs(moved[1] - moved[0]) > 0.1
    assert after[3] - before[3] == pytest.approx(moved[1] - moved[0], abs=0.02)
    assert np.allclose(window_camera(browser).camera_from_world, camera.camera_from_world), "the eye has moved, too"
    assert browser.list_errors() == []


def test_arrow_keys_move_the_face_whose_handle_has_the_focus(browser: Browser, tmp_path: Path):
    load_editable_page(browser, tmp_path, make_editable_page(make_model()))
    click(browser, "#edit-add-box")
    before, camera = list_actions(browser)[0]["value"], window_camera(browser)
    browser.evaluate("document.querySelectorAll('#edit-handles button')[2].focus()")  # minimum y
    browser.press("ArrowLeft")
    browser.press("ArrowRight", shift=True)
    after = list_actions(browser)[0]["value"]
    np.testing.assert_allclose(np.subtract(after, before), [0, 0.09 * TURNED_FRAME.scale, 0, 0, 0, 0], atol=2e-4)
    assert np.array_equal(window_camera(browser).camera_from_world, camera.camera_from_world)


MOVE_HANDLE, TURN_HANDLE = 6, 7


def middle_and_sides(value: list[float]) -> tuple[np.ndarray, np.ndarray]:
    return (np.array(value[:3]) + value[3:6]) / 2, np.subtract(value[3:6], value[:3])


def drag_handle(browser: Browser, number: int, by: tuple[float, float], device: str) -> np.ndarray:
    """Drag a handle of the box; return its places before and after, in CSS pixels."""
    start = middle_of(browser, "#edit-handles button", number)
    end = (start[0] + by[0], start[1] + by[1])
    if device == "mouse":
        browser.drag(start, end)
    else:
        browser.touch("touchStart", start)
        for share in (0.5, 1.0):
            browser.touch("touchMove", tuple(a + share * (b - a) for a, b in zip(start, end, strict=True)))
        browser.touch("touchEnd")
    return np.array([start, end])


@pytest.mark.parametrize("device", ["mouse", "finger"])
def test_handles_move_the_whole_box_and_turn_it_about_up(browser: Browser, tmp_path: Path, device: str):
    browser.resize(1000, 700, phone=device == "finger")
    model = make_model(2600)
    load_editable_page(browser, tmp_path, make_editable_page(model))
    click(browser, "#edit-add-box")
    camera, before = window_camera(browser), list_actions(browser)[0]["value"]

    start, end = drag_handle(browser, MOVE_HANDLE, (50, -30), device)

    moved = list_actions(browser)[0]["value"]
    (middle, sides), (old, old_sides) = middle_and_sides(moved), middle_and_sides(before)
    np.testing.assert_allclose(project(browser, camera, middle), end, atol=1.5)
    np.testing.assert_allclose(sides, old_sides, atol=2e-3)
    assert abs((camera.rotation @ (middle - old))[2]) < 2e-3, "the box has moved to the front or to the back"

    start, end = drag_handle(browser, TURN_HANDLE, (-35, 25), device)

    up_action, action = list_actions(browser)
    assert up_action["option"] == "up" and action["value"][:6] == moved
    up = np.array(up_action["value"]) / np.linalg.norm(up_action["value"])
    np.testing.assert_allclose(up, UP_DIRECTION / np.linalg.norm(UP_DIRECTION), atol=1e-5)
    arms = []
    for place in np.array((start, end)) * camera.width / 1000:
        x, y = (place - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
        ray = camera.rotation.T @ (x, y, 1)
        arms.append(camera.position + ray * ((middle - camera.position) @ up) / (ray @ up) - middle)
    degrees = np.degrees(np.arctan2(up @ np.cross(*arms), np.dot(*arms)))
    assert abs(degrees) > 3 and action["value"][6] == pytest.approx(degrees, abs=0.5)

    count = wait_until_applied(browser)
    positions = TURNED_FRAME.to_world(model.gaussians.positions.detach().numpy())
    turned_back = Rotation.from_rotvec(-np.radians(action["value"][6]) * up).apply(positions - middle)
    assert count == (np.abs(turned_back) <= sides / 2).all(1).sum() and 50 < count < 2500
    click(browser, "[data-tool=save]")
    command = browser.evaluate("document.getElementById('edit-command').value")
    assert [word.split("=")[0] for word in shlex.split(command)[5:]] == ["--up", "--crop-box"]
    assert np.allclose(window_camera(browser).camera_from_world, camera.camera_from_world), "the eye has moved, too"
    assert browser.list_errors() == []


def test_keys_move_and_turn_the_box(browser: Browser, tmp_path: Path):
    load_editable_page(browser, tmp_path, make_editable_page(make_model()))
    click(browser, "#edit-add-box")
    camera, before = window_camera(browser), list_actions(browser)[0]["value"]
    browser.evaluate(f"document.querySelectorAll('#edit-handles button')[{MOVE_HANDLE}].focus()")
    for key, shift in (("ArrowRight", True), ("ArrowUp", False), ("PageUp", False)):
        browser.press(key, shift=shift)
    (middle, sides), (old, old_sides) = (middle_and_sides(v) for v in (list_actions(browser)[0]["value"], before))
    step = 0.01 * TURNED_FRAME.scale
    np.testing.assert_allclose(camera.rotation @ (middle - old), [10 * step, -step, step], atol=2e-3)
    np.testing.assert_allclose(sides, old_sides, atol=2e-3)

    browser.evaluate(f"document.querySelectorAll('#edit-handles button')[{TURN_HANDLE}].focus()")
    browser.press("ArrowLeft", shift=True)
    browser.press("ArrowRight")
    action = list_actions(browser)[-1]
    assert action["value"][6] == -9
    handle = f"document.querySelectorAll('#edit-handles button')[{TURN_HANDLE}]"
    assert browser.evaluate(f"{handle}.getAttribute('aria-valuenow')") == "-9"

    # A face of a turned box moves alone: the middle of the opposite one stays.
    browser.evaluate("document.querySelectorAll('#edit-handles button')[1].focus()")  # maximum x
    browser.press("ArrowRight", shift=True)
    wider = list_actions(browser)[-1]["value"]
    axis = Rotation.from_rotvec(np.radians(-9) * UP_DIRECTION / np.linalg.norm(UP_DIRECTION)).apply([1, 0, 0])
    ends = [center - side[0] / 2 * axis for center, side in map(middle_and_sides, (action["value"], wider))]
    np.testing.assert_allclose(ends[1], ends[0], atol=3e-3)
    assert middle_and_sides(wider)[1][0] - sides[0] == pytest.approx(10 * step, abs=2e-3)
    fill(browser, "#edit-turn", 0)
    assert len(list_actions(browser)[-1]["value"]) == 6


def test_a_box_is_drawn_and_applied_about_the_up_direction_before_it(browser: Browser, tmp_path: Path):
    model = make_model(2600)
    load_editable_page(browser, tmp_path, make_editable_page(model))
    click(browser, "#edit-add-box")
    box = list_actions(browser)[0]["value"]
    later_up = [0.8, 0.0, 0.6]
    browser.evaluate(f"hyrfpack.editor.tools.up.state({later_up})")
    browser.evaluate(f"document.querySelectorAll('#edit-handles button')[{TURN_HANDLE}].focus()")
    for _ in range(4):
        browser.press("ArrowRight", shift=True)

    first, turned, last = list_actions(browser)
    assert [action["option"] for action in (first, turned, last)] == ["up", "crop-box", "up"]
    up = UP_DIRECTION / np.linalg.norm(UP_DIRECTION)
    np.testing.assert_allclose(first["value"], up, atol=1e-5)
    assert turned["value"] == [*box, 40] and last["value"] == later_up
    turn = Rotation.from_rotvec(np.radians(40) * up)
    np.testing.assert_allclose(
        browser.evaluate("hyrfpack.editor.tools.crop.describe().turn"), turn.as_matrix(), atol=1e-5
    )
    middle, sides = middle_and_sides(box)
    positions = TURNED_FRAME.to_world(model.gaussians.positions.detach().numpy())
    inside = (np.abs(turn.inv().apply(positions - middle)) <= sides / 2).all(1)
    assert wait_until_applied(browser) == inside.sum() and 50 < inside.sum() < 2500


def test_typed_degrees_are_wrapped_to_half_a_turn(browser: Browser, tmp_path: Path):
    load_editable_page(browser, tmp_path, make_editable_page(make_model(50)))
    click(browser, "#edit-add-box")
    for typed, degrees in ((270, -90), (180, 180), (-190.5, 169.5), (-179.97, 180)):
        fill(browser, "#edit-turn", typed)
        assert list_actions(browser)[-1]["value"][6] == degrees


def test_an_undo_during_a_drag_of_a_handle_removes_the_box(browser: Browser, tmp_path: Path):
    browser.resize(1000, 700, phone=True)
    load_editable_page(browser, tmp_path, make_editable_page(make_model(50)))
    click(browser, "#edit-add-box")
    x, y = middle_of(browser, "#edit-handles button", 1)
    browser.touch("touchStart", (x, y))
    browser.touch("touchMove", (x + 20, y))
    browser.evaluate("hyrfpack.editor.go(-1)")
    browser.touch("touchMove", (x + 40, y))
    browser.touch("touchEnd")
    assert list_actions(browser) == [] and browser.list_errors() == []


@pytest.mark.parametrize("other", ["the same handle", "another handle"])
def test_a_second_finger_does_not_disturb_the_drag_of_a_handle(browser: Browser, tmp_path: Path, other: str):
    browser.resize(1000, 700, phone=True)
    load_editable_page(browser, tmp_path, make_editable_page(make_model()))
    click(browser, "#edit-add-box")
    before = list_actions(browser)[0]["value"]
    x, y = middle_of(browser, "#edit-handles button", 1)  # maximum x
    second = (x + 8, y + 8) if other == "the same handle" else middle_of(browser, "#edit-handles button", 3)
    browser.touch("touchStart", (x, y))
    browser.touch("touchMove", (x + 20, y))
    first = list_actions(browser)[0]["value"]
    browser.touch("touchStart", (x + 20, y), second)
    for step in (40, 80):
        browser.touch("touchMove", (x + 20, y), (second[0] + step, second[1] - step))
    assert list_actions(browser)[0]["value"] == first != before
    browser.touch("touchMove", (x + 40, y), (second[0] + 80, second[1] - 80))
    browser.touch("touchEnd")
    after = list_actions(browser)[0]["value"]
    assert after[:3] == before[:3] and after[4:] == before[4:]
    assert abs(after[3] - before[3]) > 1.5 * abs(first[3] - before[3])


def test_undo_moves_the_slider_that_has_the_focus(browser: Browser, tmp_path: Path):
    load_editable_page(browser, tmp_path, make_editable_page(make_model(50)), tool="clean")
    fill(browser, "#edit-faint", 20)
    fill(browser, "#edit-faint", 70)
    browser.evaluate("document.getElementById('edit-faint').focus(), hyrfpack.editor.go(-1)")
    assert browser.evaluate("Number(document.getElementById('edit-faint').value)") == 20


def test_undo_and_redo_step_through_the_actions(browser: Browser, tmp_path: Path):
    load_editable_page(browser, tmp_path, make_editable_page(make_model()))
    states = [list_actions(browser)]
    click(browser, "#edit-add-box")
    states.append(list_actions(browser))
    click(browser, "#edit-inside")
    states.append(list_actions(browser))
    click(browser, "[data-tool=clean]")
    fill(browser, "#edit-faint", 50)
    states.append(list_actions(browser))
    undo_key = "dispatchEvent(new KeyboardEvent('keydown', {key: 'z', ctrlKey: true}))"
    for state in states[-2::-1]:
        browser.evaluate(undo_key)
        assert list_actions(browser) == state
    assert wait_until_applied(browser) is None
    assert read_text(browser, "status") == "Undone"
    browser.evaluate(f"(document.getElementById('status').textContent = '', {undo_key})")
    assert read_text(browser, "status") == "", "there was nothing to undo"
    for state in states[1:]:
        click(browser, "#edit-redo")
        assert list_actions(browser) == state
    assert len({str(state) for state in states}) == 4


def test_the_picture_equals_that_of_the_gaussians_that_are_left(browser: Browser, tmp_path: Path):
    model = make_model(2600)
    load_editable_page(browser, tmp_path, make_editable_page(model))
    click(browser, "#edit-add-box")
    for number, value in enumerate((5.0, -24.0, 1.0, 12.0, -17.0, 9.0)):
        fill(browser, f"#edit-box tr:nth-child({2 + number // 3}) td:nth-child({2 + number % 3}) input", value)
    click(browser, "[data-tool=clean]")
    fill(browser, "#edit-faint", 90)
    fill(browser, "#edit-large", 60)
    count = wait_until_applied(browser)

    actions = {action["option"]: action["value"] for action in list_actions(browser)}
    positions = TURNED_FRAME.to_world(model.gaussians.positions.detach().numpy())
    decoded = model.decode_geometry()
    kept = (positions >= (5, -24, 1)).all(1) & (positions <= (12, -17, 9)).all(1)
    kept &= decoded.opacities.detach().numpy() >= actions["min-opacity"]
    kept &= decoded.scales.detach().numpy().max(1) * TURNED_FRAME.scale <= actions["max-scale"]
    assert count == kept.sum() and 100 < count < 2000
    assert read_text(browser, "edit-count") == f"{count:,} of 2,600 Gaussians"
    rest = model.subset(torch.from_numpy(np.flatnonzero(kept)))
    scores = [psnr(render_in_page(browser, camera), render_reference(rest, camera)) for camera in make_cameras()]
    assert min(scores) > 45, scores
    assert psnr(render_reference(model, make_cameras()[0]), render_reference(rest, make_cameras()[0])) < 35


def test_a_box_that_keeps_nothing_is_reported(browser: Browser, tmp_path: Path):
    load_editable_page(browser, tmp_path, make_editable_page(make_model()))
    click(browser, "#edit-add-box")
    for column in (2, 3, 4):
        fill(browser, f"#edit-box tr:nth-child(3) td:nth-child({column}) input", 5000)
        fill(browser, f"#edit-box tr:nth-child(2) td:nth-child({column}) input", 4000)
    assert wait_until_applied(browser) == 0
    assert read_text(browser, "edit-count") == "No Gaussian is left."


def test_an_edit_that_fails_is_not_saved_and_is_tried_again(browser: Browser, tmp_path: Path):
    load_editable_page(browser, tmp_path, make_editable_page(make_model()), tool="save")
    browser.evaluate(
        "void (window.action = { option: 'min-opacity', value: 0.5 }, window.failure = new Error('no memory'),"
        " hyrfpack.player.select = () => Promise.reject(failure), hyrfpack.editor.set([action]))"
    )
    assert wait_for_message(browser) == "no memory"
    assert browser.evaluate("document.getElementById('edit-download').disabled")
    browser.evaluate("void (document.getElementById('dismiss').click(), failure.message = '')")
    browser.evaluate("hyrfpack.editor.set([action]), new Promise((done) => setTimeout(done, 100))")
    assert browser.evaluate("document.getElementById('message').hidden"), "an error without a sentence"
    browser.evaluate("delete hyrfpack.player.select, hyrfpack.editor.set([action])")
    assert 0 < wait_until_applied(browser) < 600
    assert not browser.evaluate("document.getElementById('edit-download').disabled")


def test_a_command_names_the_file_of_the_address(browser: Browser, host: Site):
    host.files["/index.html"] = encode_player(
        "a title", content="some scene.hyrf", editable=True, file="own/bonsai.hyrf"
    )
    host.files["/room.hyrf"] = GOLDEN_FILE_DATA
    for query, file in (("", "own/bonsai.hyrf"), ("?content=room.hyrf&title=Mine", "room.hyrf")):
        browser.open(f"{host.address}/index.html{query}")
        browser.evaluate("hyrfpack.ready")
        assert browser.evaluate("hyrfpack.editor.file") == file
    drop_file(browser, GOLDEN_FILE_DATA, "other.hyrf")
    wait_until(browser, "hyrfpack.editor.file === 'other.hyrf'")


def test_the_edit_survives_a_lost_graphics_device(browser: Browser, tmp_path: Path):
    from web.native_models import lose_and_restore_device

    model = make_model()
    load_editable_page(browser, tmp_path, make_editable_page(model))
    click(browser, "#edit-add-box")
    count = wait_until_applied(browser)
    lose_and_restore_device(browser)
    assert wait_until_applied(browser) == count and 0 < count < len(model)
    assert browser.evaluate("hyrfpack.player.renderer.drawn") <= count


def test_a_saved_file_holds_the_gaussians_that_the_picture_shows(browser: Browser, tmp_path: Path):
    model = make_model()
    load_editable_page(browser, tmp_path, make_editable_page(model))
    catch_downloads(browser)
    click(browser, "#edit-add-box")
    count = wait_until_applied(browser)
    (action,) = list_actions(browser)
    click(browser, "[data-tool=save]")
    click(browser, "#edit-download")
    wait_until(browser, "Boolean(window.saved)")

    data = read_saved_bytes(browser)
    assert f"edited.hyrf, {len(data) / 1e3:.0f} kB." in read_text(browser, "toast")
    (tmp_path / "saved.hyrf").write_bytes(data)
    saved = load_model(tmp_path / "saved.hyrf")
    positions = TURNED_FRAME.to_world(model.gaussians.positions.detach().numpy())
    inside = ((positions >= action["value"][:3]) & (positions <= action["value"][3:])).all(1)
    assert len(saved) == count == inside.sum() and 0 < count < len(model)
    np.testing.assert_array_equal(saved.gaussians.positions, model.gaussians.positions.detach()[inside])
    assert browser.list_errors() == []


# ---- picked points

GROUND = np.array([[-2.0, 1.0, 1.0], [2.0, 1.5, 0.5], [0.5, -1.0, 0.7]]) + SCENE_CENTER


def pick(browser: Browser, place: tuple[float, float], device: str) -> None:
    if device == "finger":
        browser.touch("touchStart", place)
        browser.touch("touchEnd")
    else:
        browser.click(*place)


@pytest.mark.parametrize("device", ["mouse", "finger"])
def test_the_distance_of_two_picked_points_is_that_of_the_world(browser: Browser, tmp_path: Path, device: str):
    browser.resize(1000, 700, phone=device == "finger")
    load_editable_page(browser, tmp_path, make_editable_page(make_ball_model(GROUND)), "measure")
    camera = window_camera(browser)
    for point in GROUND[:2]:
        pick(browser, project(browser, camera, point), device)
    distance = float(np.linalg.norm(GROUND[1] - GROUND[0]))
    number, unit = read_text(browser, "edit-distance").split()
    assert float(number) == pytest.approx(distance, rel=0.01) and unit == "units"

    assert browser.evaluate("document.getElementById('edit-rescale').disabled"), "there is no length to scale to"
    fill(browser, "#edit-length", 10)
    click(browser, "#edit-rescale")
    (action,) = list_actions(browser)
    assert action == {"option": "scale", "value": pytest.approx(10 / distance, rel=0.01)}
    assert read_text(browser, "edit-distance") == "10 units"
    assert np.allclose(window_camera(browser).camera_from_world, camera.camera_from_world), "a tap moves the eye"


@pytest.mark.parametrize("length", [0, -3, 1e300])
def test_a_length_that_would_lose_the_scene_is_refused(browser: Browser, tmp_path: Path, length: float):
    load_editable_page(browser, tmp_path, make_editable_page(make_ball_model(GROUND)), "measure")
    camera = window_camera(browser)
    for point in GROUND[:2]:
        browser.click(*project(browser, camera, point))
    fill(browser, "#edit-length", length)
    click(browser, "#edit-rescale")
    assert read_text(browser, "done") == "No scene can have this size; type another length."
    assert list_actions(browser) == [] and not browser.evaluate("document.getElementById('toast').hidden")


def test_up_is_perpendicular_to_three_points_and_points_to_the_cameras(browser: Browser, tmp_path: Path):
    load_editable_page(browser, tmp_path, make_editable_page(make_ball_model(GROUND)), "up")
    camera = window_camera(browser)
    normal = np.cross(GROUND[1] - GROUND[0], GROUND[2] - GROUND[0])
    normal *= np.sign(normal @ (camera.position - GROUND[0])) / np.linalg.norm(normal)
    for point in GROUND:
        browser.click(*project(browser, camera, point))
    (action,) = list_actions(browser)
    assert action["option"] == "up" and np.dot(action["value"], normal) > 0.999

    click(browser, "[data-upright=z]")
    click(browser, "[data-tool=save]")
    command = browser.evaluate("document.getElementById('edit-command').value")
    assert shlex.split(command)[-1] == "--upright=z" and "--up=" in command
    before = window_camera(browser)
    browser.drag((300, 500), (420, 500))  # orbits turn about the new direction
    turn = wait_until_at_rest(browser) and window_camera(browser).rotation.T @ before.rotation
    np.testing.assert_allclose(turn @ action["value"], action["value"], atol=1e-5)
    assert np.abs(turn - np.eye(3)).max() > 0.05


def test_keys_alone_pick_the_centre_of_the_picture(browser: Browser, tmp_path: Path):
    load_editable_page(browser, tmp_path, make_editable_page(make_ball_model([SCENE_CENTER])), "measure")
    browser.evaluate("document.querySelector('[data-pane=measure] .edit-pick').focus()")
    browser.press("Enter")
    (point,) = browser.evaluate("hyrfpack.editor.tool.picker.points")
    np.testing.assert_allclose(
        TURNED_FRAME.to_world(np.array([point]))[0], SCENE_CENTER, atol=0.05 * TURNED_FRAME.scale
    )


def test_arrow_keys_in_the_text_of_the_command_do_not_move_the_view(browser: Browser, tmp_path: Path):
    load_editable_page(browser, tmp_path, make_editable_page(make_model(50)), "save")
    browser.evaluate("document.getElementById('edit-command').focus()")
    before = window_camera(browser).camera_from_world
    browser.press("ArrowRight")
    browser.press("w")
    np.testing.assert_array_equal(window_camera(browser).camera_from_world, before)


# ---- views


def test_saved_views_and_paths_are_cameras_that_render_reads(browser: Browser, tmp_path: Path):
    load_editable_page(browser, tmp_path, make_editable_page(make_model(50), make_cameras()[:3]), "views")
    catch_downloads(browser)
    fill(browser, "#edit-view-name", "front")
    seen = []
    for number in range(3):
        browser.evaluate(f"hyrfpack.player.choose({number})")
        seen.append(window_camera(browser))
        click(browser, "#edit-new-view button")
    fill(browser, "#edit-seconds", 1)
    saved = {}
    for kind in ("views", "path"):
        click(browser, f"#edit-save-{kind}")
        (tmp_path / f"{kind}.json").write_text(read_saved_text(browser))
        saved[kind] = cameras_from_json(tmp_path / f"{kind}.json")

    assert [name for name, _ in saved["views"]] == ["front", "view 2", "view 3"]
    for (_, camera), expected in zip(saved["views"], seen, strict=True):
        np.testing.assert_allclose(camera.camera_from_world, expected.camera_from_world, atol=1e-9)
        assert camera.fx / camera.width == pytest.approx(expected.fx / expected.width, rel=1e-3)
    path = [camera for _, camera in saved["path"]]
    assert len(path) == 61
    for number, expected in zip((0, 30, 60), seen, strict=True):
        np.testing.assert_allclose(path[number].camera_from_world, expected.camera_from_world, atol=1e-6)
    positions = np.array([camera.position for camera in path])
    steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    assert steps[0] < 0.2 * steps.max() and steps[-1] < 0.2 * steps.max(), "it starts and ends at rest"
    assert steps[28:32].min() > 0.2 * steps.max() and np.abs(np.diff(steps)).max() < 0.2 * steps.max()


def test_names_of_views_differ_and_are_those_of_their_buttons(browser: Browser, tmp_path: Path):
    load_editable_page(browser, tmp_path, make_editable_page(make_model(50)), "views")
    for _ in range(2):
        click(browser, "#edit-new-view button")
    click(browser, "#edit-views li:first-child button:last-child")
    for _ in range(2):
        click(browser, "#edit-new-view button")
    names = "[...document.querySelectorAll('#edit-views input')].map(({ value }) => value)"
    assert browser.evaluate(names) == ["view 2", "view 3", "view 4"]
    fill(browser, "#edit-views input", " front ")
    labels = "[...document.querySelectorAll('#edit-views li:first-child button')].map(({ ariaLabel }) => ariaLabel)"
    assert browser.evaluate(labels) == ["Go to front", "Remove front"]
    fill(browser, "#edit-views input", "  ")
    assert browser.evaluate(names) == ["front", "view 3", "view 4"], "a view without a name"
    assert browser.evaluate("hyrfpack.editor.tool.views.map(({ name }) => name)") == ["front", "view 3", "view 4"]


def test_a_played_path_ends_at_the_last_view_and_stops_by_input(browser: Browser, tmp_path: Path):
    load_editable_page(browser, tmp_path, make_editable_page(make_model(50), make_cameras()[:2]), "views")
    for number in range(2):
        browser.evaluate(f"hyrfpack.player.choose({number})")
        click(browser, "#edit-new-view button")
    last = window_camera(browser)
    fill(browser, "#edit-seconds", 1)
    click(browser, "#edit-play")
    assert read_text(browser, "edit-play") == "Stop"
    np.testing.assert_allclose(window_camera(browser).camera_from_world, last.camera_from_world, atol=1e-6)
    assert read_text(browser, "edit-play") == "Play"
    click(browser, "#edit-play")
    browser.press("ArrowLeft")
    assert read_text(browser, "edit-play") == "Play"
    click(browser, "#edit-play")
    click(browser, "#edit-views li:last-child button:last-child")
    assert read_text(browser, "edit-play") == "Play", "the path of a removed view is played"


def test_views_are_those_of_the_moved_scene(browser: Browser, tmp_path: Path):
    load_editable_page(browser, tmp_path, make_editable_page(make_model(50)), "up")
    catch_downloads(browser)
    click(browser, "[data-upright=y]")
    click(browser, "[data-tool=views]")
    click(browser, "#edit-new-view button")
    click(browser, "#edit-save-views")
    (tmp_path / "views.json").write_text(read_saved_text(browser))
    ((_, camera),) = cameras_from_json(tmp_path / "views.json")
    turn = camera.rotation.T @ window_camera(browser).rotation  # from the world before to the world after
    np.testing.assert_allclose(turn @ (0, 0, 1), (0, 1, 0), atol=1e-6)  # the page's up direction
    np.testing.assert_allclose(camera.position, turn @ window_camera(browser).position, atol=1e-6)


# ---- layout


@pytest.mark.parametrize("size", [(390, 844), (844, 390), (320, 480), (1280, 800)], ids=str)
@pytest.mark.parametrize("tool", ["crop", "clean", "up", "measure", "views", "save"])
def test_the_panel_fits_the_window_and_overlaps_no_bar(browser: Browser, tmp_path: Path, size: tuple, tool: str):
    browser.resize(*size, phone=size[0] < 1280)
    load_editable_page(browser, tmp_path, make_editable_page(make_model(50)), tool)
    if tool == "crop":
        click(browser, "#edit-add-box")
    boxes = {
        name: browser.evaluate(
            "(({ left, top, right, bottom }) => [left, top, right, bottom])"
            f"(document.getElementById('{name}').getBoundingClientRect())"
        )
        for name in ("edit", "toolbar")
    }
    for left, top, right, bottom in boxes.values():
        assert left >= 0 and top >= 0 and right <= size[0] and bottom <= size[1], boxes
    assert boxes["edit"][3] <= boxes["toolbar"][1]
    small = (
        "[...document.querySelectorAll('#toolbar button, #edit-tools button, #edit-handles button')].filter((button) =>"
        " button.checkVisibility()).map((button) => button.getBoundingClientRect().height)"
    )
    assert min(browser.evaluate(small)) >= 44
    assert browser.evaluate(
        "document.getElementById('edit').scrollWidth <= document.getElementById('edit').clientWidth"
    )
