"""The degree of harmonics is chosen for each scene, by other cameras than those that measure the result."""

from __future__ import annotations

import numpy as np
import pytest
from scenes import ring, small_model

from hyrfpack.cameras.capture import provenance_cameras
from hyrfpack.cameras.paths import Viewpoint
from hyrfpack.config.export import ExportConfig
from hyrfpack.export import baked_scene, export_model
from hyrfpack.export import degree as degrees
from hyrfpack.export.bake import compute_visibility
from hyrfpack.export.degree import choose_degree, choose_lowest_degree
from hyrfpack.export.source import Source
from hyrfpack.format import save_model
from hyrfpack.splats.files import read_splats

GAUSSIAN_POSITIONS = [[0.1, 0.2, 0.3], [-0.4, 0.1, 0.0], [0.2, -0.5, 0.1], [0.0, 0.4, -0.3]]


def write_model(path, fields: float, cameras):
    """Write a model whose colours depend on the direction unless `fields` is 0."""
    model = small_model(GAUSSIAN_POSITIONS, fields=fields, direction_encoding="sh")
    save_model(
        model,
        path,
        provenance={"cameras": provenance_cameras(cameras), "viewpoint": Viewpoint.from_cameras(cameras).to_json()},
    )
    return path


def test_direction_independent_colors_get_degree_0(tmp_path):
    source = write_model(tmp_path / "m.hyrf", 0.0, ring(20))
    report = export_model(source, tmp_path / "a.spz")
    assert report.degree == read_splats(tmp_path / "a.spz").degree == 0
    assert list(report.chosen_by) == [0, 1, 2, 3]


def test_direction_dependent_colors_get_a_higher_degree_and_the_reason_is_reported(tmp_path, caplog):
    source = write_model(tmp_path / "m.hyrf", 4.0, ring(40))
    report = export_model(source, tmp_path / "a.ply")
    assert report.degree >= 2 and report.degree == choose_lowest_degree(report.chosen_by)
    reason = f"chosen degree {report.degree}: {', '.join(f'{score:.2f}' for score in report.chosen_by.values())} dB"
    assert any(sentence.startswith(reason) for sentence in caplog.messages)


def test_a_given_degree_is_not_compared_with_others(tmp_path, monkeypatch):
    monkeypatch.setattr(baked_scene, "choose_degree", lambda *arguments: pytest.fail("it was chosen"))
    source = write_model(tmp_path / "m.hyrf", 0.0, ring(20))
    assert (
        export_model(source, tmp_path / "a.ply", ExportConfig(degree=2)).degree,
        export_model(source, tmp_path / "a.splat").degree,
    ) == (2, 0)
    with pytest.raises(ValueError, match="degree is 4"):
        ExportConfig(degree=4)


@pytest.mark.parametrize(("scores", "lowest"), [
    ([40.0, 40.1, 40.15, 40.2], 0),
    ([30.0, 43.56, 43.0, 42.05], 1),
    ([30.0, 35.0, 36.0, 36.19], 2),
    ([30.0, 31.0, 32.0, 33.0], 3),
    ([40.0], 0),
])  # fmt: skip
def test_the_lowest_degree_within_the_tolerance_is_chosen(scores, lowest):
    assert choose_lowest_degree(dict(enumerate(scores))) == lowest


@pytest.mark.parametrize("count", [4, 16, 60])
def test_the_degree_is_chosen_by_held_out_cameras_other_than_the_measured_ones(count, tmp_path, monkeypatch):
    fitted, judged = [], []

    def recording_bake(model, cameras, *others):
        fitted.extend(camera.position.tobytes() for camera in cameras)
        return bake(model, cameras, *others)

    def recording_measure_psnr(model, contenders, views, **options):
        judged.extend(camera.position.tobytes() for camera, _ in views)
        return measure_psnr(model, contenders, views, **options)

    bake, measure_psnr = degrees.bake_parts, degrees.measure_psnr
    monkeypatch.setattr(degrees, "bake_parts", recording_bake)
    monkeypatch.setattr(degrees, "measure_psnr", recording_measure_psnr)
    source = Source.read(write_model(tmp_path / "m.hyrf", 1.0, ring(count)))
    choose_degree(source.model, source.fit_cameras, 3)
    allowed = {camera.position.tobytes() for camera in source.fit_cameras}
    measured = {camera.position.tobytes() for camera, _ in source.measured_views}
    assert judged and set(fitted) | set(judged) == allowed
    if count >= 16:
        assert not measured & (set(fitted) | set(judged))
    if len(source.fit_cameras) >= 16:
        assert not set(fitted) & set(judged)


def test_the_degree_of_many_gaussians_is_chosen_by_a_sample(monkeypatch):
    counts = []

    def recording_bake(model, *others):
        counts.append(len(model))
        return bake(model, *others)

    bake = degrees.bake_parts
    monkeypatch.setattr(degrees, "bake_parts", recording_bake)
    positions = np.random.default_rng(0).uniform(-0.6, 0.6, (200, 3))
    model, cameras = small_model(positions, fields=4.0, direction_encoding="sh"), ring(40)
    whole = choose_degree(model, cameras, 3)
    monkeypatch.setattr(degrees, "MAX_GAUSSIANS", 60)
    some = choose_degree(model, cameras, 3, [compute_visibility(model, cameras)])
    assert counts == [200, 50] and some[0] == whole[0] and some[1] != whole[1]


def test_a_crop_gets_the_degree_of_the_whole_scene(tmp_path):
    source = write_model(tmp_path / "m.hyrf", 4.0, ring(40))
    whole, part = (
        export_model(source, tmp_path / "a.ply"),
        export_model(source, tmp_path / "b.ply", ExportConfig(crop=(-9, -9, -9, -0.1, 9, 9))),
    )
    assert part.degree == whole.degree and part.gaussians == 1 and part.chosen_by == whole.chosen_by
