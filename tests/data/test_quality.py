"""Measured sharpness and exposure of pictures with known blur, noise and light."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image
from scipy import ndimage

from hyrfpack.data.quality import MIN_SHARPNESS, mark_blurred, measure_exposure, measure_sharpness, read_gray


def random_rectangles(seed: int = 0, side: int = 128) -> np.ndarray:
    """Return overlapping rectangles: edges along rows and columns, sharp to the pixel."""
    generator = np.random.default_rng(seed)
    picture = np.full((side, side), 0.5, np.float32)
    for _ in range(60):
        top, left, height, width = (
            generator.integers(0, side),
            generator.integers(0, side),
            *generator.integers(4, 40, 2),
        )
        picture[top : top + height, left : left + width] = generator.uniform(0.05, 0.95)
    return picture


def motion_blur(picture: np.ndarray, length: int, axis: int) -> np.ndarray:
    return ndimage.uniform_filter1d(picture, length, axis=axis)


@pytest.mark.parametrize("axis", [0, 1])
def test_longer_motion_is_less_sharp_along_either_axis(axis):
    values = [measure_sharpness(random_rectangles())] + [
        measure_sharpness(motion_blur(random_rectangles(), length, axis)) for length in (3, 5, 9)
    ]
    assert values == sorted(values, reverse=True)
    assert values[0] > 0.8 and values[-1] < 0.4


def test_edges_and_waves_have_the_sharpness_of_the_closed_form():
    edge = np.zeros((64, 64), np.float32)
    edge[:32, 32:] = edge[32:, :32] = 1  # D(r) grows linearly with r
    assert measure_sharpness(edge) == pytest.approx(1, rel=0.1)
    wave = 2 * np.pi * np.arange(120) / 40  # D(r) of a wave of 40 pixels is 1 - cos(2 pi r / 40)
    expected = 4 * (1 - np.cos(np.pi / 20)) / (1 - np.cos(4 * np.pi / 20))
    assert measure_sharpness(0.5 + 0.2 * np.add.outer(np.sin(wave), np.sin(wave))) == pytest.approx(expected, rel=0.03)


@pytest.mark.parametrize("contrast", [0.1, 0.5])
def test_sharpness_does_not_depend_on_contrast_and_brightness(contrast):
    assert measure_sharpness(contrast * random_rectangles() + 0.2) == pytest.approx(
        measure_sharpness(random_rectangles()), rel=0.05
    )


@pytest.mark.parametrize("deviation", [0.02, 0.05])
def test_noise_does_not_increase_sharpness(deviation):
    noise = np.random.default_rng(3).normal(0, deviation, (128, 128))
    blurred = ndimage.gaussian_filter(random_rectangles(), 2)
    assert measure_sharpness(blurred + noise) < 0.6 * measure_sharpness(random_rectangles())
    assert measure_sharpness(random_rectangles() + noise) == pytest.approx(
        measure_sharpness(random_rectangles()), rel=0.15
    )


def test_uniform_pictures_are_not_sharp():
    assert measure_sharpness(np.full((40, 40), 0.3)) == 0
    assert measure_sharpness(np.ones((4, 100))) == 0


def test_arrays_that_are_no_picture_are_rejected():
    with pytest.raises(ValueError, match="shape"):
        measure_sharpness(np.zeros((4, 4, 3)))
    with pytest.raises(ValueError, match="finite"):
        measure_sharpness(np.full((20, 20), np.nan))
    with pytest.raises(ValueError, match="finite"):
        mark_blurred([1.0, np.inf])


def test_a_photo_is_blurred_relative_to_its_neighbours_to_the_set_or_absolutely():
    beside = [1.0] * 9 + [0.62] + [1.0] * 9
    assert np.flatnonzero(mark_blurred(beside)).tolist() == [9]
    run = [1.0] * 20 + [0.5] * 9 + [1.0] * 20  # the middle one has only blurred neighbours
    assert np.flatnonzero(mark_blurred(run)).tolist() == list(range(20, 29))
    slow_change = np.linspace(1.2, 0.8, 40)
    assert not mark_blurred(slow_change).any()
    assert mark_blurred([MIN_SHARPNESS / 2] * 5).all()
    assert mark_blurred([]).shape == (0,) and not mark_blurred([0.9]).any()


def test_exposure_is_measured_in_linear_light_with_the_clipped_share():
    picture = np.full((10, 10), 0.5)
    picture[:2] = 0
    picture[2:5] = 1
    found = measure_exposure(picture)
    middle = ((0.5 + 0.055) / 1.055) ** 2.4
    assert found.luminance == pytest.approx(0.3 + 0.5 * middle, rel=1e-4)
    assert (found.dark, found.bright) == pytest.approx((0.2, 0.3))


def test_photos_are_measured_at_a_bounded_size(tmp_path):
    Image.new("RGB", (3000, 1500), (255, 0, 0)).save(tmp_path / "a.jpg")
    gray = read_gray(tmp_path / "a.jpg")
    assert gray.shape == (400, 800)
    assert gray.mean() == pytest.approx(0.299, abs=0.01)
    Image.new("RGBA", (20, 10), (255, 255, 255, 0)).save(tmp_path / "b.png")
    assert read_gray(tmp_path / "b.png").max() == 0


@pytest.mark.parametrize("name", ["mipnerf360_bonsai", "gerrard_hall", "specular_gold_cape", "indoor_room"])
def test_blurred_copies_of_real_photos_are_detected(shared_data, name):
    photos = [read_gray(path) for path in sorted((shared_data / name / "images").iterdir())[::6]]
    sharp = np.array([measure_sharpness(gray) for gray in photos])
    blurred = np.array([measure_sharpness(ndimage.gaussian_filter(gray, 1.5)) for gray in photos])
    assert np.median(sharp) > 1.5 * np.median(blurred)
    assert (sharp[:, None] > blurred).mean() > 0.99
