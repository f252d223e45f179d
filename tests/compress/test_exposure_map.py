"""Packing a model with an exposure map keeps the map and measures losses on renders as photographed."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
from exposures import maps_equal, random_map
from scenes import ball_points, ball_scene, small_model, view_of

from hyrfpack.choices import CONSISTENT_EXPOSURE
from hyrfpack.compress import compress_model
from hyrfpack.config.compress import CompressConfig
from hyrfpack.errors import HyrfError
from hyrfpack.evaluate import evaluate_model
from hyrfpack.format import describe_file, load_model, save_model
from hyrfpack.format.min_file_size import min_file_bytes
from hyrfpack.model import ExposureMap, HybridModel
from hyrfpack.render import RenderSettings, render_view
from hyrfpack.scene import Picture, Scene

# The map has this log gain at every viewpoint, which turns a colour of 0.5 into 0.88.
CONSTANT_LOG_GAIN = 2.0


def constant_map() -> ExposureMap:
    gains = np.full(3, CONSTANT_LOG_GAIN, np.float32)
    return dataclasses.replace(random_map(0, centers=9), mean=gains, limits=np.stack((gains, gains)))


@pytest.fixture(scope="module")
def model() -> HybridModel:
    points, colors = ball_points(400)
    logits = np.log(colors / (1 - colors))
    model = small_model(points, fields=0.3, color_logits=logits, scale_logits=-2.5, opacity_logits=2.0)
    model.exposure = constant_map()
    return model.requires_grad_(False)


@pytest.fixture(scope="module")
def scene(model) -> Scene:
    """Return photos that equal the model's renders as photographed plus noise of about 33 dB."""
    rng, views = np.random.default_rng(0), []
    for view in ball_scene(8).train:
        rgb = 255 * render_view(model, view.camera).rgb.numpy() + rng.normal(0, 6, (32, 32, 3))
        views.append(view_of(view.name, view.camera, Picture(rgb.round().clip(0, 255).astype(np.uint8))))
    return dataclasses.replace(ball_scene(8), train=views[1:], test=views[:1])


@pytest.fixture(scope="module")
def source(model, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("source") / "model.hyrf"
    save_model(model, path)
    return path


@pytest.mark.parametrize(
    "options",
    [
        *(
            pytest.param(options, marks=pytest.mark.acceptance)
            for options in ({}, {"distortion": 1e-5}, {"prune": False}, {"target_bytes": 6000}, {"max_psnr_drop": 0.5})
        ),
        {"finetune_steps": 3},
        {"profile": "paper"},
        {"profile": "raw"},
    ],
    ids=str,
)
def test_a_packed_file_keeps_the_map(options, source, scene, tmp_path):
    data = None if "profile" in options else scene
    report = compress_model(source, tmp_path / "small.hyrf", CompressConfig(**options), data=data)

    assert maps_equal(load_model(tmp_path / "small.hyrf").exposure, constant_map())
    assert describe_file(tmp_path / "small.hyrf")["version"] == "1.2"
    assert "EXPO" in {section.type for section in report.sections}


def test_the_error_is_measured_on_renders_as_photographed(model, source, scene, tmp_path):
    report = compress_model(source, tmp_path / "small.hyrf", CompressConfig(distortion=3e-5), data=scene)

    packed, errors = load_model(tmp_path / "small.hyrf"), {}
    for exposure in ("as-photographed", CONSISTENT_EXPOSURE):
        settings = RenderSettings(exposure=exposure)
        differences = [
            (render_view(model, view.camera, settings).rgb - render_view(packed, view.camera, settings).rgb)
            .square()
            .mean()
            for view in scene.train
        ]
        errors[exposure] = float(torch.stack(differences).mean())
    assert report.error / 1.25 < errors["as-photographed"] < 1.25 * report.error
    # The two errors must differ for the test to distinguish them.
    assert errors[CONSISTENT_EXPOSURE] < errors["as-photographed"] / 1.25


@pytest.mark.acceptance
def test_fine_tuning_fits_renders_as_photographed_and_leaves_the_exposure_to_the_map(model, source, scene, tmp_path):
    compress_model(source, tmp_path / "tuned.hyrf", CompressConfig(finetune_steps=40), data=scene)

    tuned = load_model(tmp_path / "tuned.hyrf")
    assert evaluate_model(tuned, scene.train).psnr > 28
    consistent = RenderSettings(exposure=CONSISTENT_EXPOSURE)
    for view in scene.test:
        shown, expected = (render_view(each, view.camera, consistent).rgb.mean() for each in (tuned, model))
        assert float(shown) == pytest.approx(float(expected), abs=0.02)


def test_a_target_size_below_the_minimum_with_a_map_is_refused(source, tmp_path):
    assert min_file_bytes(exposure=constant_map()) > min_file_bytes() + 84
    with pytest.raises(HyrfError, match=f"about {min_file_bytes(exposure=constant_map()):,} bytes"):
        compress_model(source, tmp_path / "small.hyrf", CompressConfig(target_bytes=min_file_bytes() + 1))
    assert not (tmp_path / "small.hyrf").exists()
