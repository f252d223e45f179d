"""With residuals, a model equals the splats, and files keep what the target PSNR needs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from explicit_balls import TINY_IMPORT_CONFIG, ball_splats
from scenes import ring, small_model
from scipy.spatial.transform import Rotation

from hyrfpack.errors import HyrfError, HyrfSizeError
from hyrfpack.format import describe_file, load_model
from hyrfpack.format.codec import decode_model
from hyrfpack.format.min_file_size import min_file_bytes
from hyrfpack.imports import ImportReport, import_loaded_splats, pack
from hyrfpack.imports.exact_model import exact_model
from hyrfpack.imports.prepare import prepare_model
from hyrfpack.model.residuals import add_shape_residuals
from hyrfpack.model.shape_residuals import compute_shape_residuals
from hyrfpack.render import render_view
from hyrfpack.splats import viewpoints
from hyrfpack.splats.draw import Drawable, draw
from hyrfpack.splats.viewpoints import CANDIDATES_PER_CAMERA

pytestmark = pytest.mark.usefixtures("quick_calibration")


def covariances(scales: np.ndarray, quats: np.ndarray) -> np.ndarray:
    axes = Rotation.from_quat(np.roll(quats, -1, axis=1)).as_matrix() * scales[:, None]  # scipy puts w last
    return axes @ axes.transpose(0, 2, 1)


def test_shape_residuals_give_any_gaussian_its_covariance_whatever_the_field_predicts() -> None:
    rng = np.random.default_rng(0)
    scales, quats = np.exp(rng.uniform(-7, -0.2, (500, 3))), rng.normal(size=(500, 4))
    quats[:3] = [(1, 0, 0, 0), (0, 1, 0, 0), (0.5, 0.5, 0.5, 0.5)]
    raw = torch.from_numpy(rng.normal(size=(500, 8)))
    sizes = torch.from_numpy(np.log(scales / (1 - scales)))  # scale_bounds are 1

    residuals, explicit = compute_shape_residuals(raw, sizes, torch.from_numpy(quats))

    outputs = add_shape_residuals(raw, residuals).numpy()
    found_scales = 1 / (1 + np.exp(-(outputs[:, 1:4] + explicit.numpy())))
    found = covariances(found_scales, outputs[:, 4:] + (1, 0, 0, 0))
    expected = covariances(scales, quats)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12 * np.abs(expected).max())
    # The nearest of the 24 equivalent rotations is at most 62.8 degrees away, so |(x, y, z)| <= tan(31.4 degrees).
    assert np.linalg.norm(residuals.numpy()[:, 2:], axis=1).max() <= np.tan(np.radians(31.4))


@pytest.mark.parametrize("degree", [0, 3])
def test_an_exact_model_renders_the_splats(degree: int) -> None:
    splats = ball_splats(150, degree=degree)
    drawable = Drawable.from_splats(splats, small_model(splats.positions).config.frame)
    model = exact_model(drawable)
    with torch.no_grad():
        for camera in ring(3):
            difference = render_view(model, camera).rgb.clamp(0, 1) - draw(drawable, camera).rgb.clamp(0, 1)
            assert -10 * difference.square().mean().log10() > 60


@pytest.mark.acceptance
def test_an_import_stores_what_the_target_needs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pack, "MAX_TRIALS", 6)
    monkeypatch.setattr(viewpoints, "CANDIDATES_PER_CAMERA", CANDIDATES_PER_CAMERA)  # the worst views count here
    splats = ball_splats(200)

    def import_them(**settings: float) -> ImportReport:
        return import_loaded_splats(splats, tmp_path / "x.hyrf", replace(TINY_IMPORT_CONFIG, **settings))

    small, large = (import_them(psnr=psnr) for psnr in (38, 50))
    assert small.psnr_unpacked > 55 and small.psnr > 36 and large.psnr > 47  # of 2 views
    # `compress` takes its default error from this number, which is not that of the model before compression.
    assert describe_file(tmp_path / "x.hyrf")["provenance"]["psnr"] == pytest.approx(large.psnr, abs=0.006)
    assert large.bytes_after > 1.2 * small.bytes_after  # metadata takes half of these
    limit = (small.bytes_after + large.bytes_after) // 2
    filled = import_them(target_bytes=limit)
    assert 0.9 * limit < filled.bytes_after <= limit and small.psnr < filled.psnr < large.psnr
    assert filled.psnr_asked is None
    least = min_file_bytes()
    with pytest.raises(HyrfSizeError, match=f"does not fit into {least:,} bytes.*use a `target_bytes` of at least "):
        import_them(target_bytes=least)
    model, description = load_model(tmp_path / "x.hyrf"), describe_file(tmp_path / "x.hyrf")
    assert model.config.residual_degree == splats.degree and description["version"] == "1.6"
    for residuals in (model.gaussians.shape_residuals, model.gaussians.color_residuals):
        assert residuals is not None and residuals.any()


def test_a_size_that_no_file_has_is_refused_before_the_work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hyrfpack.imports.run.prepare_model", None)
    with pytest.raises(HyrfError, match="100 bytes is below the smallest possible file, about .* did you mean 100kB"):
        import_loaded_splats(ball_splats(20), tmp_path / "x.hyrf", replace(TINY_IMPORT_CONFIG, target_bytes=100))


@pytest.mark.acceptance
def test_the_worst_validation_view_reaches_its_target(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pack, "MAX_TRIALS", 6)
    prepared = prepare_model(ball_splats(200), TINY_IMPORT_CONFIG)

    loose, strict = (decode_model(pack.pack(prepared, 20.0, {}, worst=worst)) for worst in (None, 48.0))

    assert min(prepared.validation.psnr_per_view(loose)) < 48 <= min(prepared.validation.psnr_per_view(strict))
