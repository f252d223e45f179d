"""The export pipeline writes what was requested, reads it back and measures its loss."""

from __future__ import annotations

import json
import re
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image
from scenes import ball_scene, ring, small_model, view_of

import hyrfpack
from hyrfpack.cameras.capture import provenance_cameras
from hyrfpack.cameras.paths import Viewpoint
from hyrfpack.errors import HyrfError
from hyrfpack.evaluate import evaluate_model
from hyrfpack.export import ExportReport, baked_scene, pipeline, scores
from hyrfpack.export.bake import bake
from hyrfpack.export.kinds import COLMAP_FOLDER, EXPORT_ENDINGS, PLAYER_FOLDER, find_file_kind, select_splats
from hyrfpack.export.measure import PsnrScores, measure_psnr
from hyrfpack.export.source import Source
from hyrfpack.format import load_model, save_model
from hyrfpack.format.codec import load_with_provenance
from hyrfpack.model import Frame
from hyrfpack.render import render_view
from hyrfpack.scene import Camera, Picture, Scene
from hyrfpack.splats.table import FORMATS
from hyrfpack.web.html import decode_splats_page

GAUSSIAN_POSITIONS = np.random.default_rng(0).uniform(-0.6, 0.6, (40, 3))
FOUR_CAMERAS = ring(4)
CROP_BOX = (-0.3, -10, -10, 0.4, 10, 0.2)
SPLAT_SUFFIXES = (*FORMATS, ".html")
GOLDEN_SCENE = Path(__file__).parents[1] / "golden" / "scene"


def export(source, target, **options) -> ExportReport:
    """Export with degree 3, if the format has one, and baked pages by default; `colmap` becomes a COLMAP model."""
    kind = {"baked": str(target).endswith(".html"), "colmap": str(target).endswith("colmap"), **options}
    has_harmonics = not kind["colmap"] and not str(target).endswith((".json", ".points.ply", ".points.glb"))
    data = kind.pop("data", None)
    config = hyrfpack.ExportConfig(**({"degree": 3, **kind} if has_harmonics else kind))
    return hyrfpack.export_model(source, target, config, data=data)


def scale_and_move(camera: Camera, unit: float, center) -> Camera:
    pose = camera.camera_from_world.copy()
    pose[:3, 3] = unit * pose[:3, 3] - pose[:3, :3] @ np.asarray(center, np.float64)
    return replace(camera, camera_from_world=pose)


def write_model(path, model=None, cameras=FOUR_CAMERAS, **options):
    """Write a model as training would; return its path."""
    kept = {"cameras": provenance_cameras(cameras), "viewpoint": Viewpoint.from_cameras(cameras).to_json()}
    save_model(model or small_model(GAUSSIAN_POSITIONS, **{"fields": 2.0, **options}), path, provenance=kept)
    return path


@pytest.fixture(scope="module")
def plain_file(tmp_path_factory):
    """Write a model of forty Gaussians without a background."""
    return write_model(tmp_path_factory.mktemp("models") / "plain.hyrf")


@pytest.fixture(scope="module")
def sphere_file(tmp_path_factory):
    """Write a model of forty Gaussians with a background sphere."""
    return write_model(tmp_path_factory.mktemp("models") / "sphere.hyrf", background=True)


@pytest.fixture
def fail_if_baked(monkeypatch):
    """Fail the test if baking starts."""
    for name in ("bake_parts", "compute_parts_visibility"):
        monkeypatch.setattr(baked_scene, name, lambda *arguments: pytest.fail("the bake began"))


def read_back(path):
    data = path.read_bytes()
    return (
        decode_splats_page(data, "page")[0] if path.suffix == ".html" else FORMATS[path.suffix].decode(data, str(path))
    )


def distances_to_nearest(points: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Return the distance of each point to the nearest of `others`."""
    return np.linalg.norm(points[:, None] - others, axis=-1).min(1)


# -- written files ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("ending", SPLAT_SUFFIXES)
@pytest.mark.parametrize("place", [((0, 0, 0), 1.0), ((-30.0, 700.0, 2.0), 0.05), ((0, 0, 0), 300.0)])
def test_every_format_preserves_count_and_positions(ending, place, tmp_path):
    center, unit = place
    cameras = [scale_and_move(camera, unit, center) for camera in ring(2, width=8, height=8)]
    model = small_model(GAUSSIAN_POSITIONS, frame=Frame(center, unit, (1.0, 1.0, 1.0)))
    source, target = write_model(tmp_path / "model.hyrf", model, cameras), tmp_path / f"out{ending}"
    report = export(source, target)
    back, there = read_back(target), GAUSSIAN_POSITIONS * unit + center
    assert (report.file, report.bytes) == (str(target), target.stat().st_size)
    assert report.gaussians == len(back) == 40 and report.degree == back.degree == (0 if ending == ".splat" else 3)
    reach = np.abs(there).max()
    assert (
        max(distances_to_nearest(there, back.positions).max(), distances_to_nearest(back.positions, there).max())
        < 3e-4 * unit + 2e-7 * reach
    )
    assert report.psnr > 45 and report.views == 2


@pytest.mark.parametrize("ending", SPLAT_SUFFIXES)
def test_a_single_gaussian_is_exported(ending, tmp_path):
    source = write_model(tmp_path / "one.hyrf", small_model([[0.1, 0.2, 0.3]]), ring(1))
    report = export(source, tmp_path / f"one{ending}")
    assert report.gaussians == 1 and report.views == 1
    assert np.allclose(read_back(tmp_path / f"one{ending}").positions, [[0.1, 0.2, 0.3]], atol=2e-4)


@pytest.mark.parametrize(("count", "is_fitted"), [(4, True), (16, False)])
def test_the_report_says_if_an_export_is_measured_where_it_was_fitted(count, is_fitted, tmp_path):
    source = write_model(tmp_path / "m.hyrf", small_model(GAUSSIAN_POSITIONS), ring(count, width=8, height=8))
    assert export(source, tmp_path / "a.ply", degree=0).views_fitted == is_fitted


def test_points_files_contain_centers_and_cameras(plain_file, tmp_path):
    report = export(plain_file, tmp_path / "a.points.ply")
    cloud = trimesh.load(tmp_path / "a.points.ply")
    assert np.allclose(cloud.vertices[:40], load_model(plain_file).gaussians.positions.detach(), atol=1e-6)
    assert (report.gaussians, report.cameras) == (40, 4) and len(cloud.vertices) > 40
    export(plain_file, tmp_path / "a.points.glb")
    assert set(trimesh.load(tmp_path / "a.points.glb").geometry) == {"gaussians", "cameras"}


def test_transforms_json_contains_the_cameras_without_a_bake(plain_file, tmp_path, fail_if_baked):
    report = export(plain_file, tmp_path / "transforms.json")
    frames = json.loads((tmp_path / "transforms.json").read_text())["frames"]
    places = [np.array(frame["transform_matrix"])[:3, 3] for frame in frames]
    assert np.allclose(places, [camera.position for camera in ring(4)], atol=1e-6)
    assert (report.cameras, report.gaussians, report.bytes) == (4, 0, (tmp_path / "transforms.json").stat().st_size)


def test_cameras_without_names_of_photos_get_names_that_no_photo_has(plain_file, tmp_path, caplog):
    export(plain_file, tmp_path / "transforms.json")
    frames = json.loads((tmp_path / "transforms.json").read_text())["frames"]
    assert [frame["file_path"] for frame in frames] == [f"images/camera-000{number}.png" for number in range(4)]
    assert any("does not keep the names of its photos" in message for message in caplog.messages)


def test_exported_cameras_have_the_names_of_the_given_photos(plain_file, tmp_path, caplog):
    scene = ball_scene(views=4, side=8)
    export(plain_file, tmp_path / "transforms.json", data=scene)
    frames = json.loads((tmp_path / "transforms.json").read_text())["frames"]
    assert [frame["file_path"] for frame in frames] == [f"images/{view.name}" for view in scene.train]
    assert not any("names of its photos" in message for message in caplog.messages)


@pytest.mark.parametrize("target", ["transforms.json", "colmap"])
def test_cameras_that_do_not_fit_the_photos_on_disk_are_refused(plain_file, tmp_path, target):
    scene = ball_scene(views=4, side=8)
    scene = replace(scene, train=[replace(scene.train[0], is_resampled=True), *scene.train[1:]])
    with pytest.raises(HyrfError, match=f"1 of {len(scene.train)} photos .* do not fit the files"):
        export(plain_file, tmp_path / target, data=scene)
    assert not (tmp_path / target).exists()


def test_exported_cameras_fit_the_photo_files(plain_file, tmp_path):
    pycolmap = pytest.importorskip("pycolmap")
    export(plain_file, tmp_path / "transforms.json", data=ball_scene(views=4, side=32))
    for frame in json.loads((tmp_path / "transforms.json").read_text())["frames"]:
        (tmp_path / frame["file_path"]).parent.mkdir(exist_ok=True)
        Image.new("RGB", (32, 32)).save(tmp_path / frame["file_path"])
    small = hyrfpack.load_scene(tmp_path, max_size=16)
    assert small.train[0].camera.width == 16
    (tmp_path / "out").mkdir()
    export(plain_file, tmp_path / "out" / "cameras.json", data=small)
    content = json.loads((tmp_path / "out" / "cameras.json").read_text())
    assert content["w"] == 32 and all((tmp_path / "out" / frame["file_path"]).exists() for frame in content["frames"])
    export(plain_file, tmp_path / "colmap", data=small)
    cameras = pycolmap.Reconstruction(tmp_path / "colmap" / "sparse" / "0").cameras
    assert {camera.width for camera in cameras.values()} == {32}


@pytest.mark.parametrize("target", ["transforms.json", "colmap"])
def test_photos_without_training_photos_leave_the_cameras_of_the_file(target, plain_file, tmp_path, caplog):
    pytest.importorskip("pycolmap")
    held_out = replace(ball_scene(4), train=[])
    count = export(plain_file, tmp_path / "expected" / target).cameras
    assert count and export(plain_file, tmp_path / target, data=held_out).cameras == count
    assert caplog.text.count("does not keep the names of its photos") == 2


def test_a_colmap_export_writes_a_model_and_reports_its_size(plain_file, tmp_path):
    pycolmap = pytest.importorskip("pycolmap")
    mine = tmp_path / "colmap" / "sparse" / "0" / "mine.bin"
    mine.parent.mkdir(parents=True)
    mine.write_bytes(bytes(1000))
    report = export(plain_file, tmp_path / "colmap", crop=CROP_BOX)
    model = pycolmap.Reconstruction(tmp_path / "colmap" / "sparse" / "0")
    places = sorted(tuple(image.projection_center().round(5)) for image in model.images.values())
    assert places == sorted(tuple(camera.position.round(5)) for camera in ring(4))
    tables = set(mine.parent.iterdir()) - {mine}
    assert report.bytes == sum(table.stat().st_size for table in tables) and report.cameras == 4
    points = np.array([point.xyz for point in model.points3D.values()])
    assert len(points) and ((points >= CROP_BOX[:3]) & (points <= CROP_BOX[3:])).all()


def test_exports_are_deterministic(sphere_file, tmp_path):
    (tmp_path / "again").mkdir()
    for ending in SPLAT_SUFFIXES:
        first, second = tmp_path / f"a{ending}", tmp_path / "again" / f"a{ending}"
        for target in (first, second):
            export(sphere_file, target, degree=1, crop=(-9, -9, -9, 9, 9, 9))
        assert first.read_bytes() == second.read_bytes(), ending


# -- choices ---------------------------------------------------------------------------------------------------------


def points_in_crop(points: np.ndarray) -> np.ndarray:
    return points[((points >= CROP_BOX[:3]) & (points <= CROP_BOX[3:])).all(1)]


@pytest.mark.parametrize("ending", [".ply", ".sog", ".html"])
def test_a_crop_keeps_the_gaussians_inside_and_no_background(ending, sphere_file, tmp_path, caplog):
    report = export(sphere_file, tmp_path / f"part{ending}", crop=CROP_BOX)
    expected, back = (
        points_in_crop(load_model(sphere_file).gaussians.positions.detach().numpy()),
        read_back(tmp_path / f"part{ending}"),
    )
    assert 3 < len(expected) < 40 and len(back) == report.gaussians == len(expected) and report.background == 0
    assert distances_to_nearest(expected, back.positions).max() < 1e-3
    assert (report.views, report.psnr, report.psnr_baked) == (0, None, None)
    assert caplog.messages[-1] == "quality is not measured, because a part of the scene was cropped"


def test_a_crop_may_be_a_list_with_infinite_sides(plain_file, tmp_path):
    endless = float("inf")
    report = export(plain_file, tmp_path / "a.ply", crop=[0.0, *[-endless] * 2, *[endless] * 3])
    assert report.gaussians == (GAUSSIAN_POSITIONS[:, 0] >= 0).sum()


def test_min_opacity_removes_faint_gaussians(tmp_path):
    logits = np.linspace(-5, 5, 40, dtype=np.float32)[:, None]
    source = write_model(tmp_path / "model.hyrf", fields=0.0, opacity_logits=logits)
    report = export(source, tmp_path / "a.ply", min_opacity=0.5, degree=0)
    back = read_back(tmp_path / "a.ply")
    assert report.gaussians == len(back) == 20 and back.opacities.min() >= 0.5
    assert report.views == 4  # the loss is measured
    assert report.psnr < export(source, tmp_path / "b.ply", degree=0).psnr


def test_the_background_is_exported_unless_it_is_disabled(sphere_file, tmp_path):
    whole, alone = export(sphere_file, tmp_path / "a.ply"), export(sphere_file, tmp_path / "b.ply", background=False)
    assert whole.background >= 384 and whole.gaussians == 40 + whole.background
    assert (alone.background, alone.gaussians, len(read_back(tmp_path / "b.ply"))) == (0, 40, 40)
    page = export(sphere_file, tmp_path / "a.html")
    assert page.gaussians == 40 and b'<img id="background"' in (tmp_path / "a.html").read_bytes()
    export(sphere_file, tmp_path / "b.html", background=False)
    assert b'<img id="background"' not in (tmp_path / "b.html").read_bytes()
    assert min(whole.psnr, alone.psnr, page.psnr_baked) > 25
    assert page.psnr > 20  # a nearly random background loses detail in WebP


def test_a_solid_background_color_is_compared_correctly(tmp_path):
    source = write_model(tmp_path / "model.hyrf", solid=(1.0, 1.0, 1.0))
    for ending in (".ply", ".html"):
        report = export(source, tmp_path / f"a{ending}")
        assert report.background == 0 and report.psnr > 35


# -- measured loss ---------------------------------------------------------------------------------------------------


def test_psnr_rises_with_the_degree_of_direction_dependent_colors(tmp_path):
    source = write_model(tmp_path / "model.hyrf", fields=4.0, direction_encoding="sh", cameras=ring(12))
    scores = [export(source, tmp_path / "a.ply", degree=degree).psnr for degree in range(4)]
    assert scores == sorted(scores) and scores[3] > scores[0] + 6


@pytest.mark.parametrize(("radius", "warned"), [(200, False), (800, True)])
def test_a_background_that_a_format_brings_near_is_a_warning(radius, warned, tmp_path, caplog):
    frame = Frame((0.0, 0.0, 0.0), radius, (1.0, 1.0, 1.0))
    model = small_model(GAUSSIAN_POSITIONS, fields=1.0, background=True, frame=frame)
    cameras = [scale_and_move(camera, radius, (0, 0, 0)) for camera in FOUR_CAMERAS]
    source = write_model(tmp_path / "a.hyrf", model, cameras)
    for ending in (".spz", ".ply"):
        export(source, tmp_path / f"a{ending}", degree=0)
    assert caplog.text.count("so that the background is drawn at") == warned


@pytest.mark.parametrize("ending", [".ply", ".spz", ".splat", ".sog"])
def test_the_reported_psnr_is_measured_on_the_written_file(ending, plain_file, tmp_path):
    report = export(plain_file, tmp_path / f"a{ending}", degree=2)
    views = [(camera, None) for camera in Source.read(plain_file).fit_cameras]
    file = measure_psnr(
        load_model(plain_file), {"file": (read_back(tmp_path / f"a{ending}"), None)}, views, sphere=False
    )["file"]
    assert report.psnr == pytest.approx(file.model, abs=1e-3)
    assert (report.psnr == pytest.approx(report.psnr_baked, abs=1e-3)) == (ending == ".ply")


def test_a_lossy_file_has_a_lower_psnr(plain_file, tmp_path, monkeypatch):
    form = FORMATS[".ply"]
    lossy = replace(form, decode=lambda *arguments: form.decode(*arguments)[:20])
    monkeypatch.setattr(pipeline, "find_file_kind", lambda *target: lossy)
    report = export(plain_file, tmp_path / "a.ply")
    assert report.psnr < report.psnr_baked - 3


def test_a_format_without_antialiasing_is_reported_as_such(tmp_path, caplog):
    source = write_model(tmp_path / "m.hyrf", antialiased=True, scale_logits=-5.0, fields=0.0)
    for ending, word in ((".glb", "antialiased"), (".spz", "measuring"), (".sog", "measuring")):
        export(source, tmp_path / f"a{ending}", degree=0)
        assert word in caplog.messages[-1]


def photograph_model(model, cameras) -> Scene:
    """Render noisy photos (30 dB) of a model; every other one is held out."""
    rng = np.random.default_rng(0)
    views = []
    for number, camera in enumerate(cameras):
        rgb = render_view(model, camera).rgb.detach().numpy() + rng.normal(scale=0.03, size=(32, 32, 3))
        picture = Picture((rgb.clip(0, 1) * 255).round().astype(np.uint8))
        views.append(view_of(f"{number}.png", camera, picture))
    return Scene("made up", "colmap", views[::2], views[1::2], np.zeros((0, 3)), np.zeros((0, 3), np.float32))


def without_cameras(source: Path, target: Path) -> Path:
    """Copy a model's file without the cameras of its photos."""
    model, provenance = load_with_provenance(source)
    save_model(model, target, provenance={name: value for name, value in provenance.items() if name != "cameras"})
    return target


def export_in_unit(unit: float, view_source: str, folder) -> ExportReport:
    """Export forty Gaussians in a unit of length to .spz."""
    frame = Frame((0, 0, 0), unit, (1.0, 1.0, 1.0))
    model = small_model(GAUSSIAN_POSITIONS, frame=frame, fields=0.0, color_logits=1.0, scale_logits=-1.5)
    cameras = [scale_and_move(camera, unit, (0, 0, 0)) for camera in ring(8)]
    source = write_model(folder / "model.hyrf", model, cameras)
    if view_source == "generated viewpoints":
        source = without_cameras(source, folder / "bare.hyrf")
    data = photograph_model(model, cameras) if view_source == "photos" else None
    return export(source, folder / "a.spz", degree=0, data=data)


VIEW_SOURCES = ("photos", "cameras", "generated viewpoints")


@pytest.mark.parametrize("view_source", VIEW_SOURCES)
@pytest.mark.parametrize("unit", [1e-5, 1e5])
def test_a_format_too_coarse_for_the_unit_of_length_is_reported(unit, view_source, tmp_path, caplog):
    export_in_unit(unit, view_source, tmp_path)
    message = caplog.messages[-1]
    assert caplog.records[-1].levelname == "WARNING"
    verb = "costs" if view_source == "photos" else "leaves"
    pattern = rf"\.spz {verb} \d+\.\d dB[^\n]*, because its numbers are too coarse[^\n]*\(\.glb, .*, or scale the scene"
    assert re.fullmatch(pattern, message)
    assert ("at generated viewpoints" in message) == (view_source == "generated viewpoints")


@pytest.mark.parametrize("view_source", VIEW_SOURCES)
def test_invisible_rounding_is_not_reported(view_source, tmp_path, caplog):
    report = export_in_unit(1.0, view_source, tmp_path)
    assert min(report.psnr_baked, 50) - report.psnr > 3  # compared with the model, the loss is large
    assert caplog.messages[-1] == f"measuring at {report.views} views"


def test_the_loss_of_a_format_is_measured_on_photos_if_there_are_any():
    """The similarity of the file's pictures to the model's does not decide there."""
    baked_scores = PsnrScores(60, 30.0, 1)
    assert scores._describe_loss(baked_scores, PsnrScores(20, 29.7, 1)) is None
    assert scores._describe_loss(baked_scores, PsnrScores(40, 28.0, 1)) == "costs 2.0 dB"


@pytest.mark.parametrize(
    ("baked", "file", "loss"),
    [(60, 45, None), (60, 30.1, None), (60, 29.9, "leaves 29.9 dB"), (25, 24.5, None), (25, 20, "leaves 20.0 dB")],
)
def test_without_photos_a_format_is_reported_only_if_it_leaves_a_low_psnr(baked, file, loss):
    assert scores._describe_loss(PsnrScores(baked, None, 1), PsnrScores(file, None, 1)) == loss


def test_an_export_of_an_accurate_import_is_not_reported_as_coarse(tmp_path, caplog):
    """The PSNR of an import is that against the splats, and says nothing about photos."""
    model = small_model(GAUSSIAN_POSITIONS, fields=0.0, color_logits=1.0, scale_logits=-1.5)
    path = tmp_path / "imported.hyrf"
    save_model(model, path, provenance={"psnr": 55.0, "choices": {"imported": "from a.ply"}})
    report = export(path, tmp_path / "a.spz", degree=0)
    assert report.psnr_baked - report.psnr > 3 and report.psnr > 30
    assert not [record for record in caplog.records if record.levelname == "WARNING"]


def test_held_out_photos_are_scored_but_not_fitted(plain_file, tmp_path, monkeypatch):
    photos = ball_scene(8).train
    scene = replace(ball_scene(8), train=photos[1::2], test=photos[::2])
    fitted = []
    monkeypatch.setattr(
        baked_scene,
        "bake_parts",
        lambda model, cameras, degrees, *_: fitted.extend(cameras) or bake(model, [], degrees),
    )
    report = export(plain_file, tmp_path / "a.ply", data=scene)
    assert fitted == [view.camera for view in scene.train] and report.views == 4
    assert report.photos_model == pytest.approx(evaluate_model(load_model(plain_file), scene.test).psnr, abs=1e-6)
    assert report.photos_file == pytest.approx(report.photos_model, abs=0.5)


def test_missing_held_out_photos_are_reported(plain_file, tmp_path, caplog):
    report = export(plain_file, tmp_path / "a.ply", data=ball_scene(3))
    assert report.views == 0 and caplog.messages[-1] == "quality is not measured, because no photo is held out"


def test_fully_masked_photos_give_no_score(plain_file, tmp_path):
    scene = ball_scene(2)
    hidden = [
        replace(view, load=lambda view=view: replace(view.load(), mask=np.zeros((32, 32), bool)))
        for view in scene.train
    ]
    report = export(plain_file, tmp_path / "a.ply", data=replace(scene, test=hidden))
    assert (report.views, report.psnr) == (0, None)


# -- files without cameras ---------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def compact_file(plain_file, tmp_path_factory):
    path = tmp_path_factory.mktemp("compact") / "compact.hyrf"
    hyrfpack.compress_model(plain_file, path)
    return path


@pytest.mark.parametrize("name", ["cameras.json", "colmap"])
def test_missing_cameras_are_reported_or_taken_from_photos(name, compact_file, tmp_path, fail_if_baked):
    with pytest.raises(HyrfError, match=r"compact\.hyrf: it keeps only coarse cameras; [^\n]*`data`$"):
        export(compact_file, tmp_path / name)
    assert list(tmp_path.iterdir()) == []
    if name.endswith(".json"):
        assert export(compact_file, tmp_path / name, data=ball_scene(5)).cameras == 5


def test_a_compact_file_is_baked_and_measured_at_the_cameras_of_its_photos(compact_file, tmp_path, caplog):
    report = export(compact_file, tmp_path / "a.spz", degree=1)
    assert re.fullmatch(r"fitting colours of degree 1 at \d+ cameras", caplog.messages[0])
    assert report.views > 0 and report.psnr > 25
    assert export(compact_file, tmp_path / "a.points.ply").cameras == len(FOUR_CAMERAS)


def test_a_file_without_cameras_is_baked_and_measured_on_an_orbit(plain_file, tmp_path, caplog):
    report = export(without_cameras(plain_file, tmp_path / "bare.hyrf"), tmp_path / "a.spz", degree=1)
    assert "stores no cameras" in caplog.messages[0] and report.views > 0 and report.psnr > 25


# -- refusals before the work, and no half-written files --------------------------------------------------------------


def test_the_suffix_selects_the_format():
    assert [find_file_kind(f"a/b{ending}").ending for ending in EXPORT_ENDINGS] == list(EXPORT_ENDINGS)
    assert (
        find_file_kind("a/b") is PLAYER_FOLDER
        and find_file_kind("a/b", hyrfpack.ExportConfig(colmap=True)) is COLMAP_FOLDER
    )
    for name, ending in {"A/B.PLY": ".ply", "a.b/c": "", "my.scene.spz": ".spz"}.items():
        assert find_file_kind(name).ending == ending
    for name in ("a.xyz", "model.hyrf", "a.ply.txt"):
        with pytest.raises(
            HyrfError, match=rf"^{name}: the file extension does not name a known format; [^\n]*\.ply[^\n]*$"
        ):
            find_file_kind(name)
    with pytest.raises(HyrfError, match="compressed PLY is read, not written"):
        find_file_kind("a.compressed.ply")
    with pytest.raises(HyrfError, match=r"^a\.ply: this format is a folder of files"):
        find_file_kind("a.ply", hyrfpack.ExportConfig(colmap=True))


INVALID_OPTIONS = [
    {"degree": 4},
    {"degree": -1},
    {"crop": (0, 0, 0, 1, 1, float("nan"))},
    {"crop": (0, 0, 1, 1)},
    {"crop": (1, 1, 1, 0, 0, 0)},
    {"crop": (90, 90, 90, 91, 91, 91)},
    {"min_opacity": float("nan")},
    {"min_opacity": 1.5},
    {"min_opacity": 0.999},
]


@pytest.mark.parametrize("options", INVALID_OPTIONS, ids=str)
def test_invalid_options_are_refused_before_the_bake(options, plain_file, tmp_path, fail_if_baked):
    with pytest.raises((HyrfError, ValueError)) as refusal:  # ValueError: never valid; HyrfError: not for this model
        export(plain_file, tmp_path / "a.ply", **options)
    assert re.fullmatch(r"[^\n]+; [^\n]+[^.]", str(refusal.value))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("center", "unit", "message"),
    [
        (
            (500_000, 5_000_000, 0),
            10.0,
            r"the Gaussians reach 5,000,00\d units from the origin, but \.spz is limited to 4,194,303; choose another "
            r"format, or first move the scene to the origin with 'hyrfpack edit' and "
            r"`translate=-(49999\d|50000\d),-(499999\d|500000\d),-?\d`",
        ),
        ((0, 0, 0), 1e7, r"the Gaussians reach \d,\d{3},\d{3} units .*, or leave out the far Gaussians with `crop`"),
        (
            (0, 0, 0),
            1e5,
            r"the scene reaches [\d,]+ units from the origin with its background, .*; choose another format, or leave "
            r"out the background with `background=False`",
        ),
    ],
)
def test_a_scene_too_far_from_the_origin_is_refused_before_the_bake(center, unit, message, tmp_path, fail_if_baked):
    model = small_model(GAUSSIAN_POSITIONS, frame=Frame(center, unit, (1.0, 1.0, 1.0)), background=True)
    source = write_model(tmp_path / "m.hyrf", model, [scale_and_move(camera, unit, center) for camera in ring(2)])
    with pytest.raises(HyrfError) as refusal:
        export(source, tmp_path / "a.spz")
    assert re.fullmatch(message, str(refusal.value))


def test_gaussian_options_for_a_file_of_cameras_are_refused(plain_file, tmp_path):
    for options in ({"crop": CROP_BOX}, {"min_opacity": 0.5}):
        with pytest.raises(HyrfError, match=r"holds only cameras[^\n]*$"):
            export(plain_file, tmp_path / "a.json", **options)


def test_a_model_that_no_camera_sees_is_refused(tmp_path):
    # The Gaussians lie beside the pictures but are large enough to cover them.
    source = write_model(tmp_path / "m.hyrf", small_model([[-4.8, 3.1, 4.1]], scale_logits=8.0), ring(4))
    with pytest.raises(HyrfError, match=r"^no Gaussian is left: [^\n]*$"):
        export(source, tmp_path / "a.glb", degree=0)
    assert not (tmp_path / "a.glb").exists()


@pytest.mark.parametrize("name", ["file/a.ply", "file/colmap", "file/a.json"])
def test_unwritable_targets_are_refused_before_the_bake(name, plain_file, tmp_path, fail_if_baked):
    (tmp_path / "file").write_text("mine")
    with pytest.raises(HyrfError, match=r"^[^\n]*file[^\n]*$"):
        export(plain_file, tmp_path / name)
    assert [path.name for path in tmp_path.iterdir()] == ["file"] and (tmp_path / "file").read_text() == "mine"


def test_a_folder_with_a_file_suffix_is_refused_before_the_bake(plain_file, tmp_path, fail_if_baked):
    (tmp_path / "a.ply").mkdir()
    with pytest.raises(HyrfError, match=r"a\.ply: this is a folder; name a file in it$"):
        export(plain_file, tmp_path / "a.ply")


@pytest.mark.parametrize(
    ("ending", "module", "package"),
    [
        *((ending, "pxr", '"hyrfpack[usd]"') for ending in (".usda", ".usdc", ".usdz")),
        ("", "pycolmap", '"hyrfpack[poses]"'),
    ],
)
def test_missing_packages_are_reported_before_the_bake(
    ending, module, package, plain_file, tmp_path, fail_if_baked, monkeypatch
):
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(HyrfError, match=rf"pip install {re.escape(package)}'$"):
        export(plain_file, tmp_path / f"a{ending}", colmap=not ending)


@pytest.mark.parametrize("name", ["a.collision.glb", "a.collision.obj"])
def test_a_mesh_that_needs_trimesh_is_refused_before_depths_are_rendered(name, plain_file, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "trimesh", None)
    with pytest.raises(HyrfError, match="pip install trimesh'$"):
        hyrfpack.export_model(plain_file, tmp_path / name)


@pytest.mark.parametrize("failing", ["encode", "decode", "make_background_splats"])
def test_a_failed_export_keeps_the_old_file(failing, sphere_file, tmp_path, monkeypatch):
    def fail(*arguments, **options):
        raise HyrfError("no", fix="none")

    if failing == "make_background_splats":
        monkeypatch.setattr(baked_scene, failing, fail)
    else:
        monkeypatch.setattr(pipeline, "find_file_kind", lambda *target: replace(FORMATS[".ply"], **{failing: fail}))
    (tmp_path / "a.ply").write_bytes(b"old")
    with pytest.raises(HyrfError, match="^no; none$"):
        export(sphere_file, tmp_path / "a.ply", degree=0)
    assert [path.name for path in tmp_path.iterdir()] == ["a.ply"] and (tmp_path / "a.ply").read_bytes() == b"old"


def test_a_full_disk_keeps_the_old_file(plain_file, tmp_path, monkeypatch):
    def fail(*arguments):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("hyrfpack.atomic.os.replace", fail)
    (tmp_path / "a.ply").write_bytes(b"old")
    with pytest.raises(HyrfError, match=r"a\.ply: the disk is full[^\n]*$"):
        export(plain_file, tmp_path / "a.ply", degree=0)
    assert [path.name for path in tmp_path.iterdir()] == ["a.ply"] and (tmp_path / "a.ply").read_bytes() == b"old"


# -- for callers -----------------------------------------------------------------------------------------------------


def test_export_is_a_function_of_the_package(plain_file, tmp_path):
    report = hyrfpack.export_model(plain_file, tmp_path / "a.ply", hyrfpack.ExportConfig(degree=0))
    assert isinstance(report, hyrfpack.ExportReport) and hyrfpack.ExportReport is ExportReport
    assert {"export_model", "ExportReport"} <= set(hyrfpack.__all__)


def test_selecting_all_gaussians_copies_nothing(plain_file):
    splats = bake(load_model(plain_file), [], (0,))[0]
    assert select_splats(splats) is splats


@pytest.mark.parametrize("name", ["scene.json", "new.ply", "new.html", ""])
def test_nothing_is_exported_into_the_scene_folder_that_is_read(tmp_path, name):
    folder = Path(shutil.copytree(GOLDEN_SCENE, tmp_path / "scene"))

    with pytest.raises(HyrfError, match="the output is an input itself|reads what lies in this folder"):
        hyrfpack.export_model(folder, folder / name)
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == {
        path.name: path.read_bytes() for path in GOLDEN_SCENE.iterdir()
    }
