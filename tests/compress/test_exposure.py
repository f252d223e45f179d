"""Packing the golden model that was trained with exposure compensation keeps its mean exposure and its exposure map."""

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
from hyrfpack.config.compress import CompressConfig
from hyrfpack.evaluate import evaluate_model
from hyrfpack.evaluate.exposure import fit_gains
from hyrfpack.format import describe_file, load_model, save_model
from hyrfpack.format.codec import load_with_provenance
from hyrfpack.render import RenderSettings, render_view
from hyrfpack.scene import Scene, View
from tools.safety.train_golden import EXPOSED_MODEL_FILE

pytestmark = pytest.mark.usefixtures("quick_calibration")
PHOTO_GAINS = alternating_gains(8, stops=1.0)
FINETUNE_STEPS = 64
MEAN_GAIN = np.exp(np.log(PHOTO_GAINS).mean())


@pytest.fixture(scope="module")
def scene() -> Scene:
    return exposed_scene(PHOTO_GAINS, side=32)


@pytest.fixture(scope="module")
def mean_exposure_views() -> list[View]:
    """Return the photos as they would be at the mean exposure."""
    return [
        view_of(v.name, v.camera, expose_picture(v.load(), MEAN_GAIN)) for v in ball_scene(len(PHOTO_GAINS), 300).train
    ]


@pytest.fixture(scope="module")
def model_file(tmp_path_factory) -> Path:
    """Write the golden model, which is at the mean exposure, without its map, as earlier versions did."""
    model, provenance = load_with_provenance(EXPOSED_MODEL_FILE)
    model.exposure = None
    path = tmp_path_factory.mktemp("mean") / "model.hyrf"
    save_model(model, path, provenance={**provenance, "mean_exposure": True})
    return path


@pytest.fixture(scope="module")
def file_without_exposure_note(model_file, tmp_path_factory) -> Path:
    """Write the same model without the note on exposures, as older versions did."""
    model, provenance = load_with_provenance(model_file)
    del provenance["mean_exposure"]
    path = tmp_path_factory.mktemp("unaware") / "model.hyrf"
    save_model(model, path, provenance=provenance)
    return path


def write_model_with_map(source: Path, scene: Scene, gains: np.ndarray, path: Path) -> Path:
    """Write the model with a map of these gains of the training photos."""
    model, provenance = load_with_provenance(source)
    model.exposure = map_with_gains([view.camera for view in scene.train], model.config.frame, gains)
    save_model(model, path, provenance=provenance)
    return path


@pytest.fixture(scope="module")
def file_with_map(model_file, scene, tmp_path_factory) -> Path:
    """Write the same model with a map of the photos' gains."""
    return write_model_with_map(
        model_file, scene, PHOTO_GAINS / MEAN_GAIN, tmp_path_factory.mktemp("mapped") / "model.hyrf"
    )


def mean_log_gain_between(before: Path, after: Path, scene: Scene) -> float:
    """Return the mean log gain between renders of two files at the consistent exposure."""
    models, settings = (load_model(before), load_model(after)), RenderSettings(exposure="consistent")
    pairs = [[render_view(model, view.camera, settings).rgb for model in models] for view in scene.train]
    return float(np.mean([np.log(fit_gains(*pair)) for pair in pairs]))


def test_without_a_map_fitted_gains_are_relative_to_the_mean_exposure(model_file, scene):
    gains = np.array([gains.numpy() for gains in fit_residual_gains(load_model(model_file), scene.train).values()])
    np.testing.assert_allclose(np.log(gains).mean(0), 0, atol=0.05)
    np.testing.assert_allclose(np.log(gains).mean(1), np.log(PHOTO_GAINS / MEAN_GAIN)[:, 0], atol=0.15)


def test_with_a_map_fitted_gains_are_relative_to_the_map(model_file, scene, tmp_path):
    half = write_model_with_map(model_file, scene, np.sqrt(PHOTO_GAINS / MEAN_GAIN), tmp_path / "half.hyrf")
    gains = np.array([gains.numpy() for gains in fit_residual_gains(load_model(half), scene.train).values()])
    np.testing.assert_allclose(np.log(gains).mean(1), np.log(PHOTO_GAINS / MEAN_GAIN)[:, 0] / 2, atol=0.15)


@pytest.mark.acceptance
def test_finetuning_keeps_the_mean_exposure_and_its_note_in_the_file(
    model_file, file_without_exposure_note, scene, mean_exposure_views, tmp_path
):
    scores, notes_found = [], []
    for source in (model_file, file_without_exposure_note):
        compress_model(source, tmp_path / "small.hyrf", CompressConfig(finetune_steps=FINETUNE_STEPS), data=scene)
        scores.append(evaluate_model(load_model(tmp_path / "small.hyrf"), mean_exposure_views).psnr)
        notes_found.append(has_mean_exposure(describe_file(tmp_path / "small.hyrf")["provenance"]))

    assert notes_found == [True, False]
    assert scores[0] > scores[1] + 1


@pytest.mark.acceptance
def test_finetuning_keeps_the_map_and_the_consistent_exposure_and_improves_the_fit(file_with_map, scene, tmp_path):
    compress_model(file_with_map, tmp_path / "coarse.hyrf", CompressConfig(distortion=2e-4), data=scene)
    compress_model(
        file_with_map,
        tmp_path / "fitted.hyrf",
        CompressConfig(distortion=2e-4, finetune_steps=FINETUNE_STEPS),
        data=scene,
    )

    tuned = load_model(tmp_path / "fitted.hyrf")
    for name, values in vars(load_model(file_with_map).exposure).items():
        np.testing.assert_array_equal(getattr(tuned.exposure, name), values)
    assert abs(mean_log_gain_between(file_with_map, tmp_path / "fitted.hyrf", scene)) < 0.03
    scores = evaluate_model(tuned, scene.train)
    assert scores.psnr > evaluate_model(load_model(tmp_path / "coarse.hyrf"), scene.train).psnr + 0.3
    assert scores.psnr > scores.psnr_consistent + 1


@pytest.mark.acceptance
def test_finetuning_does_not_compensate_errors_of_the_map(model_file, scene, tmp_path):
    source = write_model_with_map(model_file, scene, 1.5 * PHOTO_GAINS / MEAN_GAIN, tmp_path / "light.hyrf")
    compress_model(source, tmp_path / "fitted.hyrf", CompressConfig(finetune_steps=FINETUNE_STEPS), data=scene)
    # The map is wrong by log 1.5 = 0.41.
    assert abs(mean_log_gain_between(source, tmp_path / "fitted.hyrf", scene)) < 0.03


@pytest.mark.acceptance
def test_gains_are_fitted_once_per_search_and_only_with_learned_exposures(
    model_file, file_without_exposure_note, scene, tmp_path, monkeypatch
):
    fitted = []
    monkeypatch.setattr(packer, "fit_residual_gains", lambda *of: fitted.append(of) or fit_residual_gains(*of))
    file_with_map = write_model_with_map(
        file_without_exposure_note, scene, PHOTO_GAINS / MEAN_GAIN, tmp_path / "mapped.hyrf"
    )
    for source, calls in ((file_without_exposure_note, 0), (model_file, 1), (file_with_map, 2)):
        compress_model(
            source, tmp_path / "small.hyrf", CompressConfig(finetune_steps=1, target_bytes=12_000), data=scene
        )
        assert len(fitted) == calls


@pytest.mark.acceptance
def test_max_psnr_drop_limits_the_psnr_of_renders_as_photographed(file_with_map, scene, tmp_path):
    report = compress_model(file_with_map, tmp_path / "small.hyrf", CompressConfig(max_psnr_drop=0.5), data=scene)

    before, after = (evaluate_model(load_model(path), scene.train) for path in (file_with_map, tmp_path / "small.hyrf"))
    lost = before.psnr - after.psnr
    assert lost == pytest.approx(float(re.search(r"loses (\S+) of", report.found)[1]), abs=6e-4)
    assert lost <= 0.5 and abs(lost - (before.psnr_consistent - after.psnr_consistent)) > 1e-3
