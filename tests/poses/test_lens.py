"""The choice of the lens model, on projections of known points."""

from __future__ import annotations

import pytest

import hyrfpack  # must come before pycolmap  # noqa: F401

pycolmap = pytest.importorskip("pycolmap")

RADIAL_DISTORTION = -0.08


def make_model() -> pycolmap.Reconstruction:
    """Return a model of 12 photos with radial distortion, whose coefficient is wrong."""
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig = 1, 1, 12
    options.num_points3D = 150
    options.camera_model_id = pycolmap.CameraModelId.SIMPLE_RADIAL
    options.camera_params = [1280.0, 512.0, 384.0, RADIAL_DISTORTION]
    pycolmap.set_random_seed(0)
    model = pycolmap.synthesize_dataset(options)
    for camera in model.cameras.values():
        camera.params = [*camera.params[:3], 0.8 * RADIAL_DISTORTION]
    return model


def test_a_lens_with_one_radial_coefficient_is_refined():
    from hyrfpack.poses.finish import _choose_lens

    chosen = _choose_lens(make_model(), lambda event: None)
    (camera,) = chosen.cameras.values()
    assert camera.model_name == "SIMPLE_RADIAL"
    assert camera.params[3] == pytest.approx(RADIAL_DISTORTION, abs=1e-3)
