from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from hyrfpack.data.pictures import find_picture, read_header, read_mask, read_pixels, same_aspect
from hyrfpack.errors import HyrfDataError

RAMP = np.arange(48, dtype=np.uint8).reshape(6, 8) * 5


def test_grey_becomes_rgb(tmp_path):
    Image.fromarray(RAMP).save(tmp_path / "a.png")

    rgb, alpha = read_pixels(tmp_path / "a.png")

    np.testing.assert_array_equal(rgb, np.repeat(RAMP[..., None], 3, 2))
    assert alpha is None


def test_sixteen_bit_grey_keeps_its_brightness(tmp_path):
    Image.fromarray(RAMP.astype(np.uint16) * 257).save(tmp_path / "a.png")

    np.testing.assert_array_equal(read_pixels(tmp_path / "a.png")[0][..., 0], RAMP)


def test_palette_is_resolved(tmp_path):
    rgb = np.zeros((6, 8, 3), np.uint8)
    rgb[:, :4], rgb[:, 4:] = (200, 10, 20), (0, 90, 255)
    Image.fromarray(rgb).quantize(4).save(tmp_path / "a.png")

    np.testing.assert_array_equal(read_pixels(tmp_path / "a.png")[0], rgb)


@pytest.mark.parametrize("mode", ["RGBA", "LA"])
def test_alpha_is_kept_straight(tmp_path, mode):
    channels = {"RGBA": [RAMP, RAMP, RAMP, 255 - RAMP], "LA": [RAMP, 255 - RAMP]}[mode]
    Image.merge(mode, [Image.fromarray(channel) for channel in channels]).save(tmp_path / "a.png")

    rgb, alpha = read_pixels(tmp_path / "a.png")

    np.testing.assert_array_equal(rgb[..., 1], RAMP)
    np.testing.assert_array_equal(alpha, 255 - RAMP)
    assert read_header(tmp_path / "a.png").has_alpha


def test_exif_orientation_is_ignored(tmp_path):
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.fromarray(RAMP).save(tmp_path / "a.jpg", exif=exif)

    assert read_pixels(tmp_path / "a.jpg")[0].shape == (6, 8, 3)
    assert read_header(tmp_path / "a.jpg").width == 8


def test_mask_is_resized_by_nearest_neighbour(tmp_path):
    Image.fromarray(np.array([[0, 255], [1, 0]], np.uint8)).save(tmp_path / "m.png")

    mask = read_mask(tmp_path / "m.png", 4, 4)

    np.testing.assert_array_equal(mask, np.kron([[0, 1], [1, 0]], np.ones((2, 2))).astype(bool))


def test_picture_is_found_by_stem(tmp_path):
    Image.fromarray(RAMP).save(tmp_path / "a.png")

    for name in ("a", "a.png", "a.jpg", "a.JPG"):
        assert find_picture(tmp_path / name) == tmp_path / "a.png"
    assert find_picture(tmp_path / "b.png") is None


@pytest.mark.parametrize(("width", "height", "same"), [(100, 67, True), (99, 66, True), (67, 100, False)])
def test_aspect_tolerates_rounding_only(width, height, same):
    assert same_aspect(width, height, 800, 533) is same


@settings(max_examples=60, deadline=None)
@given(data=st.data())
def test_damaged_pictures_raise_nothing_but_data_errors(tmp_path_factory, data):
    suffix = data.draw(st.sampled_from(["png", "jpg", "webp", "tif"]))
    path = tmp_path_factory.getbasetemp() / f"damaged.{suffix}"
    Image.fromarray(np.repeat(RAMP[..., None], 3, 2)).save(path)
    content = bytearray(path.read_bytes())
    at = data.draw(st.integers(0, len(content) - 1))
    if data.draw(st.booleans()):
        content = content[:at]
    else:
        content[at] ^= data.draw(st.integers(1, 255))
    path.write_bytes(bytes(content))

    try:
        read_header(path)
        read_pixels(path)
    except HyrfDataError as error:
        assert "\n" not in str(error) and path.name in str(error)


@pytest.mark.parametrize("length", [0, 10, 45])
def test_truncated_png_names_the_file(tmp_path, length):
    Image.fromarray(RAMP).save(tmp_path / "a.png")
    (tmp_path / "a.png").write_bytes((tmp_path / "a.png").read_bytes()[:length])

    with pytest.raises(HyrfDataError, match=r"a\.png"):
        read_pixels(tmp_path / "a.png")


def test_missing_picture_names_the_file(tmp_path):
    with pytest.raises(HyrfDataError, match=r"gone\.png.*missing"):
        read_pixels(tmp_path / "gone.png")
