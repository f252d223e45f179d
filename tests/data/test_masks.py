"""Lossy masks, and masks in an alpha channel."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

from hyrfpack.data.pictures import read_mask


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("m.jpg", {"quality": 90}),
        ("m.webp", {"quality": 90}),
        ("m.webp", {"quality": 90, "exif": b"Exif\0\0MM\0*\0\0\0\x08\0\0\0\0\0\0"}),  # in an extended container
    ],
    ids=["JPEG", "WebP", "WebP with EXIF"],
)
def test_pixels_that_lossy_compression_raises_from_black_stay_ignored(tmp_path, name, options):
    y, x = np.mgrid[:200, :200]
    usable = (y - 100) ** 2 + (x - 100) ** 2 >= 60**2
    Image.fromarray(usable.astype(np.uint8) * 255).save(tmp_path / name, **options)
    with Image.open(tmp_path / name) as image:
        assert (np.asarray(image.convert("L"))[~usable] > 0).sum() > 500  # the fault that compression makes

    np.testing.assert_array_equal(read_mask(tmp_path / name, 200, 200), usable)


@pytest.mark.parametrize("name", ["m.png", "m.webp"])
def test_levels_of_lossless_masks_above_0_are_usable(tmp_path, name):
    levels = np.array([[0, 1, 15], [16, 128, 255]], np.uint8)
    Image.fromarray(levels).convert("RGB").save(tmp_path / name, lossless=True)

    np.testing.assert_array_equal(read_mask(tmp_path / name, 2, 3), levels > 0)


@pytest.mark.parametrize(
    ("colours", "alphas", "usable"),
    [
        ([255, 255, 255], [0, 1, 255], [0, 1, 1]),  # the alpha is the mask
        ([255, 255, 255], [128, 128, 128], [1, 1, 1]),
        ([255, 255, 0], [0, 255, 255], [1, 1, 0]),
        ([0, 0, 0], [0, 1, 255], [0, 0, 0]),  # black may be painted over what is ignored, or be the rest
    ],
)
def test_the_alpha_of_a_mask_of_one_colour_is_used(tmp_path, colours, alphas, usable):
    pixels = np.array([[(c, c, c, a) for c, a in zip(colours, alphas, strict=True)]], np.uint8)
    Image.fromarray(pixels).save(tmp_path / "m.png")

    np.testing.assert_array_equal(read_mask(tmp_path / "m.png", 1, 3), np.array([usable], bool))
