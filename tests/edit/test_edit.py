"""Edits keep what they should, move scenes exactly, and lose no file."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from commands import hyrfpack, refused, succeeded
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scenes import QUIET_CONTEXT, ring, shift_cameras
from scipy.spatial.transform import Rotation

from hyrfpack.cameras.capture import Capture, provenance_cameras
from hyrfpack.cameras.placement import Placement
from hyrfpack.compress import compress_model
from hyrfpack.config.edit import (
    Background,
    Center,
    CropBox,
    CropCameras,
    CropSphere,
    EstimateUp,
    KeepGaussians,
    MaxScale,
    MinOpacity,
    Remove,
    Rotate,
    Scale,
    Translate,
    Up,
    Upright,
)
from hyrfpack.config.export import ExportConfig
from hyrfpack.edit import edit_model, plan_edit
from hyrfpack.edit.transform import move_model
from hyrfpack.errors import HyrfError
from hyrfpack.evaluate.metrics import IDENTICAL_PSNR
from hyrfpack.export import export_model
from hyrfpack.format import describe_file, load_model, save_model
from hyrfpack.format.codec import load_with_provenance
from hyrfpack.format.container import Container
from hyrfpack.render import render_view
from tools.safety.make_golden import GOLDEN_SCENE_FOLDER

pytestmark = pytest.mark.usefixtures("quick_calibration")
GOLDEN_FOLDER = Path(__file__).parents[1] / "golden"
COMPACT_FILE = GOLDEN_FOLDER / "trained" / "demo_compact.hyrf"
RAW_FILE = GOLDEN_FOLDER / "trained" / "demo.hyrf"
MAP_FILE = GOLDEN_FOLDER / "trained" / "exposed_balls.hyrf"
RESIDUAL_FILE = GOLDEN_FOLDER / "v1.6_compact_residuals.hyrf"


def world_positions(path: Path) -> np.ndarray:
    model = load_model(path)
    return model.gaussians.positions.double().numpy() * model.config.frame.scale + model.config.frame.center


def edited(path: Path, tmp_path: Path, *actions, **settings) -> Path:
    return Path(edit_model(path, tmp_path / "edited.hyrf", actions, context=QUIET_CONTEXT, **settings).file)


def rows(positions: np.ndarray) -> set[tuple[float, ...]]:
    return {tuple(row) for row in positions.round(5).tolist()}


@pytest.mark.parametrize("file", [COMPACT_FILE, RAW_FILE, MAP_FILE], ids=lambda path: path.stem)
def test_a_moved_scene_renders_as_before_from_moved_cameras(file, tmp_path):
    turn = Rotation.from_rotvec(np.radians(77) * np.array([2.0, -1.0, 2.0]) / 3).as_matrix()
    moved = edited(file, tmp_path, Rotate((2.0, -1.0, 2.0), 77), Scale(2.5), Translate((300.0, -20.0, 7.0)))
    before, after = load_model(file), load_model(moved)
    cameras = zip(Capture(describe_file(file)).cameras[:3], Capture(describe_file(moved)).cameras[:3], strict=True)
    for camera, moved_camera in cameras:
        assert_allclose(
            moved_camera.position, 2.5 * turn @ camera.position + (300, -20, 7), atol=0.03
        )  # rotations are rounded
        pose = camera.camera_from_world.copy()  # x = R p + t with p = turn^T (p' - offset) / 2.5, and x' = 2.5 x
        pose[:3, :3] = pose[:3, :3] @ turn.T
        pose[:3, 3] = 2.5 * pose[:3, 3] - pose[:3, :3] @ (300.0, -20.0, 7.0)
        exact = replace(camera, camera_from_world=pose)
        pictures = [render_view(model, view).rgb.numpy() for model, view in ((before, camera), (after, exact))]
        assert_allclose(pictures[1], pictures[0], atol=1e-4)


def test_residuals_turn_with_a_scene(tmp_path):
    turn = Rotation.from_rotvec(np.radians(77) * np.array([2.0, -1.0, 2.0]) / 3).as_matrix()
    before = load_model(RESIDUAL_FILE)
    after = load_model(edited(RESIDUAL_FILE, tmp_path, Rotate((2.0, -1.0, 2.0), 77)))
    frame = before.config.frame
    for camera in shift_cameras(ring(3, radius=3 * frame.scale, elevation=frame.scale), frame.center):
        pose = camera.camera_from_world.copy()
        pose[:3, :3] = pose[:3, :3] @ turn.T
        pictures = [
            render_view(model, view).rgb.numpy()
            for model, view in ((before, camera), (after, replace(camera, camera_from_world=pose)))
        ]
        assert pictures[0].std() > 0.01
        assert_allclose(pictures[1], pictures[0], atol=1e-4)


def test_a_crop_keeps_the_residuals_of_what_is_left(tmp_path):
    before = load_model(RESIDUAL_FILE)
    kept = before.decode_geometry().opacities >= 0.5
    after = load_model(edited(RESIDUAL_FILE, tmp_path, MinOpacity(0.5), profile="raw"))
    assert 0 < len(after) < len(before)
    for name in before.gaussians.RESIDUAL_NAMES:
        assert_allclose(getattr(after.gaussians, name), getattr(before.gaussians, name)[kept])


def test_a_move_copies_all_other_sections_byte_for_byte(tmp_path):
    moved = edited(COMPACT_FILE, tmp_path, Translate((1.0, 2.0, 3.0)), Background((1.0, 0.5, 0.0)))
    with Container.open(COMPACT_FILE) as old, Container.open(moved) as new:
        assert list(old.entries) == list(new.entries) and old.version == new.version
        assert all(bytes(old[name].data) == bytes(new[name].data) for name in old.entries if name != "META")
    assert load_model(moved).config.solid == (1.0, 0.5, 0.0) and not load_model(moved).config.background


def test_center_moves_the_point_of_interest_to_the_origin(tmp_path):
    moved = edited(RAW_FILE, tmp_path, Center())
    assert_allclose(Capture(describe_file(moved)).viewpoint.center, 0, atol=1e-4)


offsets = st.tuples(*[st.floats(-100, 100)] * 3)
turns = st.tuples(*[st.floats(-3, 3)] * 3)


@given(st.lists(st.tuples(st.floats(0.1, 10), turns, offsets), max_size=5))
def test_placements_compose_as_the_moves_in_turn(moves):
    placement, point = Placement(), np.array([3.0, -2.0, 0.5])
    for factor, turn, offset in moves:
        rotation = Rotation.from_rotvec(turn)
        placement = placement.then(Placement(factor, rotation.as_matrix(), np.array(offset)))
        point = factor * rotation.apply(point) + np.array(offset)
    assert_allclose(placement.move_point((3.0, -2.0, 0.5)), point, rtol=1e-9, atol=1e-6)


@given(turns.filter(lambda axis: np.linalg.norm(axis) > 1e-100), st.floats(-720, 720))
def test_a_rotation_about_an_axis_is_right_handed(axis, degrees):
    expected = Rotation.from_rotvec(np.radians(degrees) * np.array(axis) / np.linalg.norm(axis)).as_matrix()
    assert_allclose(Placement.rotation_about_axis(axis, degrees).rotation, expected, atol=1e-12)


def test_two_turns_of_a_model_are_one_turn_by_their_product():
    first, second = (Rotation.from_rotvec(turn) for turn in ([0.3, 1.1, -0.7], [-1.9, 0.2, 0.4]))
    model = load_model(COMPACT_FILE)
    in_turn = move_model(
        Placement(rotation=second.as_matrix()), move_model(Placement(rotation=first.as_matrix()), model)
    )
    w, *vector = in_turn.config.frame.rotation
    assert_allclose(Rotation.from_quat([*vector, w]).as_matrix(), (second * first).as_matrix(), atol=1e-13)
    assert_allclose(in_turn.config.frame.center, (second * first).apply(model.config.frame.center), atol=1e-12)


@pytest.mark.parametrize("steps", [2, 3, 7, 90])
def test_a_full_turn_in_steps_gives_the_start_back(steps):
    start = load_model(COMPACT_FILE)
    model, step = start, Placement.rotation_about_axis((0.3, -1.2, 0.5), 360 / steps)
    for _ in range(steps):
        model = move_model(step, model)
    assert not model.config.frame.is_rotated  # and so the file has no rotation
    assert_allclose(model.config.frame.center, start.config.frame.center, atol=1e-12)


@pytest.mark.parametrize("file", [COMPACT_FILE, RAW_FILE], ids=["compact", "raw"])
def test_a_crop_keeps_the_gaussians_inside_and_remove_the_others(file, tmp_path):
    positions = world_positions(file)
    box = CropBox(tuple(np.quantile(positions, 0.2, axis=0)), (np.inf, np.inf, np.inf))
    inside = (positions >= box.low).all(axis=1)
    kept = plan_edit(file, [box], context=QUIET_CONTEXT)
    removed = plan_edit(file, [Remove(box)], context=QUIET_CONTEXT)
    assert 0 < inside.sum() < len(inside)
    assert kept.actions[0].gaussians_after == inside.sum()
    assert removed.actions[0].gaussians_after == (~inside).sum()


def test_a_raw_file_keeps_the_numbers_and_cameras_of_what_is_left(tmp_path):
    positions = world_positions(RAW_FILE)
    center = tuple(np.median(positions, axis=0))
    cut = edited(RAW_FILE, tmp_path, CropSphere(center, 0.6))
    inside = np.linalg.norm(positions - center, axis=1) <= 0.6
    assert 0 < inside.sum() < len(inside)
    assert rows(world_positions(cut)) == rows(positions[inside])
    before = load_with_provenance(RAW_FILE)[1]
    assert load_with_provenance(cut)[1] == {**before, "psnr_before": "an edit"}


def test_actions_see_the_result_of_those_before_them(tmp_path):
    positions = world_positions(RAW_FILE)
    box = CropBox((-np.inf, -np.inf, -np.inf), tuple(np.median(positions, axis=0) + 5.0))
    moved_first = plan_edit(RAW_FILE, [Translate((5.0, 5.0, 5.0)), box], context=QUIET_CONTEXT)
    cropped_first = plan_edit(RAW_FILE, [box, Translate((5.0, 5.0, 5.0))], context=QUIET_CONTEXT)
    assert moved_first.actions[1].gaussians_after == (positions <= np.median(positions, axis=0)).all(axis=1).sum()
    assert cropped_first.actions[0].gaussians_after == (positions <= box.high).all(axis=1).sum()


@pytest.mark.parametrize(("margin", "half_side"), [(0.0, 1.0), (0.5, 1.5), (-0.5, 0.5)])
def test_cameras_surround_the_inside_of_their_hull_at_any_height(margin, half_side, tmp_path):
    # Four cameras at (+-1, 0) and (0, +-1), with z up, span the square |x| + |y| <= 1.
    model = load_model(RAW_FILE)
    provenance = {"cameras": provenance_cameras(ring(4, radius=1.0))}
    save_model(model, tmp_path / "ring.hyrf", provenance={**load_with_provenance(RAW_FILE)[1], **provenance})
    provenance = load_with_provenance(tmp_path / "ring.hyrf")[1]
    provenance["viewpoint"]["up"] = [0, 0, 1]
    save_model(model, tmp_path / "ring.hyrf", provenance=provenance)
    positions = world_positions(RAW_FILE)
    inside = np.abs(positions[:, :2]).sum(axis=1) <= half_side
    report = plan_edit(tmp_path / "ring.hyrf", [CropCameras(margin)], context=QUIET_CONTEXT)
    assert report.actions[0].gaussians_after == pytest.approx(inside.sum(), abs=2)
    assert 0 < inside.sum() < len(inside)


def test_a_file_without_cameras_is_not_cropped_to_cameras(tmp_path):
    save_model(load_model(RAW_FILE), tmp_path / "bare.hyrf")
    with pytest.raises(HyrfError, match="bare.hyrf: this file keeps no cameras to which the model could be cropped"):
        plan_edit(tmp_path / "bare.hyrf", [Remove(CropCameras(0.1))], context=QUIET_CONTEXT)


def test_opacities_and_scales_are_compared_with_the_limits():
    model = load_model(RAW_FILE)
    geometry = model.decode_geometry()
    scales = geometry.scales.amax(dim=1).numpy() * model.config.frame.scale
    opacity, scale = float(geometry.opacities.quantile(0.3)), float(np.quantile(scales, 0.8))
    faint, long = (
        plan_edit(RAW_FILE, [action], context=QUIET_CONTEXT) for action in (MinOpacity(opacity), MaxScale(scale))
    )
    assert faint.actions[0].gaussians_after == (geometry.opacities.numpy() >= opacity).sum()
    assert long.actions[0].gaussians_after == (scales <= scale).sum()


def test_reducing_removes_first_what_pictures_do_not_show():
    model = load_model(RAW_FILE)
    count = len(model)
    few, most = (
        plan_edit(RAW_FILE, [KeepGaussians(n)], context=QUIET_CONTEXT) for n in (count // 2, count - count // 20)
    )
    faintest = float(model.decode_geometry().opacities.quantile(0.05))
    by_opacity = plan_edit(RAW_FILE, [MinOpacity(faintest)], context=QUIET_CONTEXT)
    assert (few.actions[0].gaussians_after, most.actions[0].gaussians_after) == (count // 2, count - count // 20)
    assert most.psnr_change > few.psnr_change
    assert most.psnr_change >= by_opacity.psnr_change


def test_a_plan_of_moves_changes_no_picture():
    report = plan_edit(RAW_FILE, [Translate((1.0, 0.0, 0.0))], context=QUIET_CONTEXT)
    assert report.psnr_change > 90 and report.psnr_change <= IDENTICAL_PSNR
    assert (report.file, report.bytes_after) == ("", 0)


def test_the_command_applies_its_options_in_order_and_reports_in_json(tmp_path):
    before = COMPACT_FILE.read_bytes()
    result = succeeded(
        "edit", COMPACT_FILE, "-o", tmp_path / "out.hyrf", "--scale", 2, "--translate", "1,0,0", "--scale", "0.5",
        "--crop-box", "-inf,-inf,-inf,inf,inf,inf", "--picture", tmp_path / "out.png", "--json",
    )  # fmt: skip
    report = json.loads(result.stdout)
    assert [step["action"].split()[0] for step in report["actions"]] == ["scale", "move", "scale", "crop"]
    assert report["file"] == str(tmp_path / "out.hyrf") and (tmp_path / "out.png").stat().st_size > 1000
    assert_allclose(
        np.array(load_model(tmp_path / "out.hyrf").config.frame.center) - load_model(COMPACT_FILE).config.frame.center,
        (0.5, 0, 0),
        atol=1e-9,
    )
    assert COMPACT_FILE.read_bytes() == before


def test_a_plan_writes_no_model(tmp_path):
    result = succeeded("edit", COMPACT_FILE, "--plan", "--min-opacity", 0.1)
    assert "remove opacities below 0.1" in result.stdout and "PSNR mean" in result.stdout
    assert list(tmp_path.iterdir()) == []


def test_the_up_direction_is_stored_for_viewers_and_exports(tmp_path):
    turned = edited(COMPACT_FILE, tmp_path, Translate((3.0, 0.0, 0.0)), Up((0.0, 3.0, 4.0)))
    before, after = (Capture(describe_file(path)).viewpoint for path in (COMPACT_FILE, turned))
    assert_allclose(after.up, (0, 0.6, 0.8))
    assert_allclose(after.center, before.center + (3, 0, 0))
    assert_allclose(after.camera.position, before.camera.position + (3, 0, 0))
    with Container.open(COMPACT_FILE) as old, Container.open(turned) as new:
        assert all(bytes(old[name].data) == bytes(new[name].data) for name in old.entries if name != "META")


def test_a_rotation_moves_the_viewpoint_and_copies_all_other_sections(tmp_path):
    turned = edited(COMPACT_FILE, tmp_path, Rotate((0.0, 0.0, 5.0), 90))  # x becomes y, y becomes -x
    before, after = (Capture(describe_file(path)).viewpoint for path in (COMPACT_FILE, turned))
    for old, new in ((before.up, after.up), (before.center, after.center)):
        assert_allclose(new, (-old[1], old[0], old[2]), atol=1e-9)
    x, y, z = world_positions(COMPACT_FILE).T
    frame, positions = load_model(turned).config.frame, load_model(turned).gaussians.positions.numpy()
    assert_allclose(frame.to_world(positions), np.stack((-y, x, z), axis=1), atol=1e-9)
    with Container.open(COMPACT_FILE) as old, Container.open(turned) as new:
        assert new.version == (1, 3)
        assert all(bytes(old[name].data) == bytes(new[name].data) for name in old.entries if name != "META")


def test_a_box_after_a_rotation_has_the_new_axes(tmp_path):
    positions = world_positions(RAW_FILE) @ Rotation.from_euler("x", 30, degrees=True).as_matrix().T
    low, high = np.quantile(positions, (0.2, 0.8), axis=0)
    inside = ((positions >= low) & (positions <= high)).all(axis=1).sum()
    report = plan_edit(RAW_FILE, [Rotate((1.0, 0.0, 0.0), 30), CropBox(tuple(low), tuple(high))], context=QUIET_CONTEXT)
    assert 0 < inside < len(positions)
    assert report.actions[1].gaussians_after == pytest.approx(inside, abs=1)


@pytest.mark.parametrize("degrees", [30.0, -115.0])
def test_a_turned_box_keeps_what_lies_in_it_after_a_turn_about_its_centre_and_up(degrees):
    positions = world_positions(RAW_FILE)
    low, high = np.quantile(positions, [0.15, 0.8], axis=0)
    axis = np.array([0.2, 0.9, -0.3]) / np.linalg.norm([0.2, 0.9, -0.3])
    actions = [Up((0.2, 0.9, -0.3)), CropBox(tuple(low), tuple(high), degrees)]

    report = plan_edit(RAW_FILE, actions, context=QUIET_CONTEXT)

    middle = (low + high) / 2
    turned_back = Rotation.from_rotvec(-np.radians(degrees) * axis).apply(positions - middle)
    expected = (np.abs(turned_back) <= (high - low) / 2).all(axis=1).sum()
    assert report.actions[1].gaussians_after == expected
    assert expected != ((positions >= low) & (positions <= high)).all(axis=1).sum()


def test_a_box_with_an_open_side_cannot_be_turned():
    assert "no centre" in refused("edit", RAW_FILE, "--plan", "--crop-box=-1,-1,-1,1,1,inf,30")
    with pytest.raises(ValueError, match="no centre"):
        CropBox((0, 0, 0), (1, 1, np.inf), 5)


def test_turning_back_gives_a_file_of_the_old_version_and_the_same_box(tmp_path):
    there = edited(COMPACT_FILE, tmp_path, Rotate((1.0, 2.0, 3.0), 40))
    edit_model(there, tmp_path / "back.hyrf", [Rotate((1.0, 2.0, 3.0), -40)], context=QUIET_CONTEXT)
    start, back = (describe_file(path) for path in (COMPACT_FILE, tmp_path / "back.hyrf"))
    assert back["version"] == start["version"] != describe_file(there)["version"]
    assert back["config"]["frame"].keys() == start["config"]["frame"].keys()
    assert_allclose(back["config"]["frame"]["center"], start["config"]["frame"]["center"], atol=1e-12)


@pytest.mark.acceptance
def test_compression_of_a_rotated_model_stores_the_same_numbers(tmp_path):
    turned = edited(RAW_FILE, tmp_path, Rotate((1.0, -2.0, 0.5), 100), Scale(1.7), Translate((3.0, -2.0, 40.0)))
    for source, name in ((RAW_FILE, "before"), (turned, "after")):
        compress_model(source, tmp_path / f"{name}.hyrf", context=QUIET_CONTEXT)
    with Container.open(tmp_path / "before.hyrf") as before, Container.open(tmp_path / "after.hyrf") as after:
        assert list(before.entries) == list(after.entries)
        assert all(bytes(before[name].data) == bytes(after[name].data) for name in before.entries if name != "META")


@pytest.mark.parametrize(("axis", "expected"), [("y", (0, 1, 0)), ("z", (0, 0, 1))])
def test_upright_turns_the_stated_direction_to_an_axis(axis, expected, tmp_path):
    turned = edited(COMPACT_FILE, tmp_path, Up((0.3, -0.8, 0.1)), Upright(axis))
    assert_allclose(Capture(describe_file(turned)).viewpoint.up, expected, atol=1e-12)
    # The Gaussian highest along the stated direction is the highest one along the axis.
    heights = world_positions(COMPACT_FILE) @ (0.3, -0.8, 0.1)
    model = load_model(turned)
    turned_positions = model.config.frame.to_world(model.gaussians.positions.numpy())
    assert_allclose(turned_positions @ expected, heights / np.linalg.norm((0.3, -0.8, 0.1)), atol=1e-6)


@pytest.mark.acceptance
@pytest.mark.parametrize(
    ("axis", "upright_by_itself"), [("z", False), pytest.param("y", True, marks=pytest.mark.acceptance)]
)
def test_a_gltf_of_an_upright_scene_is_not_turned_again(axis, upright_by_itself, tmp_path):
    turned = edited(COMPACT_FILE, tmp_path, Upright(axis))
    export_model(turned, tmp_path / "scene.glb", ExportConfig(degree=0, background=False))
    data = (tmp_path / "scene.glb").read_bytes()
    content = json.loads(data[20 : 20 + int.from_bytes(data[12:16], "little")])
    quat = next(node["rotation"] for node in content["nodes"] if "rotation" in node)  # xyzw
    assert_allclose(np.abs(quat), (0, 0, 0, 1) if upright_by_itself else (0.5**0.5, 0, 0, 0.5**0.5), atol=1e-6)


def test_up_is_estimated_in_the_axes_of_the_rotated_scene(tmp_path):
    """The demo scene was rendered by level cameras with z up."""
    turned = edited(RAW_FILE, tmp_path, Rotate((1.0, 0.0, 0.0), 90), EstimateUp())
    assert_allclose(Capture(describe_file(turned)).viewpoint.up, (0, -1, 0), atol=1e-6)


def test_up_cannot_be_estimated_without_cameras(tmp_path):
    save_model(load_model(RAW_FILE), tmp_path / "bare.hyrf")
    sentence = refused("edit", tmp_path / "bare.hyrf", "--plan", "--up", "auto")
    assert "this file keeps no cameras from which up could be estimated" in sentence


def test_the_command_turns_a_scene_upright_and_says_how(tmp_path):
    result = succeeded("edit", RAW_FILE, "-o", tmp_path / "out.hyrf", "--up", "auto", "--upright", "y", "--up", "0,1,0")
    assert "1) as up, estimated from the level cameras" in result.stdout and "turn upright, with +y up" in result.stdout
    report = succeeded("edit", RAW_FILE, "--plan", "--rotate", "0,0,1,-90", "--json")
    assert json.loads(report.stdout)["actions"][0]["action"] == "rotate by -90 degrees about (0, 0, 1)"
    facts = succeeded("info", tmp_path / "out.hyrf").stdout
    assert "format 1.3" in facts and "rotation" in facts and "(wxyz)" in facts


def test_an_edit_that_leaves_nothing_is_refused_and_writes_nothing(tmp_path):
    sentence = refused("edit", COMPACT_FILE, "-o", tmp_path / "out.hyrf", "--crop-box", "90,90,90,91,91,91")
    assert "would remove every Gaussian; all centres lie between" in sentence
    assert list(tmp_path.iterdir()) == []
    sentence = refused("edit", COMPACT_FILE, "-o", tmp_path / "out.hyrf", "--min-opacity", "1")
    assert "'remove opacities below 1' would remove every Gaussian; choose" in sentence


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        (["--plan"], "there is nothing to do"),
        (["--plan", "--invert"], "--invert must follow"),
        (["--plan", "--min-opacity", "0.1", "--invert"], "--invert must follow"),
        (["--plan", "--min-opacity", "2"], "--min-opacity: opacity is 2.0"),
        (["--plan", "--scale", "0"], "--scale: factor is 0"),
        (["--plan", "--up", "0,0,0"], "--up: direction is (0, 0, 0)"),
        (["--plan", "--up", "down"], "is not 3 numbers; write it as X,Y,Z|auto"),
        (["--plan", "--rotate", "0,0,0,90"], "--rotate: axis is (0, 0, 0); it must have a length"),
        (["--plan", "--rotate", "0,0,1"], "is not 4 numbers"),
        (["--plan", "--upright", "x"], "'x' is not one of 'y', 'z'"),
        (["--plan", "--crop-sphere", "0,0,0"], "is not 4 numbers"),
        (["--plan", "--translate", "nan,0,0"], "is not 3 numbers"),
        (["--plan", "--crop-cameras", "-1"], "--crop-cameras: margin is -1.0"),
        (["--plan", "--scale", "1e300"], "coordinates at most 1e+30; move and scale it by less"),
        (["--plan", "--scale", "1e-300"], "sizes must be at least 1e-30"),
        (["--plan", "--translate", "0,-1e300,0"], "-1e+300"),
        (
            ["--plan", "--translate", "0,-1e20,0"],
            "times, float64 cannot hold its shape precisely enough; move it by less",
        ),
        (["--center"], "give either -o FILE"),
        (["--plan", "--center", "--profile", "raw"], "leave out --profile"),
        (["--plan", "-o", "out.hyrf", "--center"], "give either -o FILE"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else None,
)
def test_options_that_make_no_sense_are_refused(options, problem):
    result = hyrfpack("edit", COMPACT_FILE, *options)
    assert result.exit_code == 2 and problem in result.stderr and "Traceback" not in result.stderr


def test_edit_model_checks_its_actions(tmp_path):
    with pytest.raises(ValueError, match="no actions"):
        edit_model(COMPACT_FILE, tmp_path / "out.hyrf", [])
    with pytest.raises(TypeError, match="not an action of hyrfpack.config.edit"):
        edit_model(COMPACT_FILE, tmp_path / "out.hyrf", ["crop"])


def test_a_chunk_of_a_scene_folder_keeps_the_provenance_of_the_scene(tmp_path):
    chunk = GOLDEN_SCENE_FOLDER / "chunk-0000-0.hyrf"
    report = edit_model(chunk, tmp_path / "edited.hyrf", [Translate((1.0, 0.0, 0.0))], context=QUIET_CONTEXT)
    before, after = (describe_file(path)["provenance"] for path in (chunk, report.file))
    assert after.keys() == before.keys() | {"placement"}


@pytest.mark.parametrize("degrees", [math.nan, math.inf, True, "9"])
def test_an_angle_that_is_no_finite_number_is_refused(degrees):
    for make in (partial(Rotate, (0.0, 0.0, 1.0)), partial(CropBox, (0.0, 0.0, 0.0), (1.0, 1.0, 1.0))):
        with pytest.raises(ValueError, match="degrees is .*; it must be a finite number"):
            make(degrees=degrees)
    assert Rotate((0.0, 0.0, 1.0), -90.0).degrees == -90
