"""Preparation of camera files for a scene: upright photos, separate cameras, no duplicates, matching masks."""

from __future__ import annotations

import json
import os
import shutil
import time
from pathlib import Path

import numpy as np
import pytest
from made_up_photos import PHOTO_SIZE, write_photos
from PIL import Image, TiffImagePlugin

import hyrfpack
from hyrfpack.config.poses import PosesConfig
from hyrfpack.copying import copy_file
from hyrfpack.data.folder import list_photos, read_photo_facts
from hyrfpack.data.pictures import read_pixels
from hyrfpack.data.unusable import unreadable_sentences
from hyrfpack.poses import estimate
from hyrfpack.poses.job import Device, Job
from hyrfpack.poses.prepare import (
    Photo,
    find_masks,
    group_by_device,
    is_ordered_sequence,
    make_images,
    make_masks,
    read_headers,
)
from hyrfpack.progress import TaskEvent, ignore_progress

# EXIF orientation -> counter-clockwise quarter turns from the upright picture to the stored one.
QUARTER_TURNS_BY_ORIENTATION = {3: 2, 6: 1, 8: 3}


def upright_picture(seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    small = Image.fromarray(rng.integers(0, 255, (6, 8, 3), np.uint8))
    return np.asarray(small.resize((80, 60), Image.Resampling.BICUBIC))


def save_photo(
    path: Path, pixels: np.ndarray, orientation: int = 1, exif: dict | None = None, device: str = ""
) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    tags = Image.Exif()
    tags[0x0112] = orientation
    if device:
        tags[0x0110] = device
    tags.get_ifd(0x8769).update(exif or {})
    stored = np.ascontiguousarray(np.rot90(pixels, QUARTER_TURNS_BY_ORIENTATION.get(orientation, 0)))
    Image.fromarray(stored).save(path, exif=tags, **({"quality": 95} if path.suffix == ".jpg" else {}))
    return path


def read_photo_headers(folder: Path, in_place: bool = False) -> tuple[list[Photo], dict[str, str]]:
    return read_headers(folder, list_photos(folder), in_place)


@pytest.mark.parametrize("orientation", [3, 6, 8])
@pytest.mark.parametrize("name, written, most", [("a.jpg", "a.jpg", 6.0), ("a.png", "a.png", 0.0)])
def test_photos_stored_on_their_side_are_written_upright(orientation, name, written, most, tmp_path):
    save_photo(tmp_path / "in" / name, upright_picture(), orientation)
    photos, _ = read_photo_headers(tmp_path / "in")
    make_images(photos, tmp_path / "out")
    assert [photo.name for photo in photos] == [written]
    with Image.open(tmp_path / "out" / written) as image:
        assert image.getexif().get(0x0112, 1) == 1
        assert np.abs(np.asarray(image).astype(float) - upright_picture()).mean() <= most


@pytest.mark.parametrize("mode", ["1", "L", "P", "RGB", "RGBA", "CMYK", "I;16"])
def test_turned_tiff_files_of_every_mode_are_written_upright(mode, tmp_path):
    picture = Image.fromarray(upright_picture())
    grey = np.asarray(picture.convert("L")).astype(np.uint16) * 257
    stored = Image.fromarray(grey) if mode == "I;16" else picture.convert(mode)
    tags = Image.Exif()
    tags[0x0112] = 6
    (tmp_path / "in").mkdir()
    stored.transpose(Image.Transpose.ROTATE_90).save(tmp_path / "in" / "a.tif", exif=tags)
    photos, _ = read_photo_headers(tmp_path / "in")
    make_images(photos, tmp_path / "out")
    written, _ = read_pixels(tmp_path / "out" / photos[0].name)
    expected = np.asarray(Image.fromarray((grey // 257).astype(np.uint8)) if mode == "I;16" else stored.convert("RGB"))
    expected = expected if expected.ndim == 3 else np.repeat(expected[..., None], 3, axis=2)
    assert written.shape == expected.shape
    assert np.abs(written.astype(int) - expected).max() <= 1


def test_a_turned_photo_of_32_bit_integers_is_written_with_16_bits(tmp_path):
    levels = np.arange(60 * 80, dtype=np.int32).reshape(60, 80) * 20 - 1000
    tags = Image.Exif()
    tags[0x0112] = 3
    (tmp_path / "in").mkdir()
    Image.fromarray(levels[::-1, ::-1].copy()).save(tmp_path / "in" / "a.tif", exif=tags)
    photos, _ = read_photo_headers(tmp_path / "in")
    make_images(photos, tmp_path / "out")
    with Image.open(tmp_path / "out" / photos[0].name) as image:
        assert np.array_equal(np.asarray(image), np.clip(levels, 0, 65535))


def test_a_stop_leaves_photos_that_were_not_begun_unread(tmp_path, monkeypatch):
    read: list[Path] = []

    def read_slowly(path: Path) -> str:
        read.append(path)
        time.sleep(0.02)
        return "unreadable"

    def stop(event: TaskEvent) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("hyrfpack.poses.prepare._read_facts_or_reason", read_slowly)
    files = [tmp_path / f"{number}.jpg" for number in range(50)]
    for file in files:
        file.touch()
    with pytest.raises(KeyboardInterrupt):
        read_headers(tmp_path, files, in_place=False, progress=stop)
    assert len(read) < len(files)


def test_upright_photos_are_copied_byte_for_byte_and_stay_independent(tmp_path):
    original, copy = tmp_path / "in" / "left" / "a.jpg", tmp_path / "out" / "left" / "a.jpg"
    save_photo(original, upright_picture())
    before = original.read_bytes()
    photos, _ = read_photo_headers(tmp_path / "in")
    make_images(photos, tmp_path / "out")
    assert copy.read_bytes() == before and copy.stat().st_mtime_ns == original.stat().st_mtime_ns
    with copy.open("r+b") as file:
        file.write(b"edited")
    assert original.read_bytes() == before
    with original.open("r+b") as file:
        file.write(b"changed too")
    assert copy.read_bytes()[:6] == b"edited"


def test_masks_are_copied_so_that_edits_do_not_reach_the_original(tmp_path):
    save_photo(tmp_path / "photos" / "a.jpg", upright_picture())
    (tmp_path / "masks").mkdir()
    Image.new("L", (80, 60), 255).save(tmp_path / "masks" / "a.png")
    photos, _ = read_photo_headers(tmp_path / "photos")
    made = make_masks(photos, find_masks(photos, tmp_path / "masks", in_place=False).by_photo, tmp_path / "made")
    assert made["a.jpg"].read_bytes() == (tmp_path / "masks" / "a.png").read_bytes()
    assert not made["a.jpg"].samefile(tmp_path / "masks" / "a.png")


def test_copies_are_reflinks_where_the_file_system_has_them(tmp_path, monkeypatch):
    fcntl = pytest.importorskip("fcntl")
    (tmp_path / "a.jpg").write_bytes(b"photo")
    asked = []

    def reflink(target: int, request: int, source: int) -> int:
        asked.append(request)
        os.write(target, os.read(source, 100))
        return 0

    monkeypatch.setattr(fcntl, "ioctl", reflink)
    monkeypatch.setattr("shutil.copyfile", lambda *paths: pytest.fail("copied byte for byte"))
    copy_file(tmp_path / "a.jpg", tmp_path / "b.jpg")
    assert (tmp_path / "b.jpg").read_bytes() == b"photo"
    assert asked == [0x40049409]  # FICLONE of linux/fs.h: _IOW(0x94, 9, int)


def test_a_file_that_would_be_copied_onto_itself_is_left_as_it_is(tmp_path):
    (tmp_path / "a.jpg").write_bytes(b"photo")
    (tmp_path / "link.jpg").symlink_to(tmp_path / "a.jpg")
    for target in ("a.jpg", "link.jpg"):
        with pytest.raises(shutil.SameFileError):
            copy_file(tmp_path / "a.jpg", tmp_path / target)
    assert (tmp_path / "a.jpg").read_bytes() == b"photo"


def test_a_photo_with_only_a_complete_header_is_omitted_also_as_a_panorama(tmp_path):
    path = save_photo(tmp_path / "a.jpg", np.random.default_rng(0).integers(0, 255, (200, 400, 3), np.uint8))
    path.write_bytes(path.read_bytes()[:5000])
    save_photo(tmp_path / "b.jpg", upright_picture())
    photos, left_out = read_photo_headers(tmp_path)
    assert [photo.name for photo in photos] == ["b.jpg"]
    assert left_out["a.jpg"].startswith("cannot decode the picture")


def test_a_rotated_photo_with_a_damaged_tag_is_written_upright(tmp_path):
    """Pillow cannot write a resolution that is text, but reads the orientation beside it."""
    tags = TiffImagePlugin.ImageFileDirectory_v2()
    tags.tagtype[0x011A], tags[0x011A], tags[0x0112] = 2, "72", 6
    stored = Image.fromarray(np.ascontiguousarray(np.rot90(upright_picture(), QUARTER_TURNS_BY_ORIENTATION[6])))
    (tmp_path / "in").mkdir()
    stored.save(tmp_path / "in" / "a.jpg", quality=95, exif=b"Exif\0\0II*\0\x08\0\0\0" + tags.tobytes(8))
    photos, _ = read_photo_headers(tmp_path / "in")
    make_images(photos, tmp_path / "out")
    assert photos[0].facts.size == upright_picture().shape[1::-1]
    with Image.open(tmp_path / "out" / "a.jpg") as image:
        assert np.abs(np.asarray(image).astype(float) - upright_picture()).mean() <= 6


def test_rewritten_photos_get_no_name_that_differs_only_in_capital_letters(tmp_path):
    save_photo(tmp_path / "in" / "A.JPG", upright_picture(0))
    save_photo(tmp_path / "in" / "a.webp", upright_picture(1), 6)
    photos, _ = read_photo_headers(tmp_path / "in")
    assert len({photo.name.casefold() for photo in photos}) == 2


def test_photos_that_differ_only_in_their_ending_keep_different_names(tmp_path):
    for number, name in enumerate(("a.bmp", "a.jpg", "a.png", "a.webp")):
        save_photo(tmp_path / "in" / name, upright_picture(number), 6 if name == "a.webp" else 1)
    save_photo(tmp_path / "in" / "a.jp2", upright_picture(9))  # it would be written as a.png, but that name is taken
    photos, _ = read_photo_headers(tmp_path / "in")
    assert len({photo.name for photo in photos}) == 5
    make_images(photos, tmp_path / "out")
    assert (tmp_path / "out" / "a.png").read_bytes() == (tmp_path / "in" / "a.png").read_bytes()


def test_a_truncated_rotated_photo_is_copied_and_cannot_be_decoded(tmp_path):
    path = save_photo(tmp_path / "in" / "a.jpg", upright_picture(), 6)
    path.write_bytes(path.read_bytes()[:-500])
    photos, _ = read_photo_headers(tmp_path / "in")
    make_images(photos, tmp_path / "out")
    with pytest.raises(hyrfpack.HyrfDataError, match="cannot decode"):
        read_pixels(tmp_path / "out" / "a.jpg")


def test_rotated_cmyk_photos_become_rgb_without_the_cmyk_profile(tmp_path):
    tags = Image.Exif()
    tags[0x0112] = 6
    (tmp_path / "in").mkdir()
    inks = Image.fromarray(upright_picture()).convert("CMYK")
    inks.save(tmp_path / "in" / "a.jpg", exif=tags, icc_profile=b"of inks", quality=95)
    photos, _ = read_photo_headers(tmp_path / "in")
    make_images(photos, tmp_path / "out")
    with Image.open(tmp_path / "out" / "a.jpg") as image:
        assert (image.mode, image.size, image.info.get("icc_profile")) == ("RGB", (60, 80), None)


def test_photos_used_in_place_are_not_rotated(tmp_path):
    save_photo(tmp_path / "a.jpg", upright_picture(), 6)
    photos, _ = read_photo_headers(tmp_path, in_place=True)
    devices, _ = group_by_device(photos, in_place=True)
    assert devices[0].size == (60, 80)  # the stored size
    assert group_by_device(photos, in_place=False)[0][0].size == (80, 60)


def test_duplicates_and_unreadable_files_are_omitted_with_the_reason(tmp_path):
    save_photo(tmp_path / "a.png", upright_picture(1))
    save_photo(tmp_path / "b.png", upright_picture(2))
    (tmp_path / "c.png").write_bytes((tmp_path / "a.png").read_bytes())
    (tmp_path / "d.png").write_bytes(b"nothing")
    photos, left_out = read_photo_headers(tmp_path)
    assert [photo.name for photo in photos] == ["a.png", "b.png"]
    assert left_out["c.png"] == "a copy of a.png"
    assert left_out["d.png"].startswith("not a picture that can be read")


def test_of_two_equal_photos_the_one_with_the_shorter_name_is_kept_as_in_the_survey(tmp_path):
    for name in ("IMG_1 (1).png", "IMG_1.png", "copy of IMG_1.png"):
        save_photo(tmp_path / name, upright_picture(1))
    save_photo(tmp_path / "IMG_2.png", upright_picture(2))
    photos, left_out = read_photo_headers(tmp_path)
    assert [photo.name for photo in photos] == ["IMG_1.png", "IMG_2.png"]
    assert set(left_out.items()) == {(name, "a copy of IMG_1.png") for name in ("IMG_1 (1).png", "copy of IMG_1.png")}
    assert "such as IMG_1 (1).png of IMG_1.png" in " ".join(hyrfpack.describe_photos(tmp_path).problems)


def test_photos_whose_names_are_not_utf_8_are_omitted_with_the_reason(tmp_path):
    save_photo(tmp_path / "a.jpg", upright_picture())
    invalid = tmp_path / os.fsdecode(b"caf\xe9.png")
    try:
        save_photo(invalid, upright_picture(1))
    except OSError:
        pytest.skip("this file system stores only names in UTF-8")
    photos, left_out = read_photo_headers(tmp_path)
    assert [photo.name for photo in photos] == ["a.jpg"]
    assert left_out == {r"caf\xe9.png": "its name is not valid UTF-8; rename it"}
    assert unreadable_sentences(left_out, 2) == [
        r"1 of 2 photos cannot be read: caf\xe9.png (its name is not valid UTF-8); rename it"
    ]


def test_cameras_are_distinguished_by_folder_device_size_and_zoom(tmp_path):
    tele, wide = {0xA405: 70}, {0xA405: 24}
    save_photo(tmp_path / "a1.jpg", upright_picture(1), exif=wide, device="One")
    save_photo(tmp_path / "a2.jpg", upright_picture(2), exif=wide, device="One")
    save_photo(tmp_path / "b.jpg", upright_picture(3), exif=tele, device="One")
    save_photo(tmp_path / "c.jpg", upright_picture(4), exif=wide, device="Two")
    save_photo(tmp_path / "d.jpg", upright_picture(5)[:, :40], exif=wide, device="One")
    save_photo(tmp_path / "left" / "e.jpg", upright_picture(6), exif=wide, device="One")
    photos, _ = read_photo_headers(tmp_path)
    devices, of = group_by_device(photos, in_place=False)
    assert [photo.name for photo in photos] == ["a1.jpg", "a2.jpg", "b.jpg", "c.jpg", "d.jpg", "left/e.jpg"]
    assert of == (0, 0, 1, 2, 3, 4)
    # In 35 mm terms, the diagonal of 100 pixels stands for 43.27 mm.
    assert devices[0].focal == pytest.approx(24 / np.hypot(36, 24) * 100)


def test_photos_taken_in_quick_succession_or_numbered_frames_are_a_sequence(tmp_path):
    for number in range(4):
        taken = {0x9003: f"2024:05:01 12:00:0{number}"}
        save_photo(tmp_path / "burst" / f"IMG_{number}.jpg", upright_picture(number), exif=taken, device="One")
        save_photo(
            tmp_path / "walk" / f"IMG_{number}.jpg",
            upright_picture(number),
            exif={0x9003: f"2024:05:01 12:0{number}:00"},
        )
        save_photo(tmp_path / "frames" / f"frame_{number:03d}.png", upright_picture(number))
        save_photo(tmp_path / "any" / f"{'abcd'[number]}.png", upright_picture(number))
    ordered = {
        name: is_ordered_sequence(read_photo_headers(tmp_path / name)[0]) for name in ("burst", "walk", "frames", "any")
    }
    assert ordered == {"burst": True, "walk": False, "frames": True, "any": False}


def test_frames_are_in_the_order_of_their_numbers_without_leading_zeros(tmp_path):
    for seed, name in enumerate(("frame_10.png", "frame_9.png", "frame_1.png", "b2/1.png", "b10/1.png", "7.png")):
        save_photo(tmp_path / "frames" / name, upright_picture(seed))
    names = [photo.name for photo in read_photo_headers(tmp_path / "frames")[0]]
    assert names == ["7.png", "b2/1.png", "b10/1.png", "frame_1.png", "frame_9.png", "frame_10.png"]


def test_masks_are_rotated_with_their_photos(tmp_path):
    save_photo(tmp_path / "photos" / "a.jpg", upright_picture(), 6)
    save_photo(tmp_path / "photos" / "b.jpg", upright_picture(1))
    mask = np.zeros((60, 80), np.uint8)
    mask[:20, :30] = 255
    (tmp_path / "masks").mkdir()
    Image.fromarray(np.ascontiguousarray(np.rot90(mask, QUARTER_TURNS_BY_ORIENTATION[6]))).save(
        tmp_path / "masks" / "a.png"
    )
    photos, _ = read_photo_headers(tmp_path / "photos")
    found = find_masks(photos, tmp_path / "masks", in_place=False).by_photo
    assert list(found) == ["a.jpg"]
    made = make_masks(photos, found, tmp_path / "made")
    with Image.open(made["a.jpg"]) as image:
        assert np.array_equal(np.asarray(image), mask)


@pytest.mark.parametrize("mask_scale", [1, 2])
@pytest.mark.parametrize("masks_are_stored", [True, False])
def test_masks_are_written_upright_whether_they_are_stored_like_the_photos_or_upright(
    masks_are_stored, mask_scale, tmp_path
):
    mask = np.zeros((60 // mask_scale, 80 // mask_scale), np.uint8)
    mask[:10, :15] = 255
    (tmp_path / "masks").mkdir()
    for number, orientation in enumerate([1, 3, 6, 8]):
        save_photo(tmp_path / "photos" / f"{number}.jpg", upright_picture(number), orientation)
        turns = QUARTER_TURNS_BY_ORIENTATION.get(orientation, 0) if masks_are_stored else 0
        Image.fromarray(np.ascontiguousarray(np.rot90(mask, turns))).save(tmp_path / "masks" / f"{number}.png")
    photos, _ = read_photo_headers(tmp_path / "photos")
    made = make_masks(photos, find_masks(photos, tmp_path / "masks", in_place=False).by_photo, tmp_path / "made")
    assert len(made) == 4
    for name, path in made.items():
        with Image.open(path) as image:
            np.testing.assert_array_equal(np.asarray(image), mask, err_msg=name)


def test_black_pixels_of_a_jpeg_mask_are_written_as_black(tmp_path):
    save_photo(tmp_path / "photos" / "a.jpg", upright_picture())
    y, x = np.mgrid[:60, :80]
    mask = np.where((y - 30) ** 2 + (x - 40) ** 2 < 20**2, 0, 255).astype(np.uint8)
    (tmp_path / "masks").mkdir()
    Image.fromarray(mask).save(tmp_path / "masks" / "a.jpg", quality=90)
    photos, _ = read_photo_headers(tmp_path / "photos")
    made = make_masks(photos, find_masks(photos, tmp_path / "masks", in_place=False).by_photo, tmp_path / "made")
    with Image.open(made["a.jpg"]) as image:
        np.testing.assert_array_equal(np.asarray(image), mask)


@pytest.mark.parametrize("in_place, usable", [(False, {(80, 60), (60, 80)}), (True, {(60, 80)})])
def test_a_mask_must_have_the_shape_of_its_photo(in_place, usable, tmp_path):
    save_photo(tmp_path / "photos" / "a.jpg", upright_picture(), 6)  # stored on its side
    (tmp_path / "masks").mkdir()
    photos, _ = read_photo_headers(tmp_path / "photos", in_place)
    for size in ((80, 60), (60, 80), (60, 60)):
        Image.new("L", size, 255).save(tmp_path / "masks" / "a.png")
        if size in usable:
            assert list(find_masks(photos, tmp_path / "masks", in_place).by_photo) == ["a.jpg"]
        else:
            with pytest.raises(hyrfpack.HyrfDataError, match=f"a.png: the mask is {size[0]} x {size[1]} but its photo"):
                find_masks(photos, tmp_path / "masks", in_place)


def test_masked_parts_have_no_features_and_photos_without_masks_keep_theirs(tmp_path):
    import pycolmap

    from hyrfpack.poses.features import find_features

    names = list(write_photos(tmp_path / "images", 3))
    mask = np.full(PHOTO_SIZE[::-1], 255, np.uint8)
    mask[:, : PHOTO_SIZE[0] // 2] = 0
    Image.fromarray(mask).save(tmp_path / "mask.png")
    (tmp_path / "work").mkdir()
    masks = {names[0]: str(tmp_path / "mask.png")}
    job = Job(
        tmp_path / "images", tmp_path / "work", tuple(names), (Device(PHOTO_SIZE),), (0, 0, 0), masks, "exhaustive", 0
    )
    find_features(job, ignore_progress)
    with pycolmap.Database.open(job.database_path) as database:
        masked, free = (np.asarray(database.read_keypoints(number))[:, 0] for number in (1, 2))
    assert masked.min() >= PHOTO_SIZE[0] // 2 - 1 > free.min()
    assert len(masked) > 50 and len(free) > 50


def test_large_photos_have_a_reduced_working_size_and_focal_length():
    device = Device((4000, 3000), 3000.0)
    assert device.working_size == (1600, 1200)
    assert device.working_focal == 1200.0
    assert Device((400, 300)).working_size == (400, 300)


def test_a_job_is_read_as_it_was_written(tmp_path):
    devices = (Device((40, 30), 35.0), Device((30, 40)))
    job = Job(tmp_path, tmp_path / "work", ("a.png", "b/c.png"), devices, (0, 1), {"a.png": "m.png"}, "exhaustive", 7)
    job.save(tmp_path / "job.json")
    assert Job.load(tmp_path / "job.json") == job


@pytest.mark.acceptance
def test_photos_of_two_cameras_some_of_them_rotated_become_one_scene(tmp_path):
    folder = tmp_path / "photos"
    known = write_photos(folder)
    for number, name in enumerate(sorted(known)):
        path = folder / name
        pixels = np.asarray(Image.open(path))
        path.unlink()
        if number % 2:
            save_photo(folder / name.replace(".png", ".jpg"), pixels, 6, device="One")
        else:
            save_photo(
                folder / "right" / name, pixels[:, : 4 * PHOTO_SIZE[0] // 5], device="Two"
            )  # it has another principal point
    report = hyrfpack.estimate_poses(folder, tmp_path / "scene")
    assert report.registered == len(known)
    assert any("turned upright" in note for note in report.notes)
    assert any("2 cameras or zooms are distinguished" in note for note in report.notes)
    scene = hyrfpack.load_scene(tmp_path / "scene")
    assert {(view.camera.width, view.camera.height) for view in scene.views} == {
        PHOTO_SIZE,
        (4 * PHOTO_SIZE[0] // 5, PHOTO_SIZE[1]),
    }
    assert len(json.loads((tmp_path / "scene" / "poses.json").read_text())["made"]) == len(known)
    assert read_photo_facts(tmp_path / "scene" / "images" / "photo01.jpg").size == PHOTO_SIZE


def test_masks_in_the_place_of_the_scenes_own_are_not_taken_for_those_of_the_photos(tmp_path, caplog):
    (tmp_path / "input").mkdir()
    (tmp_path / "masks").mkdir()
    found = []
    for out in (tmp_path, tmp_path / "scene"):
        estimation = estimate._PoseEstimation(
            photos=tmp_path / "input", out=out, config=PosesConfig(), masks=None, overwrite=False,
            progress=ignore_progress,
        )  # fmt: skip
        found.append(estimation._find_mask_folder(in_place=False))
    assert found == [None, tmp_path / "masks"]
    assert caplog.text.count("masks: these masks are not read") == 1
