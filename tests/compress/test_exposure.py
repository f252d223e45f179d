"""Packing a model beside which photos' exposures were learnt: their mean is kept, and they hide no losses."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from scenes import alternating, ball_scene, exposed_scene, shown, view_of

from hyrfpack.cameras.capture import has_mean_exposure
from hyrfpack.compress import compress, packer
from hyrfpack.compress.finetune import gains_of_photos
from hyrfpack.evaluate import evaluate
from hyrfpack.format import describe, load, save
from hyrfpack.format.codec import load_with_provenance
from hyrfpack.scene import Scene, View
from hyrfpack.train import TrainConfig, train

GAINS = alternating(8, stops=1.0)
MEAN = np.exp(np.log(GAINS).mean())


@pytest.fixture(scope="module")
def scene() -> Scene:
    return exposed_scene(GAINS, side=32)


@pytest.fixture(scope="module")
def truth() -> list[View]:
    """What photos of the mean exposure would show."""
    return [view_of(v.name, v.camera, shown(v.load(), MEAN)) for v in ball_scene(len(GAINS), 300).train]


@pytest.fixture(scope="module")
def trained(scene, tmp_path_factory) -> Path:
    config = TrainConfig(steps=150, max_gaussians=300, exposure=True)
    return train(scene, tmp_path_factory.mktemp("run"), config, quiet=True).model


@pytest.fixture(scope="module")
def unaware(trained, tmp_path_factory) -> Path:
    """The same model in a file that does not tell of exposures, as older ones do not."""
    model, provenance = load_with_provenance(trained)
    del provenance["mean_exposure"]
    path = tmp_path_factory.mktemp("unaware") / "model.hyrf"
    save(model, path, provenance=provenance)
    return path


def test_gains_are_those_of_the_photos_about_their_mean(trained, scene):
    gains = np.array([gains.numpy() for gains in gains_of_photos(load(trained), scene.train).values()])
    np.testing.assert_allclose(np.log(gains).mean(0), 0, atol=1e-6)
    np.testing.assert_allclose(np.log(gains).mean(1), np.log(GAINS / MEAN)[:, 0], atol=0.15)


def test_fine_tuning_keeps_the_mean_exposure_and_the_file_says_so(trained, unaware, scene, truth, tmp_path):
    scores, told = [], []
    for source in (trained, unaware):
        compress(source, tmp_path / "small.hyrf", data=scene, finetune_steps=160)
        scores.append(evaluate(load(tmp_path / "small.hyrf"), truth).psnr)
        told.append(has_mean_exposure(describe(tmp_path / "small.hyrf")["provenance"]))

    assert told == [True, False]
    assert scores[0] > scores[1] + 1


def test_gains_are_fitted_once_for_all_files_of_a_search_and_only_where_exposures_were_learnt(
    trained, unaware, scene, tmp_path, monkeypatch
):
    fitted = []
    monkeypatch.setattr(packer, "gains_of_photos", lambda *of: fitted.append(of) or gains_of_photos(*of))
    for source, calls in ((unaware, 0), (trained, 1)):
        compress(source, tmp_path / "small.hyrf", data=scene, finetune_steps=1, target_bytes=12_000)
        assert len(fitted) == calls


def test_a_limit_on_the_loss_is_on_the_psnr_that_exposures_do_not_hide(trained, scene, tmp_path):
    report = compress(trained, tmp_path / "small.hyrf", data=scene, max_psnr_drop=0.5)

    before, after = (
        evaluate(load(path), scene.train, training=scene.train) for path in (trained, tmp_path / "small.hyrf")
    )
    lost = before.psnr_predicted - after.psnr_predicted
    assert lost == pytest.approx(float(re.search(r"loses (\S+) of", report.found)[1]), abs=6e-4)
    assert lost <= 0.5 and abs(lost - (before.psnr - after.psnr)) > 1e-3
