"""Packing a model beside which photos' exposures were learnt: one exposure is kept, and so is the exposure map."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from exposures import map_with_gains
from scenes import alternating_gains, ball_scene, expose_picture, exposed_scene, view_of

from hyrfpack.cameras.capture import has_mean_exposure
from hyrfpack.compress import compress_model, packer
from hyrfpack.compress.finetune import fit_residual_gains
from hyrfpack.evaluate import evaluate_model
from hyrfpack.evaluate.exposure import fit_gains
from hyrfpack.format import describe_file, load_model, save_model
from hyrfpack.format.codec import load_with_provenance
from hyrfpack.render import RenderSettings, render_view
from hyrfpack.scene import Scene, View
from hyrfpack.train import TrainConfig, train_model

GAINS = alternating_gains(8, stops=1.0)
MEAN = np.exp(np.log(GAINS).mean())


@pytest.fixture(scope="module")
def scene() -> Scene:
    return exposed_scene(GAINS, side=32)


@pytest.fixture(scope="module")
def truth() -> list[View]:
    """What photos of the mean exposure would show."""
    return [view_of(v.name, v.camera, expose_picture(v.load(), MEAN)) for v in ball_scene(len(GAINS), 300).train]


@pytest.fixture(scope="module")
def trained(scene, tmp_path_factory) -> Path:
    """A model of the mean exposure without an exposure map, as earlier versions wrote it."""
    folder = tmp_path_factory.mktemp("trained")
    config = TrainConfig(steps=150, max_gaussians=300, exposure=True)
    model, provenance = load_with_provenance(train_model(scene, folder / "run", config, quiet=True).model)
    model.exposure = None
    save_model(model, folder / "model.hyrf", provenance={**provenance, "mean_exposure": True})
    return folder / "model.hyrf"


@pytest.fixture(scope="module")
def unaware(trained, tmp_path_factory) -> Path:
    """The same model in a file that does not tell of exposures, as older ones do not."""
    model, provenance = load_with_provenance(trained)
    del provenance["mean_exposure"]
    path = tmp_path_factory.mktemp("unaware") / "model.hyrf"
    save_model(model, path, provenance=provenance)
    return path


def with_map(source: Path, scene: Scene, gains: np.ndarray, path: Path) -> Path:
    """A model in a file with a map of these gains of the training photos."""
    model, provenance = load_with_provenance(source)
    model.exposure = map_with_gains([view.camera for view in scene.train], model.config.frame, gains)
    save_model(model, path, provenance=provenance)
    return path


@pytest.fixture(scope="module")
def mapped(trained, scene, tmp_path_factory) -> Path:
    """The same model with a map of the photos' gains."""
    return with_map(trained, scene, GAINS / MEAN, tmp_path_factory.mktemp("mapped") / "model.hyrf")


def drift(before: Path, after: Path, scene: Scene) -> float:
    """The mean log gain by which renders at one exposure of one file differ from those of another."""
    models, settings = (load_model(before), load_model(after)), RenderSettings(exposure="consistent")
    pairs = [[render_view(model, view.camera, settings).rgb for model in models] for view in scene.train]
    return float(np.mean([np.log(fit_gains(*pair)) for pair in pairs]))


def test_without_a_map_gains_are_those_of_the_photos_about_the_mean_exposure(trained, scene):
    gains = np.array([gains.numpy() for gains in fit_residual_gains(load_model(trained), scene.train).values()])
    np.testing.assert_allclose(np.log(gains).mean(0), 0, atol=0.05)
    np.testing.assert_allclose(np.log(gains).mean(1), np.log(GAINS / MEAN)[:, 0], atol=0.15)


def test_with_a_map_gains_are_what_the_map_leaves_of_each_photo(trained, scene, tmp_path):
    half = with_map(trained, scene, np.sqrt(GAINS / MEAN), tmp_path / "half.hyrf")
    gains = np.array([gains.numpy() for gains in fit_residual_gains(load_model(half), scene.train).values()])
    np.testing.assert_allclose(np.log(gains).mean(1), np.log(GAINS / MEAN)[:, 0] / 2, atol=0.15)


def test_fine_tuning_keeps_the_mean_exposure_and_the_file_says_so(trained, unaware, scene, truth, tmp_path):
    scores, told = [], []
    for source in (trained, unaware):
        compress_model(source, tmp_path / "small.hyrf", data=scene, finetune_steps=160)
        scores.append(evaluate_model(load_model(tmp_path / "small.hyrf"), truth).psnr)
        told.append(has_mean_exposure(describe_file(tmp_path / "small.hyrf")["provenance"]))

    assert told == [True, False]
    assert scores[0] > scores[1] + 1


def test_fine_tuning_keeps_the_map_and_the_consistent_exposure_and_fits_renders_to_the_photos(mapped, scene, tmp_path):
    compress_model(mapped, tmp_path / "coarse.hyrf", data=scene, distortion=2e-4)
    compress_model(mapped, tmp_path / "fitted.hyrf", data=scene, distortion=2e-4, finetune_steps=160)

    tuned = load_model(tmp_path / "fitted.hyrf")
    for name, values in vars(load_model(mapped).exposure).items():
        np.testing.assert_array_equal(getattr(tuned.exposure, name), values)
    assert abs(drift(mapped, tmp_path / "fitted.hyrf", scene)) < 0.03
    scores = evaluate_model(tuned, scene.train)
    assert scores.psnr > evaluate_model(load_model(tmp_path / "coarse.hyrf"), scene.train).psnr + 0.3
    assert scores.psnr > scores.psnr_consistent + 1


def test_fine_tuning_does_not_bake_what_a_map_has_wrong_into_the_consistent_exposure(trained, scene, tmp_path):
    source = with_map(trained, scene, 1.5 * GAINS / MEAN, tmp_path / "light.hyrf")
    compress_model(source, tmp_path / "fitted.hyrf", data=scene, finetune_steps=160)
    assert abs(drift(source, tmp_path / "fitted.hyrf", scene)) < 0.03  # of log 1.5 = 0.41 that the map is off by


def test_gains_are_fitted_once_for_all_files_of_a_search_and_only_where_exposures_were_learnt(
    trained, unaware, scene, tmp_path, monkeypatch
):
    fitted = []
    monkeypatch.setattr(packer, "fit_residual_gains", lambda *of: fitted.append(of) or fit_residual_gains(*of))
    mapped = with_map(unaware, scene, GAINS / MEAN, tmp_path / "mapped.hyrf")
    for source, calls in ((unaware, 0), (trained, 1), (mapped, 2)):
        compress_model(source, tmp_path / "small.hyrf", data=scene, finetune_steps=1, target_bytes=12_000)
        assert len(fitted) == calls


def test_a_limit_on_the_loss_is_on_the_psnr_of_what_render_shows(mapped, scene, tmp_path):
    report = compress_model(mapped, tmp_path / "small.hyrf", data=scene, max_psnr_drop=0.5)

    before, after = (evaluate_model(load_model(path), scene.train) for path in (mapped, tmp_path / "small.hyrf"))
    lost = before.psnr - after.psnr
    assert lost == pytest.approx(float(re.search(r"loses (\S+) of", report.found)[1]), abs=6e-4)
    assert lost <= 0.5 and abs(lost - (before.psnr_consistent - after.psnr_consistent)) > 1e-3
