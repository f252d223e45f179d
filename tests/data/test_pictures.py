from __future__ import annotations

import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image, TiffImagePlugin, TiffTags
from property_tests import examples

from hyrfpack.data.archive import unpack
from hyrfpack.data.pictures import (
    PhotoFile,
    has_same_aspect,
    is_tagged_panorama,
    read_header,
    read_mask,
    read_orientation,
    read_pixels,
)
from hyrfpack.data.undistort import Lens
from hyrfpack.errors import HyrfDataError

RAMP_PIXELS = np.arange(48, dtype=np.uint8).reshape(6, 8) * 5


def test_grey_becomes_rgb(tmp_path):
    Image.fromarray(RAMP_PIXELS).save(tmp_path / "a.png")

    rgb, alpha = read_pixels(tmp_path / "a.png")

    np.testing.assert_array_equal(rgb, np.repeat(RAMP_PIXELS[..., None], 3, 2))
    assert alpha is None


def test_sixteen_bit_grey_keeps_its_brightness(tmp_path):
    Image.fromarray(RAMP_PIXELS.astype(np.uint16) * 257).save(tmp_path / "a.png")

    np.testing.assert_array_equal(read_pixels(tmp_path / "a.png")[0][..., 0], RAMP_PIXELS)


def test_palette_pictures_become_rgb(tmp_path):
    rgb = np.zeros((6, 8, 3), np.uint8)
    rgb[:, :4], rgb[:, 4:] = (200, 10, 20), (0, 90, 255)
    Image.fromarray(rgb).quantize(4).save(tmp_path / "a.png")

    np.testing.assert_array_equal(read_pixels(tmp_path / "a.png")[0], rgb)


@pytest.mark.parametrize("mode", ["RGBA", "LA"])
def test_alpha_is_kept_straight(tmp_path, mode):
    channels = {
        "RGBA": [RAMP_PIXELS, RAMP_PIXELS, RAMP_PIXELS, 255 - RAMP_PIXELS],
        "LA": [RAMP_PIXELS, 255 - RAMP_PIXELS],
    }[mode]
    Image.merge(mode, [Image.fromarray(channel) for channel in channels]).save(tmp_path / "a.png")

    rgb, alpha = read_pixels(tmp_path / "a.png")

    np.testing.assert_array_equal(rgb[..., 1], RAMP_PIXELS)
    np.testing.assert_array_equal(alpha, 255 - RAMP_PIXELS)
    assert read_header(tmp_path / "a.png").has_alpha


def save_with_orientation(path: Path, orientation: int, pixels: np.ndarray) -> Path:
    exif = Image.Exif()
    exif[0x0112] = orientation
    Image.fromarray(pixels).save(path, exif=exif)
    return path


@pytest.mark.parametrize("ending", ["jpg", "png", "webp", "tif"])
@pytest.mark.parametrize("orientation", range(1, 9))
def test_exif_orientation_is_ignored(tmp_path, ending, orientation):
    save_with_orientation(tmp_path / f"a.{ending}", orientation, RAMP_PIXELS)
    Image.fromarray(RAMP_PIXELS).save(tmp_path / f"b.{ending}")

    np.testing.assert_array_equal(read_pixels(tmp_path / f"a.{ending}")[0], read_pixels(tmp_path / f"b.{ending}")[0])
    assert read_header(tmp_path / f"a.{ending}").size == (8, 6)


@pytest.mark.parametrize("ending", ["png", "tif"])
@pytest.mark.parametrize(
    ("orientation", "upright"),  # from the EXIF standard's definition of where row 0 and column 0 are
    [
        (1, RAMP_PIXELS),
        (2, RAMP_PIXELS[:, ::-1]),
        (3, RAMP_PIXELS[::-1, ::-1]),
        (4, RAMP_PIXELS[::-1]),
        (5, RAMP_PIXELS.T),
        (6, RAMP_PIXELS[::-1].T),
        (7, RAMP_PIXELS[::-1, ::-1].T),
        (8, RAMP_PIXELS[:, ::-1].T),
    ],
)
def test_a_picture_is_rotated_upright_on_request(tmp_path, ending, orientation, upright):
    path = save_with_orientation(tmp_path / f"a.{ending}", orientation, RAMP_PIXELS)

    assert read_orientation(path) == orientation
    np.testing.assert_array_equal(read_pixels(path, orientation=orientation)[0][..., 0], upright)


@pytest.mark.parametrize("ending", ["jpg", "png"])
def test_a_rotated_photo_is_reduced_like_the_upright_one(tmp_path, ending):
    ramp = np.add.outer(np.arange(120), 2 * np.arange(160)).astype(np.uint8) // 2
    path = save_with_orientation(tmp_path / f"a.{ending}", 6, ramp)
    lens = Lens(15, 20, 20.0, 20.0, 7.5, 10.0)

    picture = PhotoFile(path, (120, 160), lens, orientation=6)()

    whole = read_pixels(path, orientation=6)[0]
    expected = np.asarray(Image.fromarray(whole).resize((15, 20), Image.Resampling.LANCZOS), float)
    assert picture.rgb.shape == (20, 15, 3)
    assert np.abs(picture.rgb - expected).max() <= (3 if ending == "jpg" else 1)


def test_damaged_exif_counts_as_no_orientation(tmp_path):
    Image.fromarray(RAMP_PIXELS).save(tmp_path / "a.jpg", exif=b"Exif\0\0II*\0\xff\xff\xff\xff")
    save_with_orientation(tmp_path / "b.jpg", 77, RAMP_PIXELS)

    assert read_orientation(tmp_path / "a.jpg") == read_orientation(tmp_path / "b.jpg") == 1


def test_heic_photos_are_read_under_any_ending(tmp_path):
    pytest.importorskip("pillow_heif").register_heif_opener()
    pixels = np.repeat(RAMP_PIXELS.repeat(8, 0).repeat(8, 1)[..., None], 3, 2)
    Image.fromarray(pixels).save(tmp_path / "a.heic", quality=95)
    (tmp_path / "b.jpg").write_bytes((tmp_path / "a.heic").read_bytes())

    for name in ("a.heic", "b.jpg"):
        assert np.abs(read_pixels(tmp_path / name)[0].astype(float) - pixels).mean() < 6
        assert read_header(tmp_path / name).size == (64, 48)


def test_heic_photos_without_the_package_are_a_clear_error(tmp_path, monkeypatch):
    (tmp_path / "a.HEIC").write_bytes(b"\0\0\0\x18ftypheic" + bytes(40))
    monkeypatch.setitem(sys.modules, "pillow_heif", None)

    with pytest.raises(
        HyrfDataError, match=r"""a\.HEIC: reading HEIC photos needs pillow-heif; run 'pip install "hyrfpack\[heic\]"'"""
    ):
        read_header(tmp_path / "a.HEIC")


@pytest.mark.parametrize("ending", ["NEF", "dng", "CR2"])
def test_raw_files_are_rejected_although_pillow_can_read_their_preview(tmp_path, ending):
    Image.fromarray(RAMP_PIXELS).save(tmp_path / "preview.tif")
    (tmp_path / f"a.{ending}").write_bytes((tmp_path / "preview.tif").read_bytes())

    with pytest.raises(HyrfDataError, match="raw files are not supported; export them as JPEG"):
        read_header(tmp_path / f"a.{ending}")


def test_a_photo_from_an_archive_is_named_by_its_path_in_the_archive(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    Image.fromarray(RAMP_PIXELS).save(tmp_path / "a.png")
    whole = (tmp_path / "a.png").read_bytes()
    with zipfile.ZipFile(tmp_path / "set.zip", "w") as archive:
        archive.writestr("set/images/cut.png", whole[: len(whole) - 30])
        archive.writestr("set/notes.txt", "")
    folder = unpack(tmp_path / "set.zip")

    with pytest.raises(HyrfDataError) as error:
        read_pixels(folder / "images" / "cut.png")
    assert str(error.value).startswith(f"{tmp_path / 'set.zip' / 'set' / 'images' / 'cut.png'}: cannot decode")


def test_mask_is_resized_by_nearest_neighbour(tmp_path):
    Image.fromarray(np.array([[0, 255], [1, 0]], np.uint8)).save(tmp_path / "m.png")

    mask = read_mask(tmp_path / "m.png", 4, 4)

    np.testing.assert_array_equal(mask, np.kron([[0, 1], [1, 0]], np.ones((2, 2))).astype(bool))


@pytest.mark.parametrize("ending", ["png", "tif"])
def test_every_16_bit_value_but_0_of_a_mask_is_usable(tmp_path, ending):
    values = np.array([[0, 1, 128], [129, 255, 65535]], np.uint16)
    Image.fromarray(values).save(tmp_path / f"m.{ending}")

    np.testing.assert_array_equal(read_mask(tmp_path / f"m.{ending}", 2, 3), values > 0)


def test_a_refused_picture_is_closed(tmp_path, monkeypatch):
    opened, usual = [], Image.open
    monkeypatch.setattr(Image, "open", lambda path: opened.append(usual(path)) or opened[-1])
    Image.new("L", (8, 8)).save(tmp_path / "a.png", "EPS")

    with pytest.raises(HyrfDataError, match="PostScript is not a photo"):
        read_header(tmp_path / "a.png")
    assert opened[0].fp is None


@pytest.mark.parametrize(("width", "height", "same"), [(100, 67, True), (99, 66, True), (67, 100, False)])
def test_aspect_tolerates_rounding_only(width, height, same):
    assert has_same_aspect(width, height, 800, 533) is same


@examples(60)
@given(data=st.data())
def test_damaged_pictures_raise_only_data_errors(tmp_path_factory, data):
    suffix = data.draw(st.sampled_from(["png", "jpg", "webp", "tif", "bmp", "avif", "jp2"]))
    path = tmp_path_factory.getbasetemp() / f"damaged.{suffix}"
    Image.fromarray(np.repeat(RAMP_PIXELS[..., None], 3, 2)).save(path)
    content = bytearray(path.read_bytes())
    at = data.draw(st.integers(0, len(content) - 1))
    if data.draw(st.booleans()):
        content = content[:at]
    else:
        content[at] ^= data.draw(st.integers(1, 255))
    path.write_bytes(bytes(content))

    try:
        read_header(path)
        read_pixels(path, orientation=read_orientation(path))
    except HyrfDataError as error:
        assert "\n" not in str(error) and path.name in str(error)


@pytest.mark.parametrize("length", [0, 10, 45])
def test_truncated_png_names_the_file(tmp_path, length):
    Image.fromarray(RAMP_PIXELS).save(tmp_path / "a.png")
    (tmp_path / "a.png").write_bytes((tmp_path / "a.png").read_bytes()[:length])

    with pytest.raises(HyrfDataError, match=r"a\.png"):
        read_pixels(tmp_path / "a.png")


@pytest.mark.filterwarnings("error")
def test_photos_of_200_million_pixels_are_read_without_a_warning(tmp_path, monkeypatch):
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 89_478_485)  # Pillow's default
    Image.new("1", (16320, 12240)).save(tmp_path / "a.png")

    assert read_header(tmp_path / "a.png").size == (16320, 12240)


@pytest.mark.filterwarnings("ignore::PIL.Image.DecompressionBombWarning")
def test_a_picture_with_too_many_pixels_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("hyrfpack.data.pictures.MAX_PICTURE_PIXELS", 47)
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 30)
    Image.fromarray(RAMP_PIXELS).save(tmp_path / "a.png")

    with pytest.raises(HyrfDataError, match="a.png: the picture has more than 47 pixels; reduce its size"):
        read_header(tmp_path / "a.png")


def test_missing_picture_names_the_file(tmp_path):
    with pytest.raises(HyrfDataError, match=r"gone\.png.*missing"):
        read_pixels(tmp_path / "gone.png")


@pytest.mark.parametrize("value", [1.5, 7])
def test_an_xmp_tag_of_numbers_declares_no_panorama(tmp_path, value):
    tags = TiffImagePlugin.ImageFileDirectory_v2()
    tags.tagtype[700] = TiffTags.DOUBLE if isinstance(value, float) else TiffTags.LONG
    tags[700] = value
    Image.fromarray(np.zeros((8, 16, 3), np.uint8)).save(tmp_path / "a.tif", tiffinfo=tags)
    assert not is_tagged_panorama(tmp_path / "a.tif")


def test_integers_of_32_bits_are_refused_unless_they_fit_16_bits(tmp_path):
    for name, largest in (("fits.tif", 65_535), ("large.tif", 65_000_000)):
        Image.fromarray(np.linspace(0, largest, 64, dtype=np.int32).reshape(8, 8)).save(tmp_path / name)
    assert read_pixels(tmp_path / "fits.tif")[0][:, :, 0].max() == 255
    with pytest.raises(HyrfDataError, match="32 bits and no known range, save it with 8 or 16 bits"):
        read_pixels(tmp_path / "large.tif")
