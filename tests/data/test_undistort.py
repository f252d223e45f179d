from __future__ import annotations

import numpy as np
import pycolmap
import pytest

from hyrfpack.data.colmap import lens_from_colmap
from hyrfpack.data.undistort import Lens, brown_coefficients, distort, fold_radius, undistort
from hyrfpack.errors import HyrfDataError
from hyrfpack.scene import Picture

PHOTO_WIDTH = 96
PHOTO_HEIGHT = 72
PARAMETERS_BY_MODEL = {
    "SIMPLE_PINHOLE": (80.0, 47.0, 37.0),
    "PINHOLE": (80.0, 84.0, 47.0, 37.0),
    "SIMPLE_RADIAL": (80.0, 47.0, 37.0, -0.12),
    "RADIAL": (80.0, 47.0, 37.0, -0.12, 0.03),
    "OPENCV": (80.0, 84.0, 47.0, 37.0, -0.12, 0.03, 0.004, -0.003),
    "OPENCV_FISHEYE": (80.0, 84.0, 47.0, 37.0, 0.05, -0.02, 0.006, -0.001),
    "FULL_OPENCV": (80.0, 84.0, 47.0, 37.0, 0.2, 0.03, 0.004, -0.003, 0.01, 0.31, 0.02, 0.005),
    "SIMPLE_RADIAL_FISHEYE": (80.0, 47.0, 37.0, 0.04),
    "RADIAL_FISHEYE": (80.0, 47.0, 37.0, 0.04, -0.02),
}


def _colmap_pixels(model: str, rays: np.ndarray) -> np.ndarray:
    camera = pycolmap.Camera(model=model, width=PHOTO_WIDTH, height=PHOTO_HEIGHT, params=PARAMETERS_BY_MODEL[model])
    return camera.img_from_cam(np.column_stack([rays, np.ones(len(rays))]))


def _pixel_rays(lens: Lens) -> np.ndarray:
    x, y = np.meshgrid(np.arange(lens.width) + 0.5, np.arange(lens.height) + 0.5)
    return np.column_stack([((x - lens.cx) / lens.fx).ravel(), ((y - lens.cy) / lens.fy).ravel()])


@pytest.mark.parametrize("model", PARAMETERS_BY_MODEL)
def test_distortion_agrees_with_pycolmap(model):
    rays = np.random.default_rng(0).uniform(-0.7, 0.7, (500, 2))
    lens = lens_from_colmap(model, PHOTO_WIDTH, PHOTO_HEIGHT, np.array(PARAMETERS_BY_MODEL[model]))

    x, y = distort(lens, rays[:, 0], rays[:, 1])

    pixels = np.column_stack([lens.fx * x + lens.cx, lens.fy * y + lens.cy])
    np.testing.assert_allclose(pixels, _colmap_pixels(model, rays), atol=1e-9)


@pytest.mark.parametrize("model", [name for name in PARAMETERS_BY_MODEL if "PINHOLE" not in name])
def test_an_undistorted_pixel_has_the_colour_of_its_ray(model):
    # The colour of the photo is its own pixel coordinate, so that it shows where each undistorted pixel has looked.
    v, u = np.mgrid[0:PHOTO_HEIGHT, 0:PHOTO_WIDTH] + 0.5
    photo = np.stack([u * 2.5, v * 2.5, 0 * u], axis=2).round().astype(np.uint8)
    lens = lens_from_colmap(model, PHOTO_WIDTH, PHOTO_HEIGHT, np.array(PARAMETERS_BY_MODEL[model]))

    picture = undistort(Picture(photo), lens)

    expected = _colmap_pixels(model, _pixel_rays(lens)).reshape(PHOTO_HEIGHT, PHOTO_WIDTH, 2)
    inside = ((expected > 0.5) & (expected < (PHOTO_WIDTH - 0.5, PHOTO_HEIGHT - 0.5))).all(axis=2)
    assert inside.mean() > 0.7
    seen = np.ones_like(inside) if picture.mask is None else picture.mask
    assert seen[inside].all()
    np.testing.assert_allclose(picture.rgb[inside][:, :2] / 2.5, expected[inside], atol=0.45)


@pytest.mark.parametrize("model", ["OPENCV", "OPENCV_FISHEYE", "FULL_OPENCV"])
def test_an_undistorted_point_is_where_the_pinhole_camera_projects_it(model):
    lens = lens_from_colmap(model, PHOTO_WIDTH, PHOTO_HEIGHT, np.array(PARAMETERS_BY_MODEL[model]))
    v, u = np.mgrid[0:PHOTO_HEIGHT, 0:PHOTO_WIDTH] + 0.5
    for ray in ([0.3, -0.2], [-0.4, 0.25], [0.02, 0.01]):
        spot = _colmap_pixels(model, np.array([ray]))[0]
        blob = 255 * np.exp(-((u - spot[0]) ** 2 + (v - spot[1]) ** 2) / 8)
        picture = undistort(Picture(np.repeat(blob[..., None], 3, 2).astype(np.uint8)), lens)

        weight = picture.rgb[..., 0].astype(float)

        center = (weight * u).sum() / weight.sum(), (weight * v).sum() / weight.sum()
        expected = lens.fx * ray[0] + lens.cx, lens.fy * ray[1] + lens.cy
        np.testing.assert_allclose(center, expected, atol=0.15)


def test_pixels_outside_the_photo_are_masked():
    pincushion = Lens(64, 64, 60.0, 60.0, 32.0, 32.0, "brown", brown_coefficients(0.5))

    picture = undistort(Picture(np.full((64, 64, 3), 200, np.uint8)), pincushion)

    assert picture.mask is not None
    assert not picture.mask[0, 0] and picture.mask[32, 32]
    assert (picture.rgb[picture.mask] == 200).all()


def test_rays_past_the_fold_of_the_polynomial_are_masked():
    # r (1 - 0.5 r^2) has its maximum at r = sqrt(2/3); beyond it the photo would appear a second time.
    folding = Lens(200, 200, 60.0, 60.0, 100.0, 100.0, "brown", brown_coefficients(-0.5))
    assert fold_radius(folding, 2.0) == pytest.approx(np.sqrt(2 / 3), abs=1e-3)

    picture = undistort(Picture(np.full((200, 200, 3), 9, np.uint8)), folding)

    x, y = np.meshgrid((np.arange(200) + 0.5 - 100) / 60, (np.arange(200) + 0.5 - 100) / 60)
    assert not picture.mask[np.hypot(x, y) > np.sqrt(2 / 3) + 0.01].any()
    assert picture.mask[np.hypot(x, y) < np.sqrt(2 / 3) - 0.01].all()


def test_masked_pixels_never_affect_unmasked_ones():
    lens = Lens(40, 40, 40.0, 40.0, 20.0, 20.0, "brown", brown_coefficients(0.05))
    rgb = np.full((40, 40, 3), 50, np.uint8)
    mask = np.ones((40, 40), bool)
    rgb[10:20, 5:15], mask[10:20, 5:15] = 255, False

    picture = undistort(Picture(rgb, mask=mask), lens)

    assert 0 < (~picture.mask).sum() < 300
    assert (picture.rgb[picture.mask] == 50).all()


def test_colour_under_zero_alpha_never_affects_other_pixels():
    lens = Lens(40, 40, 40.0, 40.0, 20.0, 20.0, "brown", brown_coefficients(0.05))
    rgb = np.full((40, 40, 3), 50, np.uint8)
    alpha = np.full((40, 40), 255, np.uint8)
    rgb[10:20, 5:15], alpha[10:20, 5:15] = 255, 0

    picture = undistort(Picture(rgb, alpha), lens)

    assert ((picture.alpha > 20) & (picture.alpha < 235)).any()
    assert np.abs(picture.rgb[picture.alpha > 20].astype(int) - 50).max() <= 1


def test_an_unsupported_camera_model_is_rejected():
    with pytest.raises(HyrfDataError, match="FOV"):
        lens_from_colmap("FOV", 10, 10, np.ones(5))
