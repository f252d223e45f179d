"""Masks that are stored like the photos or upright, lossy masks, and masks in an alpha channel."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from hyrfpack.data import load_scene
from hyrfpack.data.masks import MaskedPhoto, assign_masks, choose_mask_orientations, locate_masks
from hyrfpack.data.pictures import read_mask
from hyrfpack.errors import HyrfDataError

# EXIF orientation -> the stored array of an upright one
STORED_PIXELS_BY_ORIENTATION = {
    1: lambda upright: upright,
    2: lambda upright: upright[:, ::-1],
    3: lambda upright: upright[::-1, ::-1],
    4: lambda upright: upright[::-1],
    6: lambda upright: np.rot90(upright),
    8: lambda upright: np.rot90(upright, -1),
}
UPRIGHT_MASK = np.zeros((24, 32), bool)
UPRIGHT_MASK[:8, :20] = True


def save_stored(path: Path, upright: np.ndarray, orientation: int, exif_orientation: int = 1) -> None:
    path.parent.mkdir(exist_ok=True)
    exif = Image.Exif()
    exif[0x0112] = exif_orientation
    Image.fromarray(np.ascontiguousarray(STORED_PIXELS_BY_ORIENTATION[orientation](upright))).save(path, exif=exif)


def write_turned_set(root: Path, orientations: list[int], masks_are_stored: bool, mask_scale: int = 1) -> None:
    """Replace photos by ones stored in these orientations, and write masks that are stored alike or upright."""
    mask = UPRIGHT_MASK[::mask_scale, ::mask_scale].astype(np.uint8) * 255
    for number, orientation in enumerate(orientations):
        photo = np.where(UPRIGHT_MASK, 200, 50).astype(np.uint8)[..., None].repeat(3, 2)
        save_stored(root / "images" / f"{number:03d}.png", photo, orientation, orientation)
        save_stored(root / "masks" / f"{number:03d}.png", mask, orientation if masks_are_stored else 1)


@pytest.mark.parametrize("mask_scale", [1, 2])
@pytest.mark.parametrize("masks_are_stored", [True, False])
def test_masks_of_turned_photos_fit_them(nerfstudio_folder, masks_are_stored, mask_scale):
    orientations = [1, 3, 6, 8, 4, 2]
    root = nerfstudio_folder(len(orientations))
    write_turned_set(root, orientations, masks_are_stored, mask_scale)

    for view in load_scene(root).views:
        picture = view.load()
        np.testing.assert_array_equal(picture.rgb[..., 0] > 100, UPRIGHT_MASK, err_msg=view.name)
        np.testing.assert_array_equal(picture.mask, UPRIGHT_MASK, err_msg=view.name)


@pytest.mark.parametrize("masks_are_stored", [True, False])
def test_masks_assigned_to_views_of_turned_photos_fit_them(nerfstudio_folder, masks_are_stored):
    root = nerfstudio_folder(3)
    write_turned_set(root, [6, 3, 8], masks_are_stored)
    (root / "masks").rename(root / "objects")

    for view in assign_masks(load_scene(root).views, root / "objects"):
        np.testing.assert_array_equal(view.load().mask, UPRIGHT_MASK, err_msg=view.name)


def test_masks_of_photos_whose_orientation_is_ignored_are_not_turned(nerfstudio_folder):
    root = nerfstudio_folder(3)
    write_turned_set(root, [1, 3, 3], masks_are_stored=True)

    for view in load_scene(root).views:
        picture = view.load()
        np.testing.assert_array_equal(picture.mask, picture.rgb[..., 0] > 100, err_msg=view.name)


UPRIGHT, STORED_SIDEWAYS, SQUARE = (32, 24), (24, 32), (24, 24)


@pytest.mark.parametrize(
    "photos",  # (size of the mask, size of the upright photo, EXIF orientation of the photo, expected orientation)
    [
        [(UPRIGHT, UPRIGHT, 3, 3), (UPRIGHT, UPRIGHT, 1, 1)],
        [(SQUARE, SQUARE, 6, 6), (SQUARE, SQUARE, 3, 3)],
        [(STORED_SIDEWAYS, UPRIGHT, 6, 6), (UPRIGHT, UPRIGHT, 3, 3), (SQUARE, SQUARE, 8, 8)],
        [(UPRIGHT, UPRIGHT, 6, 1), (UPRIGHT, UPRIGHT, 3, 1), (SQUARE, SQUARE, 8, 1)],
        [(UPRIGHT, UPRIGHT, 6, 1), (STORED_SIDEWAYS, UPRIGHT, 6, 6), (UPRIGHT, UPRIGHT, 3, 3)],
    ],
    ids=["upside down alone", "square alone", "stored", "upright", "both"],
)
def test_quarter_turned_photos_decide_whether_ambiguous_masks_are_turned(photos, tmp_path):
    for number, (mask_size, *_) in enumerate(photos):
        Image.new("L", mask_size).save(tmp_path / f"{number}.png")
    masked = [
        MaskedPhoto(tmp_path / f"{number}.png", size, orientation)
        for number, (_, size, orientation, _) in enumerate(photos)
    ]
    assert choose_mask_orientations(masked) == [expected for *_, expected in photos]


def test_a_mask_that_fits_its_photo_in_no_orientation_is_refused(tmp_path):
    Image.new("L", STORED_SIDEWAYS).save(tmp_path / "m.png")
    with pytest.raises(HyrfDataError, match="m.png: the mask is 24 x 32 but its photo 32 x 24"):
        choose_mask_orientations([MaskedPhoto(tmp_path / "m.png", UPRIGHT, 3)])


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("m.jpg", {"quality": 90}),
        ("m.jpg", {"quality": 75}),
        ("m.webp", {"quality": 90}),
        ("m.webp", {"quality": 90, "exif": b"Exif\0\0MM\0*\0\0\0\x08\0\0\0\0\0\0"}),  # in an extended container
    ],
    ids=["JPEG", "JPEG of quality 75", "WebP", "WebP with EXIF"],
)
def test_pixels_that_lossy_compression_raises_from_black_stay_ignored(tmp_path, name, options):
    y, x = np.mgrid[:200, :200]
    usable = (y - 100) ** 2 + (x - 100) ** 2 >= 60**2
    Image.fromarray(usable.astype(np.uint8) * 255).save(tmp_path / name, **options)
    with Image.open(tmp_path / name) as image:
        assert (np.asarray(image.convert("L"))[~usable] > 0).sum() > 500  # the fault that compression makes

    np.testing.assert_array_equal(read_mask(tmp_path / name, 200, 200), usable)


def test_few_black_pixels_of_a_jpeg_of_quality_50_are_kept_and_no_white_one_is_lost(tmp_path):
    y, x = np.mgrid[:200, :200]
    usable = (y - 100) ** 2 + (x - 100) ** 2 >= 60**2
    Image.fromarray(usable.astype(np.uint8) * 255).save(tmp_path / "m.jpg", quality=50)

    found = read_mask(tmp_path / "m.jpg", 200, 200)

    assert found[usable].all() and found[~usable].mean() < 0.005


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


def test_a_smaller_mask_counts_at_the_centres_of_pixels(tmp_path):
    Image.fromarray(np.array([[0] * 4 + [255] * 4], np.uint8)).save(tmp_path / "m.png")
    # The centres of the columns lie 1/6, 1/2 and 5/6 of the way; the middle one lies on the first white pixel.
    assert read_mask(tmp_path / "m.png", 2, 8)[1].tolist() == [False] * 4 + [True] * 4
    Image.fromarray(np.array([[0, 255]], np.uint8)).save(tmp_path / "m.png")
    assert read_mask(tmp_path / "m.png", 1, 3)[0].tolist() == [False, True, True]


def test_masks_of_photos_without_poses_are_found_in_their_folder_or_beside_it(tmp_path, monkeypatch):
    photos = tmp_path / "input"
    photos.mkdir()
    monkeypatch.chdir(photos)
    assert locate_masks(photos) is None
    for folder in (tmp_path / "masks", photos / "mask", photos / "masks"):
        folder.mkdir()
        assert locate_masks(photos) == folder and locate_masks(Path()).samefile(folder)
