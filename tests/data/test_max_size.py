"""Photos above a size limit are reduced while they are decoded, and so are cameras, masks and lenses."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

from hyrfpack.data import assemble, load_scene
from hyrfpack.data.pictures import fit_size, read_mask, read_pixels
from hyrfpack.errors import HyrfDataError, HyrfError

NOISE_PICTURE = np.random.default_rng(0).integers(0, 256, (24, 32, 3), dtype=np.uint8)


def ramp_picture(width: int, height: int) -> np.ndarray:
    """Return a (H, W, 3) ramp of 100 levels along each side, which a reduction must not shift."""
    x, y = (np.arange(width) + 0.5) / width, (np.arange(height) + 0.5) / height
    return np.repeat((20 + 100 * x[None, :] + 100 * y[:, None])[..., None], 3, axis=2)


@pytest.mark.parametrize(
    ("stored", "limit", "shrunk"),
    [
        ((4032, 3024), 1600, (1600, 1200)),
        ((2999, 4032), 1600, (1190, 1600)),
        ((1600, 1066), 1600, (1600, 1066)),
        ((4032, 3024), 0, (4032, 3024)),
        ((9000, 2), 100, (100, 1)),
    ],
)
def test_the_limit_applies_to_the_longer_side(stored, limit, shrunk):
    assert fit_size(*stored, limit) == shrunk


def test_intrinsics_are_scaled_exactly_with_the_photos(tmp_path, colmap_folder):
    colmap_folder(tmp_path, count=3)  # 32 x 24 pixels, fx 30, fy 31, centre (17, 11)

    halved, uneven = (load_scene(tmp_path, max_size=size).views[0] for size in (16, 21))

    assert (halved.camera.width, halved.camera.height) == (16, 12)
    assert halved.camera.intrinsics == (15.0, 15.5, 8.5, 5.5)
    assert (uneven.camera.width, uneven.camera.height) == (21, 16)
    expected = (30 * 21 / 32, 31 * 16 / 24, 17 * 21 / 32, 11 * 16 / 24)
    np.testing.assert_allclose(uneven.camera.intrinsics, expected, rtol=1e-15)
    assert uneven.load().rgb.shape == (16, 21, 3)


def test_photos_larger_than_a_stored_camera_may_be_are_refused_unless_they_are_shrunk(
    tmp_path, colmap_folder, monkeypatch
):
    """Otherwise the cameras of the model would be written, but not read."""
    colmap_folder(tmp_path, count=3)
    monkeypatch.setattr(assemble, "MAX_IMAGE_SIDE_PIXELS", 31)

    with pytest.raises(HyrfDataError, match="32 x 24 pixels; the cameras.*up to 31 on a side; shrink.*to 31 or less"):
        load_scene(tmp_path)
    assert load_scene(tmp_path, max_size=31).views[0].camera.width == 31


def test_intrinsics_calibrated_at_another_size_are_scaled_too(tmp_path, colmap_folder, pictures):
    folder = colmap_folder(tmp_path, count=3)
    pictures(tmp_path / "images_large", folder.names, size=(64, 48))

    view = load_scene(tmp_path, images="images_large", max_size=16).views[0]

    assert view.camera.intrinsics == (15.0, 15.5, 8.5, 5.5)


@pytest.mark.parametrize("limit", [0, 32, 1600])
def test_photos_within_the_limit_are_unchanged(tmp_path, colmap_folder, limit):
    folder = colmap_folder(tmp_path, count=2)

    scene = load_scene(tmp_path, max_size=limit)

    for view, name in zip(scene.views, folder.names, strict=True):
        np.testing.assert_array_equal(view.load().rgb, np.asarray(Image.open(tmp_path / "images" / name)))
        assert view.camera.intrinsics == (30.0, 31.0, 17.0, 11.0)
    assert scene.max_size == limit and not any("shrunk" in note for note in scene.notes)


@pytest.mark.parametrize("size", [(1001, 751), (803, 1207)])
@pytest.mark.parametrize("longer", [100, 37, 700])
def test_reduction_does_not_shift_the_picture(tmp_path, size, longer):
    Image.fromarray(ramp_picture(*size).round().astype(np.uint8)).save(tmp_path / "a.png")
    small = fit_size(*size, longer)

    rgb, _ = read_pixels(tmp_path / "a.png", small)

    inner = slice(4, -4)  # the filter is cut off at the border
    np.testing.assert_allclose(rgb[inner, inner], ramp_picture(*small)[inner, inner], atol=0.8)


def test_a_jpeg_decoded_at_reduced_size_matches_the_full_one(tmp_path):
    """It is decoded at a quarter of its size, so that 254.25 x 190.75 pixels lie in a picture of 255 x 191."""
    fine = Image.fromarray(NOISE_PICTURE).resize((1017, 763), Image.Resampling.NEAREST)
    fine.save(tmp_path / "a.jpg", quality=95)
    whole = Image.open(tmp_path / "a.jpg").resize((100, 75), Image.Resampling.LANCZOS)

    rgb, _ = read_pixels(tmp_path / "a.jpg", (100, 75))

    error = np.square(rgb.astype(float) - np.asarray(whole, float)).mean()
    assert 0 < error < 255**2 / 10**4.5  # 45 dB; above 0, because a draft was decoded


def test_colours_without_coverage_do_not_affect_reduced_photos(tmp_path):
    rgba = np.zeros((40, 40, 4), np.uint8)
    rgba[:, :17] = (200, 0, 0, 255)
    rgba[:, 17:] = (0, 255, 0, 0)
    Image.fromarray(rgba).save(tmp_path / "a.png")

    rgb, alpha = read_pixels(tmp_path / "a.png", (10, 10))

    covered = alpha > 8
    assert (rgb[covered][:, 1] == 0).all() and (np.abs(rgb[covered][:, 0].astype(int) - 200) <= 10).all()
    np.testing.assert_allclose(
        alpha[5, [2, 4, 7]], (255, 255 / 4, 0), atol=25
    )  # the fifth pixel has a coverage of a quarter


@pytest.mark.parametrize(
    ("image", "channels"),
    [
        (Image.fromarray(NOISE_PICTURE[..., 0].astype(np.uint16) * 257), 3),
        (Image.fromarray(NOISE_PICTURE[..., 0]), 3),
        (Image.fromarray(NOISE_PICTURE).convert("P"), 3),
        (Image.fromarray(NOISE_PICTURE).convert("CMYK"), 3),
        (Image.merge("LA", [Image.fromarray(NOISE_PICTURE[..., 0])] * 2), 4),
    ],
    ids=["16 bits", "grey", "palette", "cmyk", "grey with alpha"],
)
def test_pictures_of_every_mode_are_reduced(tmp_path, image, channels):
    image.save(tmp_path / "a.tif")

    rgb, alpha = read_pixels(tmp_path / "a.tif", (16, 12))

    assert rgb.shape == (12, 16, 3) and rgb.dtype == np.uint8 and rgb.std() > 5
    assert (alpha is not None) == (channels == 4)


def test_exif_orientation_is_ignored_in_reduced_photos(tmp_path, colmap_folder):
    colmap_folder(tmp_path, count=1)
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.fromarray(ramp_picture(32, 24).round().astype(np.uint8)).save(tmp_path / "images" / "000.png", exif=exif)

    rgb = load_scene(tmp_path, test_every=0, max_size=16).views[0].load().rgb

    np.testing.assert_allclose(rgb[4:-4, 4:-4], ramp_picture(16, 12)[4:-4, 4:-4], atol=1.5)


@pytest.mark.parametrize("size", [(16, 12), (21, 16), (7, 5)])
def test_a_reduced_pixel_is_used_only_if_all_its_pixels_are(tmp_path, size):
    generator = np.random.default_rng(2)
    ignored = generator.random((24, 32)) < 0.01
    Image.fromarray(np.where(ignored, 0, 255).astype(np.uint8)).save(tmp_path / "m.png")

    mask = read_mask(tmp_path / "m.png", size[1], size[0])

    expected = np.ones((size[1], size[0]), bool)
    for y, x in np.argwhere(ignored):  # computed by hand: the small pixels that overlap the square of this one
        rows = [r for r in range(size[1]) if r * 24 / size[1] < y + 1 and (r + 1) * 24 / size[1] > y]
        columns = [c for c in range(size[0]) if c * 32 / size[0] < x + 1 and (c + 1) * 32 / size[0] > x]
        expected[np.ix_(rows, columns)] = False
    assert 0 < expected.sum() < expected.size
    np.testing.assert_array_equal(mask, expected)


def test_masks_of_any_size_are_fitted_to_reduced_photos(tmp_path, colmap_folder):
    colmap_folder(tmp_path, count=3)
    (tmp_path / "masks").mkdir()
    for name, size in (("000.png", 1), ("001.png", 2), ("002.png", 4)):
        pixels = np.full((24 // size, 32 // size), 255, np.uint8)
        pixels[: 12 // size] = 0
        if size == 1:
            pixels[:12:2] = 255  # one of every two rows is used, so no row of the reduced photo is
        Image.fromarray(pixels).save(tmp_path / "masks" / name)

    for view in load_scene(tmp_path, max_size=16).views:
        np.testing.assert_array_equal(view.load().mask, np.arange(12)[:, None].repeat(16, 1) >= 6)


def test_photos_are_undistorted_at_the_reduced_size(tmp_path, colmap_folder):
    colmap_folder(tmp_path, count=1, model=4, params=(30.0, 31, 17, 11, 0.1, 0.01, 0.001, 0.002))
    Image.fromarray(ramp_picture(32, 24).round().astype(np.uint8)).save(tmp_path / "images" / "000.png")

    small, large = (load_scene(tmp_path, test_every=0, max_size=size).views[0].load() for size in (16, 0))

    assert small.rgb.shape == (12, 16, 3)
    halved = large.rgb.astype(float).reshape(12, 2, 16, 2, 3).mean((1, 3))
    np.testing.assert_allclose(small.rgb[2:-2, 2:-2], halved[2:-2, 2:-2], atol=3)


def test_a_note_counts_reduced_photos_and_names_their_size(tmp_path, colmap_folder):
    folder = colmap_folder(tmp_path, count=3)
    Image.new("RGB", (64, 48)).save(tmp_path / "images" / folder.names[1])
    Image.new("RGB", (16, 12)).save(tmp_path / "images" / folder.names[2])

    scene = load_scene(tmp_path, max_size=20)

    note = "2 of 3 photos are shrunk from up to 64 x 48 to 20 pixels on the longer side; `max_size=0` keeps them"
    assert note in scene.notes
    assert scene.max_size == 20
    assert [view.camera.width for view in scene.views] == [20, 20, 16]


def test_a_photo_replaced_by_one_of_another_size_is_rejected(tmp_path, colmap_folder):
    folder = colmap_folder(tmp_path, count=1)
    view = load_scene(tmp_path, test_every=0, max_size=16).views[0]
    Image.new("RGB", (64, 32)).save(tmp_path / "images" / folder.names[0])

    with pytest.raises(HyrfDataError, match=r"000\.png: the picture changed its size"):
        view.load()


@pytest.mark.parametrize("limit", [-1, 1, 5, 15])
def test_a_limit_that_leaves_nothing_to_see_is_rejected_before_anything_is_read(tmp_path, limit):
    with pytest.raises(HyrfError, match=f"cannot be shrunk to {limit} pixels on the longer side; .*16 pixels or more"):
        load_scene(tmp_path, max_size=limit)
