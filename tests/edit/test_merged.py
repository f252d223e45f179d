"""An edit of a merged file acts on all parts, in the world that they share."""

from __future__ import annotations

import dataclasses
import json
import logging
from pathlib import Path

import numpy as np
import pytest
import torch
from commands import refused, succeeded
from layers import only_in_acceptance
from scenes import QUIET_CONTEXT, ball_points, ball_scene, camera_at, ring, small_model
from scipy.spatial import Delaunay

from hyrfpack.cameras.capture import Capture, provenance_cameras
from hyrfpack.cameras.paths import Viewpoint
from hyrfpack.compress import compress_model, run
from hyrfpack.compress.removals import measure_removals
from hyrfpack.config.compress import CompressConfig
from hyrfpack.config.edit import (
    Background,
    Center,
    CropBox,
    CropCameras,
    CropMasks,
    CropPolygon,
    CropSphere,
    EditLimits,
    EstimateUp,
    KeepGaussians,
    MaxScale,
    MinOpacity,
    Refit,
    Remove,
    RemoveFloaters,
    Rotate,
    Scale,
    Translate,
    Up,
    Upright,
)
from hyrfpack.edit import edit_model, floaters, merge_models, plan_edit
from hyrfpack.errors import HyrfError
from hyrfpack.evaluate.metrics import psnr
from hyrfpack.format import describe_file, encode_model, load_merged_model, load_model, save_model
from hyrfpack.format.codec import load_parts
from hyrfpack.format.parts import write_parts
from hyrfpack.render import render_view

pytestmark = pytest.mark.usefixtures("quick_calibration")
CAMERAS = ring(8)
PART_OFFSET = np.array([1.2, 0.3, -0.1])
PART_MOVES = [Rotate((0, 0, 1), 90), Scale(0.5), Translate(tuple(PART_OFFSET))]
QUARTER_TURN = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


def write_model(path: Path, seed: int, **settings) -> Path:
    points, colors = ball_points(60, seed)
    generator = torch.Generator().manual_seed(seed)
    logits = torch.randn(2, 60, 1, generator=generator)
    settings = {"scale_logits": 0.5 * logits[0] - 2.5, "opacity_logits": logits[1] + 0.5, "fields": 0.5, **settings}
    model = small_model(points, color_logits=torch.from_numpy(colors) * 4 - 2, seed=seed, **settings)
    kept = {"cameras": provenance_cameras(CAMERAS), "viewpoint": Viewpoint.from_cameras(CAMERAS).to_json()}
    save_model(model, path, provenance=kept)
    return path


@pytest.fixture(scope="module")
def merged(tmp_path_factory) -> Path:
    """Return a file of a room with a background, and of a toy that is turned, scaled and moved."""
    folder = tmp_path_factory.mktemp("models")
    sources = write_model(folder / "room.hyrf", 1, background=True), write_model(folder / "toy.hyrf", 2)
    merge_models(sources, folder / "both.hyrf", {"toy": PART_MOVES})
    return folder / "both.hyrf"


class World:
    """Centres, longest axes and opacities of all Gaussians of a file in float64, by the definition of the moves."""

    def __init__(self, path: Path) -> None:
        room, toy = (load_model(path.with_name(f"{name}.hyrf")) for name in ("room", "toy"))
        first, second = (part.gaussians.positions.detach().double().numpy() for part in (room, toy))
        self.positions = np.concatenate((first, 0.5 * second @ QUARTER_TURN.T + PART_OFFSET))
        shapes = [part.decode_geometry() for part in (room, toy)]
        longest = [shape.scales.detach().double().amax(1).numpy() for shape in shapes]
        self.longest = np.concatenate((longest[0], 0.5 * longest[1]))
        self.opacities = np.concatenate([shape.opacities.detach().numpy() for shape in shapes])
        self.part = np.repeat([0, 1], [len(room), len(toy)])


def is_in_plan_hull(points: np.ndarray, *corners: tuple[float, float]) -> np.ndarray:
    return Delaunay(corners).find_simplex(points[:, :2]) >= 0


BOX_CORNERS, SPHERE, INFINITY = (
    (np.array((-0.3, -1, -1)), np.array((1.3, 1, 1))),
    CropSphere((0.8, 0.2, 0.0), 0.7),
    np.inf,
)
CONCAVE_POLYGON = CropPolygon(((-1, -1, 0), (1.2, -1, 0), (1.2, 2, 0), (0, 0.2, 0)), max_height=0.2)
WIDER_BOX = CropBox((-INFINITY,) * 3, (3.4, INFINITY, INFINITY))
SELECTION_CASES = {
    "box": (
        [CropBox(*map(tuple, BOX_CORNERS))],
        lambda w: ((w.positions >= BOX_CORNERS[0]) & (w.positions <= BOX_CORNERS[1])).all(1),
    ),
    "sphere": ([SPHERE], lambda w: np.linalg.norm(w.positions - SPHERE.center, axis=1) <= 0.7),
    "invert": ([Remove(SPHERE)], lambda w: np.linalg.norm(w.positions - SPHERE.center, axis=1) > 0.7),
    "opacity": ([MinOpacity(0.6)], lambda w: w.opacities >= 0.6),
    "scale": ([MaxScale(0.07)], lambda w: w.longest <= 0.07),
    "polygon": (
        [CONCAVE_POLYGON],
        lambda w: (
            (
                is_in_plan_hull(w.positions, (-1, -1), (1.2, -1), (0, 0.2))
                | is_in_plan_hull(w.positions, (1.2, -1), (1.2, 2), (0, 0.2))
            )
            & (w.positions[:, 2] <= 0.2)
        ),
    ),
    "cameras": (
        [CropCameras(-0.6)],
        lambda w: is_in_plan_hull(w.positions, *(0.4 * camera.position[:2] for camera in CAMERAS)),
    ),
    "after moves": (
        [Scale(2.0), Translate((1.0, 0.0, 0.0)), WIDER_BOX, MaxScale(0.16)],
        lambda w: (2 * w.positions[:, 0] + 1 <= 3.4) & (2 * w.longest <= 0.16),
    ),
}


@pytest.mark.parametrize(
    "name", only_in_acceptance(SELECTION_CASES, SELECTION_CASES.keys() - {"polygon", "cameras", "after moves"})
)
def test_a_selection_keeps_the_gaussians_of_the_float64_union(name, merged, tmp_path):
    actions, keep = SELECTION_CASES[name]
    world = World(merged)

    report = edit_model(merged, tmp_path / "out.hyrf", actions, context=QUIET_CONTEXT)

    kept, whole = keep(world), load_merged_model(merged)
    assert all(0 < kept[world.part == part].sum() for part in (0, 1)) and not kept.all()
    edited = load_merged_model(report.file)
    assert edited.names == ("room", "toy") and report.actions[-1].gaussians_after == kept.sum()
    for number, (before, after) in enumerate(zip(whole.parts, edited.parts, strict=True)):
        index = torch.from_numpy(np.flatnonzero(kept[world.part == number]))
        for old, new in zip(before.gaussians.parameters(), after.gaussians.parameters(), strict=True):
            assert torch.equal(old[index], new)


def test_moves_copy_all_numbers_and_move_every_part(merged, tmp_path):
    report = edit_model(
        merged, tmp_path / "moved.hyrf", [Scale(3.0), Translate((5.0, 0.0, 1.0))], context=QUIET_CONTEXT
    )

    before, after = load_merged_model(merged), load_merged_model(report.file)
    for old, new in zip(before.parts, after.parts, strict=True):
        assert all(torch.equal(a, b) for a, b in zip(old.parameters(), new.parameters(), strict=True))
        np.testing.assert_allclose(new.config.frame.center, 3 * np.array(old.config.frame.center) + (5, 0, 1))
    camera, moved = camera_at((1.5, -2.5, 1.0)), camera_at((9.5, -7.5, 4.0), (5.0, 0.0, 1.0))
    assert psnr(render_view(after, moved).rgb, render_view(before, camera).rgb) > 60
    assert report.psnr_change > 60


def test_up_turns_the_whole_file_about_the_cameras_of_the_scene(merged, tmp_path):
    report = edit_model(merged, tmp_path / "up.hyrf", [Up((0, 1, 0)), Upright("z")], context=QUIET_CONTEXT)

    # The shortest rotation from +y to +z turns about the x axis.
    turn = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])
    for old, new in zip(load_merged_model(merged).parts, load_merged_model(report.file).parts, strict=True):
        np.testing.assert_allclose(new.config.frame.center, turn @ old.config.frame.center, atol=1e-12)
        np.testing.assert_allclose(new.config.frame.axes, turn @ old.config.frame.axes, atol=1e-12)
    assert describe_file(report.file)["provenance"]["viewpoint"]["up"] == pytest.approx((0, 0, 1))
    estimated = plan_edit(merged, [EstimateUp()], context=QUIET_CONTEXT).actions[0].action
    assert "(0, 0, 1)" in estimated or "0, 0, 1" in estimated  # the cameras stand level around the z axis


def test_a_part_that_is_left_with_nothing_is_left_out_with_a_note(merged, tmp_path, caplog):
    with caplog.at_level(logging.INFO, "hyrfpack"):
        crop = CropBox((-5, -5, -5), (0.6, 5, 5))
        kept_room = edit_model(merged, tmp_path / "room.hyrf", [crop], context=QUIET_CONTEXT)
        only_toy = edit_model(merged, tmp_path / "toy.hyrf", [CropSphere((1.35, 0.4, 0), 0.2)], context=QUIET_CONTEXT)

    assert "parts" not in describe_file(kept_room.file) and len(load_model(kept_room.file))
    notes = " | ".join(caplog.messages)
    assert "part 'toy' has no Gaussian left and is left out" in notes
    assert "part 'room' has no Gaussian left and is left out" in notes
    assert "the cameras of part 'toy'" in notes
    assert load_model(only_toy.file).config.frame == load_merged_model(merged).parts[1].config.frame


def write_without_gaussians_in_the_scene(merged: Path, path: Path, **config) -> Path:
    """Write a file as versions of 2025 left it: its first part shows its background alone."""
    (name, scene, provenance), *others = load_parts(merged)
    scene = scene.subset(torch.arange(0))
    scene.config = dataclasses.replace(scene.config, **config)
    parts = [(name, encode_model(scene, "raw", provenance))]
    parts += [(other, encode_model(model, "raw", kept)) for other, model, kept in others]
    return Path(write_parts(parts, path).file)


def test_a_scene_that_is_all_background_stays_in_an_edited_file(merged, tmp_path):
    hollow = write_without_gaussians_in_the_scene(merged, tmp_path / "hollow.hyrf")
    edited = edit_model(hollow, tmp_path / "edited.hyrf", [MinOpacity(0.0)], context=QUIET_CONTEXT)
    moved = edit_model(hollow, tmp_path / "moved.hyrf", [Scale(2.0)], profile="compact", context=QUIET_CONTEXT)
    for report in (edited, moved):
        model = load_merged_model(report.file)
        assert model.names == ("room", "toy") and model.parts[0].config.background
        assert describe_file(report.file)["provenance"]["viewpoint"] is not None


@pytest.mark.parametrize("profile_only", [False, True])
def test_a_scene_that_is_all_background_is_compressed_with_the_other_parts(merged, tmp_path, profile_only):
    hollow = write_without_gaussians_in_the_scene(merged, tmp_path / "hollow.hyrf")
    limit = None if profile_only else hollow.stat().st_size // 2
    report = compress_model(hollow, tmp_path / "small.hyrf", CompressConfig(target_bytes=limit), context=QUIET_CONTEXT)
    camera = camera_at((1.5, -2.5, 1.0))
    renders = [render_view(load_merged_model(path), camera).rgb for path in (hollow, report.file)]
    assert report.bytes_after < hollow.stat().st_size / 2 and psnr(*renders) > 30


def test_a_scene_of_one_colour_alone_is_refused_with_a_target_size(merged, tmp_path):
    hollow = write_without_gaussians_in_the_scene(merged, tmp_path / "hollow.hyrf", background=False)
    with pytest.raises(HyrfError, match="no Gaussian in it and no background"):
        compress_model(hollow, tmp_path / "small.hyrf", CompressConfig(target_bytes=9_000), context=QUIET_CONTEXT)
    assert compress_model(hollow, tmp_path / "small.hyrf", context=QUIET_CONTEXT).bytes_after > 0


def test_actions_after_the_first_part_is_left_out_use_the_cameras_of_the_next(merged, tmp_path):
    crops = [Scale(2.0), CropSphere((2.7, 0.8, 0), 0.4)]
    moves = [Translate((2.0, 0.0, 0.0)), Center(), Up((0, 1, 0))]

    at_once = edit_model(merged, tmp_path / "at_once.hyrf", [*crops, *moves], context=QUIET_CONTEXT)
    cropped = edit_model(merged, tmp_path / "toy.hyrf", crops, context=QUIET_CONTEXT)
    in_turn = edit_model(cropped.file, tmp_path / "in_turn.hyrf", moves, context=QUIET_CONTEXT)

    assert "parts" not in describe_file(at_once.file)
    frames = [load_model(report.file).config.frame for report in (at_once, in_turn)]
    np.testing.assert_allclose(frames[0].center, frames[1].center, atol=1e-9)
    viewpoints = [Capture(describe_file(report.file)).viewpoint for report in (at_once, in_turn)]
    for name in ("center", "up"):
        np.testing.assert_allclose(*(getattr(viewpoint, name) for viewpoint in viewpoints), atol=1e-9)


def test_a_chosen_up_direction_outlasts_the_part_that_it_was_chosen_for(merged, tmp_path):
    actions = [Up((1, 0, 0)), Rotate((0, 0, 1), 90), CropSphere((-0.4, 1.35, 0), 0.2)]

    only_toy = edit_model(merged, tmp_path / "toy.hyrf", actions, context=QUIET_CONTEXT)

    facts = describe_file(only_toy.file)
    assert "parts" not in facts and facts["gaussians"] < 60
    assert facts["provenance"]["viewpoint"]["up"] == pytest.approx((0, 1, 0))


def test_a_message_about_a_part_that_cannot_be_compressed_names_file_and_part(merged, tmp_path):
    far = ball_points(30)[0] * 0.1 + np.array([0.0, 0.0, 500.0])
    save_model(small_model(far), tmp_path / "far.hyrf", provenance={"cameras": provenance_cameras(CAMERAS)})
    merge_models([merged.with_name("toy.hyrf"), tmp_path / "far.hyrf"], tmp_path / "two.hyrf")
    with pytest.raises(HyrfError, match=r"two.hyrf: part 'far': none of its \d+ cameras sees a Gaussian"):
        compress_model(tmp_path / "two.hyrf", tmp_path / "out.hyrf", context=QUIET_CONTEXT)


def write_merged_with_empty_part(merged: Path, folder: Path, *, is_first: bool) -> Path:
    """Write a merged file as earlier versions wrote it, with an empty part that has a background."""
    save_model(small_model(np.zeros((0, 3)), fields=0.5, background=True), folder / "empty.hyrf", "raw")
    parts = [(name, merged.with_name(f"{name}.hyrf").read_bytes()) for name in ("room", "toy")]
    parts.insert(0 if is_first else 1, ("empty", (folder / "empty.hyrf").read_bytes()))
    return Path(write_parts(parts, folder / "old.hyrf").file)


@pytest.mark.parametrize("is_first", [False, True])
def test_an_empty_part_of_a_merged_file_is_no_obstacle_to_compression(is_first, merged, tmp_path):
    old = write_merged_with_empty_part(merged, tmp_path, is_first=is_first)

    compress_model(old, tmp_path / "out.hyrf", context=QUIET_CONTEXT)

    names = [part["name"] for part in describe_file(tmp_path / "out.hyrf")["parts"]]
    assert names == (["empty", "room", "toy"] if is_first else ["room", "toy"])
    renders = [render_view(load_merged_model(path), CAMERAS[0]).rgb for path in (old, tmp_path / "out.hyrf")]
    assert psnr(*renders) > 35


def test_an_edit_that_leaves_nothing_is_refused(merged, tmp_path):
    with pytest.raises(HyrfError, match="would remove every Gaussian"):
        edit_model(merged, tmp_path / "out.hyrf", [CropSphere((50, 0, 0), 1)], context=QUIET_CONTEXT)
    assert not list(tmp_path.iterdir())


def test_a_background_colour_is_that_of_every_part(merged, tmp_path):
    actions = [Background((0.2, 0.4, 0.6)), CropSphere((1.35, 0.4, 0), 0.2)]

    report = edit_model(merged, tmp_path / "toy.hyrf", actions, context=QUIET_CONTEXT)

    rgb = render_view(load_model(report.file), camera_at((30.0, 0.0, 0.0), (31.0, 0.0, 0.0))).rgb
    torch.testing.assert_close(rgb, torch.tensor((0.2, 0.4, 0.6)).expand_as(rgb))


@pytest.mark.acceptance
def test_the_error_of_a_removal_is_that_of_the_merged_picture(merged):
    """Faint and hidden Gaussians cost least, in whichever part they are."""
    model = load_merged_model(merged)
    cameras = ring(6)

    estimated = measure_removals(model, cameras)

    measured = []
    with torch.no_grad():
        pictures = [render_view(model, camera).rgb for camera in cameras]
        for number in range(0, len(model), 6):
            others = model.subset(torch.cat((torch.arange(number), torch.arange(number + 1, len(model)))))
            errors = [(render_view(others, c).rgb - p).square().mean() for c, p in zip(cameras, pictures, strict=True)]
            measured.append(float(sum(errors)))
    ranks = [np.argsort(np.argsort(values)) for values in (estimated[::6], np.array(measured))]
    assert np.corrcoef(*ranks)[0, 1] > 0.7
    report = plan_edit(merged, [KeepGaussians(70)], context=QUIET_CONTEXT)
    assert report.actions[0].gaussians_after == 70


@pytest.mark.acceptance
def test_all_parts_share_a_target_size(merged, tmp_path):
    free = edit_model(merged, tmp_path / "free.hyrf", [Scale(1.0)], profile="compact", context=QUIET_CONTEXT)
    limits = EditLimits(target_bytes=free.bytes_after * 4 // 5)

    report = edit_model(merged, tmp_path / "small.hyrf", [MinOpacity(0.1)], limits=limits, context=QUIET_CONTEXT)

    facts = describe_file(report.file)
    assert 0.8 * limits.target_bytes < report.bytes_after == facts["bytes"] <= limits.target_bytes
    assert [part["profile"] for part in facts["parts"]] == ["compact", "compact"]
    assert f"{limits.target_bytes:,}" in report.found


def test_a_target_below_the_smallest_file_is_refused_before_sensitivities_are_measured(merged, tmp_path, monkeypatch):
    monkeypatch.setattr(run, "measure_calibrated_sensitivity", lambda *arguments: pytest.fail("the measurement began"))

    with pytest.raises(HyrfError, match="a target size of 5 bytes is below the smallest possible file"):
        compress_model(merged, tmp_path / "out.hyrf", CompressConfig(target_bytes=5), context=QUIET_CONTEXT)


@pytest.mark.acceptance
def test_the_loss_is_limited_on_the_pixels_that_show_the_scene(merged, tmp_path):
    scene = ball_scene(8)
    limits = EditLimits(max_psnr_drop=0.2)

    report = edit_model(merged, tmp_path / "small.hyrf", [], limits=limits, data=scene, context=QUIET_CONTEXT)

    whole, small = load_merged_model(merged), load_merged_model(report.file)
    drops = []
    for view in scene.train:
        renders = [render_view(model, view.camera).rgb for model in (whole.scene, whole, small)]
        shown = (renders[0] - renders[1]).abs().amax(-1) <= 8 / 255
        photo = torch.from_numpy(view.load().rgb / np.float32(255))
        drops.append([psnr(rgb.clamp(0, 1), photo, shown) for rgb in renders[1:]])
    before, after = np.mean(drops, axis=0)
    assert 0 < report.bytes_after < merged.stat().st_size
    assert before - after <= 0.2 + 0.02  # pictures are scored with 8 bits


def test_photos_say_only_which_gaussians_of_the_scene_are_floaters(merged, tmp_path, monkeypatch):
    """Photos do not show the other parts, which would all be floaters to them."""
    monkeypatch.setattr(floaters, "MIN_FADING_STEPS", 8)
    monkeypatch.setattr(floaters, "MIN_FADING_PASSES", 1)
    scene, action = ball_scene(4), RemoveFloaters(0.9)

    together = plan_edit(merged, [action], data=scene, context=QUIET_CONTEXT).actions[0]
    alone = plan_edit(merged, [action], part="room", data=scene, context=QUIET_CONTEXT).actions[0]

    removed = alone.gaussians_before - alone.gaussians_after
    assert together.gaussians_before - together.gaussians_after == removed > 0


@pytest.mark.parametrize("action", [Refit(CropSphere((0, 0, 0), 1), 3), CropMasks("masks")])
def test_an_action_that_needs_one_model_says_what_to_do(action, merged, tmp_path):
    with pytest.raises(HyrfError, match=r"part out with `part`.* and merge again"):
        edit_model(merged, tmp_path / "out.hyrf", [action], data=ball_scene(4), context=QUIET_CONTEXT)


def test_the_command_edits_all_parts(merged, tmp_path):
    options = ("--crop-box=-0.3,-1,-1,1.3,1,1", "--json")
    report = json.loads(succeeded("edit", merged, "-o", tmp_path / "out.hyrf", *options).stdout)

    assert report["actions"][0]["gaussians_after"] == SELECTION_CASES["box"][1](World(merged)).sum()
    error = refused("edit", merged, "-o", tmp_path / "no.hyrf", "--crop-sphere", "50,0,0,1")
    assert "would remove every Gaussian" in error and not (tmp_path / "no.hyrf").exists()
