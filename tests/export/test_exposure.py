"""Exported splats of a model with an exposure map look as photographed, or have one exposure on request."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scenes import ball_scene, camera_at, photograph, ring, small_model, view_of

import hyrfpack
from hyrfpack.cameras.capture import provenance_cameras
from hyrfpack.cameras.paths import Viewpoint
from hyrfpack.errors import HyrfError
from hyrfpack.export import exposure as export_exposure
from hyrfpack.export.background import BackgroundGains, make_background_splats, render_background_picture
from hyrfpack.export.bake import bake
from hyrfpack.export.exposure import SMOOTHING_NEIGHBORS, smooth_log_gains
from hyrfpack.export.poster import render_model_poster
from hyrfpack.format import load_model, save_model
from hyrfpack.model.exposure import ExposureMap
from hyrfpack.ops.harmonics import harmonics_basis
from hyrfpack.render import RenderSettings, render_view
from hyrfpack.splats.files import read_splats
from hyrfpack.splats.harmonics import SH_C0

RANDOM_GENERATOR = np.random.default_rng(0)
LEFT_POSITIONS, RIGHT_POSITIONS = (RANDOM_GENERATOR.uniform(-0.1, 0.1, (20, 3)) + (side, 0, 0) for side in (-0.6, 0.6))
# Each camera sees only one half of the Gaussians and one half of the background.
LEFT_CAMERA = camera_at((-0.6, -1.5, 0), (-0.6, 0, 0), focal=64)
RIGHT_CAMERA = camera_at((0.6, 1.5, 0), (0.6, 0, 0), focal=64)
LOG_GAINS = np.array([1.0, 0.8, 0.6])


def map_with_log_gains(places, log_gains, spread=0.05) -> ExposureMap:
    """Return a map with log gains (M, 3) at viewpoints (M, 3) that fall to zero far from all of them."""
    places, log_gains = np.asarray(places, np.float64), np.asarray(log_gains, np.float64)
    box = np.stack((places.min(0), places.max(0))).astype(np.float32)
    extent = np.maximum(box[1] - box[0], 1e-6)
    return ExposureMap(
        box=box,
        lengths=np.array([spread, 100.0], np.float32),
        mean=np.zeros(3, np.float32),
        limits=np.array([[-3] * 3, [3] * 3], np.float32),
        steps=np.full(3, 1e-3, np.float32),
        positions=np.round(255 * (places - box[0]) / extent).astype(np.uint8),
        directions=np.zeros((len(places), 3), np.int8),
        weights=np.round(1000 * log_gains).astype(np.int16),
    )


def gains_at(model, camera) -> np.ndarray:
    return model.exposure.predict_gains(model.config.frame.local_pose(camera))


def model_with_bright_half(positions=None, **options):
    """Return grey Gaussians; those at the right are photographed bright, the others dark."""
    model = small_model(
        np.concatenate((LEFT_POSITIONS, RIGHT_POSITIONS)) if positions is None else positions, **options
    )
    model.exposure = map_with_log_gains([LEFT_CAMERA.position, RIGHT_CAMERA.position], [-LOG_GAINS, LOG_GAINS])
    return model


def exposed_grey(gains: np.ndarray) -> np.ndarray:
    """Return the colour 0.5, whose odds are 1, after multiplication of the odds by these gains."""
    return gains / (1 + gains)


def base_colors(splats) -> np.ndarray:
    return 0.5 + SH_C0 * splats.harmonics[:, 0]


def write_model(path, model, cameras):
    save_model(
        model,
        path,
        provenance={"cameras": provenance_cameras(cameras), "viewpoint": Viewpoint.from_cameras(cameras).to_json()},
    )
    return path


@pytest.fixture
def bright_half_file(tmp_path):
    """Write the file of a `model_with_bright_half` that has a background sphere."""
    return write_model(
        tmp_path / "model.hyrf", model_with_bright_half(fields=1.0, background=True), [LEFT_CAMERA, RIGHT_CAMERA]
    )


# -- colours of Gaussians --------------------------------------------------------------------------------------------


def test_splats_have_the_exposure_of_the_photos_that_see_them():
    model, cameras = model_with_bright_half(), [LEFT_CAMERA, RIGHT_CAMERA]
    colors = base_colors(bake(model, cameras, (0,))[0])
    left, right = (exposed_grey(gains_at(model, camera)) for camera in cameras)
    assert np.allclose(colors[:20], left, atol=1e-4) and np.allclose(colors[20:], right, atol=1e-4)
    assert (left < 0.4).all() and (right > 0.6).all()


def test_each_direction_has_the_exposure_of_the_camera_with_that_view():
    cameras = ring(2, elevation=0.0)
    model = small_model([(0, y, 0) for y in (-0.6, -0.3, 0, 0.3, 0.6)])  # no Gaussian hides another
    model.exposure = map_with_log_gains([camera.position for camera in cameras], [LOG_GAINS, -LOG_GAINS])
    splats = bake(model, cameras, (1,))[1]
    for camera in cameras:
        directions = torch.nn.functional.normalize(torch.from_numpy(splats.positions - camera.position), dim=1).float()
        seen = 0.5 + torch.einsum("nk,nkc->nc", harmonics_basis(directions, 1), torch.from_numpy(splats.harmonics))
        assert np.allclose(seen, exposed_grey(gains_at(model, camera)), atol=0.01)


def test_a_gaussian_that_no_camera_sees_has_the_exposure_of_its_neighbours():
    model = model_with_bright_half(np.concatenate((LEFT_POSITIONS, RIGHT_POSITIONS, [[4.0, 0.0, 0.0]])))
    color = base_colors(bake(model, [LEFT_CAMERA, RIGHT_CAMERA], (0,))[0])[-1]
    assert np.allclose(color, exposed_grey(gains_at(model, RIGHT_CAMERA)), atol=1e-4)


def test_if_no_camera_sees_a_gaussian_all_have_the_mean_exposure_of_the_cameras():
    model = model_with_bright_half()
    away = [camera_at(c.position, c.position * (1, 9, 1)) for c in (LEFT_CAMERA, RIGHT_CAMERA)]
    mean = np.mean([np.log(gains_at(model, camera)) for camera in away], axis=0)
    assert np.allclose(base_colors(bake(model, away, (0,))[0]), exposed_grey(np.exp(mean)), atol=1e-4)


def test_without_cameras_all_have_the_clipped_mean_exposure_of_the_map():
    model = model_with_bright_half()
    mean, limits = np.array([0.2, -0.4, 3.0], np.float32), np.array([[-1] * 3, [1] * 3], np.float32)
    model.exposure = replace(model.exposure, mean=mean, limits=limits)
    assert np.allclose(base_colors(bake(model, [], (0,))[0]), exposed_grey(np.exp([0.2, -0.4, 1.0])), atol=1e-4)


def test_smoothing_is_the_weighted_mean_over_the_nearest_seen_gaussians(monkeypatch):
    monkeypatch.setattr(export_exposure, "GAUSSIANS_PER_TASK", 64)
    positions, light = (
        RANDOM_GENERATOR.normal(size=(200, 3)),
        RANDOM_GENERATOR.uniform(size=200) * (RANDOM_GENERATOR.uniform(size=200) > 0.5),
    )
    logs = RANDOM_GENERATOR.normal(size=(200, 3))
    smooth = smooth_log_gains(positions, light, light[:, None] * logs, np.zeros(3))
    distances = np.where(light > 0, np.linalg.norm(positions[:, None] - positions, axis=2), np.inf)
    nearest = np.argsort(distances, axis=1)[:, :SMOOTHING_NEIGHBORS]
    expected = [np.average(logs[some], axis=0, weights=light[some]) for some in nearest]
    assert np.allclose(smooth, expected)


def test_a_single_seen_gaussian_determines_the_exposure_of_all():
    smooth = smooth_log_gains(
        RANDOM_GENERATOR.normal(size=(3, 3)), np.eye(3)[1], 2.0 * np.eye(3)[[0, 1, 2]], np.zeros(3)
    )
    assert np.allclose(smooth, [[0, 2, 0]] * 3)


# -- the background --------------------------------------------------------------------------------------------------


def sky_between(ahead, behind):
    """Return a model with a grey background, and cameras with different log gains that look along -y and +y."""
    cameras = [camera_at((0, -0.1, 0), (0, -1, 0)), camera_at((0, 0.1, 0), (0, 1, 0))]
    model = small_model([[0.0, 0.0, 0.5]], background=True)
    model.exposure = map_with_log_gains([camera.position for camera in cameras], [behind, ahead])
    return model, cameras


def test_the_background_has_the_exposure_of_the_cameras_that_see_it():
    model, cameras = sky_between(LOG_GAINS, -LOG_GAINS)
    splats, view_directions = make_background_splats(model, cameras), [(0, -1, 0), (0, 1, 0)]
    directions = splats.positions / np.linalg.norm(splats.positions, axis=1, keepdims=True)
    picture = render_background_picture(model, 64, cameras)
    looked_at = {(0, -1, 0): picture[0, 0], (0, 1, 0): picture[-1, 0]}  # the top row looks along -y
    for camera, direction in zip(cameras, view_directions, strict=True):
        expected = exposed_grey(gains_at(model, camera))
        assert np.allclose(base_colors(splats)[(directions @ direction).argmax()], expected, atol=0.01)
        assert np.allclose(looked_at[direction], expected, atol=0.01)


def test_unseen_background_has_finite_gains_within_the_range_of_seen_ones():
    model, cameras = sky_between(LOG_GAINS, -LOG_GAINS)
    gains = BackgroundGains.predict(model, cameras).evaluate(torch.eye(3)).log().numpy()
    assert np.isfinite(gains).all() and (np.abs(gains) <= LOG_GAINS + 1e-3).all()


def test_without_cameras_the_background_has_the_mean_exposure_of_the_map():
    model = small_model([[0.0, 0.0, 0.5]], background=True)
    model.exposure = replace(map_with_log_gains([[0, 0, 0]], [[0, 0, 0]]), mean=LOG_GAINS.astype(np.float32))
    assert np.allclose(BackgroundGains.predict(model, []).evaluate(torch.eye(3)).log(), LOG_GAINS, atol=1e-5)


# -- files -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("ending", [".ply", pytest.param(".splat", marks=pytest.mark.acceptance), ".html"])
def test_an_identity_map_does_not_change_the_file(ending, tmp_path):
    plain = small_model(np.concatenate((LEFT_POSITIONS, RIGHT_POSITIONS)), fields=1.0, background=True)
    mapped = small_model(np.concatenate((LEFT_POSITIONS, RIGHT_POSITIONS)), fields=1.0, background=True)
    mapped.exposure = map_with_log_gains([LEFT_CAMERA.position], [[0, 0, 0]])
    files = []
    for name, model in (("plain", plain), ("mapped", mapped)):
        source = write_model(tmp_path / f"{name}.hyrf", model, [LEFT_CAMERA, RIGHT_CAMERA])
        target = tmp_path / name / f"out{ending}"
        target.parent.mkdir()
        hyrfpack.export_model(source, target, hyrfpack.ExportConfig(baked=ending == ".html"))
        files.append(target.read_bytes())
    assert files[0] == files[1]


def test_consistent_splats_equal_those_of_the_model_without_its_map(bright_half_file, tmp_path):
    plain = load_model(bright_half_file)
    plain.exposure = None
    bare = write_model(tmp_path / "plain.hyrf", plain, [LEFT_CAMERA, RIGHT_CAMERA])
    hyrfpack.export_model(bare, tmp_path / "plain.ply")
    hyrfpack.export_model(bright_half_file, tmp_path / "consistent.ply", hyrfpack.ExportConfig(exposure="consistent"))
    hyrfpack.export_model(bright_half_file, tmp_path / "local.ply")
    files = [(tmp_path / f"{name}.ply").read_bytes() for name in ("plain", "consistent", "local")]
    assert files[0] == files[1] != files[2]


@pytest.mark.parametrize("ending", [".ply", ".html"])
def test_the_report_contains_the_loss_at_both_exposures(ending, bright_half_file, tmp_path):
    reports = [
        hyrfpack.export_model(
            bright_half_file,
            tmp_path / f"{exposure_name}{ending}",
            hyrfpack.ExportConfig(exposure=exposure_name, degree=1, baked=ending == ".html"),
        )
        for exposure_name in ("local", "consistent")
    ]
    local, consistent = reports
    assert (local.exposure, consistent.exposure) == ("local", "consistent")
    assert local.psnr_by_exposure == pytest.approx(consistent.psnr_by_exposure)
    assert list(local.psnr_by_exposure) == ["local", "consistent"] and local.photos_by_exposure == {}
    assert local.psnr_by_exposure["local"] > local.psnr_by_exposure["consistent"] + 3
    # Each file is compared with the model's pictures at the same exposure.
    assert local.psnr_baked == local.psnr_by_exposure["local"]
    assert consistent.psnr > consistent.psnr_by_exposure["consistent"] + 3


def test_both_exposures_are_measured_on_photos(bright_half_file, tmp_path):
    left, right = (view_of("0.png", camera, photograph(camera)) for camera in (LEFT_CAMERA, RIGHT_CAMERA))
    report = hyrfpack.export_model(
        bright_half_file,
        tmp_path / "a.ply",
        hyrfpack.ExportConfig(degree=0),
        data=replace(ball_scene(2), train=[right], test=[left]),
    )
    assert list(report.photos_by_exposure) == ["local", "consistent"]
    assert report.photos_by_exposure["local"] == pytest.approx(report.photos_file, abs=0.01)


def test_a_model_without_a_map_reports_no_exposure(tmp_path):
    source = write_model(tmp_path / "plain.hyrf", small_model(LEFT_POSITIONS), [LEFT_CAMERA])
    report = hyrfpack.export_model(source, tmp_path / "a.ply", hyrfpack.ExportConfig(degree=0))
    assert (report.exposure, report.psnr_by_exposure, report.photos_by_exposure) == (None, {}, {})


@pytest.mark.acceptance
@pytest.mark.usefixtures("quick_scores")
def test_a_file_without_cameras_gets_finite_splats(tmp_path):
    save_model(model_with_bright_half(), tmp_path / "bare.hyrf")
    report = hyrfpack.export_model(tmp_path / "bare.hyrf", tmp_path / "a.ply")
    assert np.isfinite(read_splats(tmp_path / "a.ply").harmonics).all() and report.exposure == "local"


@pytest.mark.parametrize("target", ["page.html", "player"])
def test_pages_with_the_model_itself_refuse_another_exposure(target, bright_half_file, tmp_path):
    with pytest.raises(HyrfError, match="exposure='consistent'"):
        hyrfpack.export_model(bright_half_file, tmp_path / target, hyrfpack.ExportConfig(exposure="consistent"))
    assert not (tmp_path / target).exists()


def test_an_unknown_exposure_is_refused(bright_half_file, tmp_path):
    with pytest.raises(ValueError, match="local"):
        hyrfpack.export_model(bright_half_file, tmp_path / "a.ply", hyrfpack.ExportConfig(exposure="mean"))


def test_posters_show_the_scene_as_photographed():
    model = model_with_bright_half()
    poster = np.asarray(render_model_poster(model, RIGHT_CAMERA, 32)) / 255
    with torch.no_grad():
        own, consistent = (
            render_view(model, RIGHT_CAMERA, RenderSettings(exposure=exposure_name)).rgb.numpy()
            for exposure_name in ("as-photographed", "consistent")
        )
    assert np.abs(poster - own).max() < 0.01 < np.abs(poster - consistent).max()
