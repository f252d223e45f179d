"""Photos without poses: which files of a folder are photos, and what their EXIF says."""

from __future__ import annotations

import math
from datetime import datetime
from pathlib import Path

import numpy as np
import pytest
from denied_access import deny_access
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

from hyrfpack.data.folder import list_photos, list_pictures, read_photo_facts
from hyrfpack.errors import HyrfDataError


def save_photo(
    path: Path, size: tuple[int, int] = (40, 30), base: dict | None = None, exif: dict | None = None
) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    tags = Image.Exif()
    tags.update(base or {})
    tags.get_ifd(0x8769).update(exif or {})
    Image.fromarray(np.zeros((size[1], size[0], 3), np.uint8)).save(
        path, exif=tags.tobytes()
    )  # TIFF files lose some entries of an Exif object
    return path


def list_names(folder: Path) -> list[str]:
    return [path.relative_to(folder).as_posix() for path in list_photos(folder)]


def test_only_photos_are_listed_sorted_by_path(tmp_path):
    wanted = ["IMG_2.JPG", "a/1.webp", "images/1.png", "left/2.Tif"]
    others = ["masks/1.png", "mask/1.png", "masks_2/1.png", "images_4/1.png", "thumbs/1.jpg", ".hidden/1.jpg"]
    others += [".IMG_1.jpg", "@eaDir/1.jpg", "depth/1.png", "notes.txt", "raw.dng"]
    for name in wanted + others:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    (tmp_path / "folder.jpg").mkdir()
    assert list_names(tmp_path) == wanted


@pytest.mark.parametrize("mark", ["poses.json", "model.hyrf", "metrics.json"])
def test_folders_of_results_are_omitted_except_the_given_one(mark, tmp_path):
    for name in ("1.jpg", "run/views/1.png", f"run/{mark}"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    assert list_names(tmp_path) == ["1.jpg"]
    assert list_names(tmp_path / "run") == ["views/1.png"]


@pytest.mark.parametrize("name", ["lod-meta.json", "tileset.json", "hyrf-viewer.js"])
def test_an_exported_folder_is_not_one_of_photos(name, tmp_path):
    (tmp_path / name).touch()
    (tmp_path / "poster.jpg").touch()
    with pytest.raises(HyrfDataError, match=rf"this folder was exported \({name}\), and its pictures are not photos"):
        list_photos(tmp_path)


def test_circular_links_are_followed_once(tmp_path):
    save_photo(tmp_path / "a" / "1.png")
    (tmp_path / "a" / "again").symlink_to(tmp_path)
    assert list_names(tmp_path) == ["a/1.png"]


def test_links_that_lead_nowhere_are_ignored(tmp_path):
    save_photo(tmp_path / "1.png")
    for name in ("loop", "loop.png"):
        (tmp_path / name).symlink_to(name)
    (tmp_path / "missing.png").symlink_to(tmp_path / "not there.png")
    assert list_names(tmp_path) == ["1.png"]


def test_a_missing_folder_is_a_clear_error(tmp_path):
    with pytest.raises(HyrfDataError, match="no such folder; name the folder"):
        list_photos(tmp_path / "missing")
    with pytest.raises(HyrfDataError, match="is a file, not a folder"):
        list_photos(save_photo(tmp_path / "1.png"))


def test_a_folder_that_may_not_be_read_is_a_clear_error(tmp_path, monkeypatch):
    save_photo(tmp_path / "locked" / "1.png")
    deny_access(monkeypatch, tmp_path / "locked")
    with pytest.raises(HyrfDataError, match=r"the folder cannot be read \(Permission denied\); check its permissions"):
        list_photos(tmp_path / "locked")


@pytest.mark.parametrize(
    "orientation, size", [(1, (40, 30)), (3, (40, 30)), (6, (30, 40)), (8, (30, 40)), (9, (40, 30))]
)
def test_the_size_is_that_of_the_upright_picture(orientation, size, tmp_path):
    facts = read_photo_facts(save_photo(tmp_path / "1.jpg", base={0x0112: orientation}))
    assert facts.size == size
    assert facts.orientation == (orientation if orientation <= 8 else 1)


def test_the_focal_length_follows_from_the_35_mm_equivalent(tmp_path):
    facts = read_photo_facts(save_photo(tmp_path / "1.jpg", (4000, 3000), exif={0xA405: 26}))
    # A full frame of 36 x 24 mm has a diagonal of 43.27 mm, and 4000 x 3000 pixels have one of 5000 pixels.
    assert facts.focal == pytest.approx(26 / math.sqrt(36**2 + 24**2) * 5000)


def test_the_focal_length_follows_from_the_sensor_also_in_a_shrunk_copy(tmp_path):
    # 8 mm on a sensor with 200 pixels a mm are 1,600 of 4,000 pixels, and 400 of 1,000 pixels.
    exif = {0x920A: IFDRational(8), 0xA20E: IFDRational(2000), 0xA210: 3, 0xA002: 4000, 0xA003: 3000}
    assert read_photo_facts(save_photo(tmp_path / "1.jpg", (4000, 3000), exif=exif)).focal == pytest.approx(1600)
    assert read_photo_facts(save_photo(tmp_path / "2.jpg", (1000, 750), exif=exif)).focal == pytest.approx(400)


@pytest.mark.parametrize("equivalent", [4, 65535])
def test_an_implausible_35_mm_equivalent_is_ignored(equivalent, tmp_path):
    sensor = {0x920A: IFDRational(8), 0xA20E: IFDRational(2000), 0xA210: 3}  # 200 pixels a mm
    photo = save_photo(tmp_path / "1.jpg", (4000, 3000), exif=sensor | {0xA405: equivalent})
    assert read_photo_facts(photo).focal == pytest.approx(1600)


@pytest.mark.parametrize(
    "exif",
    [
        {},
        {0xA405: 0},
        {0xA405: 4},
        {0xA405: 65535},
        {0x920A: IFDRational(1, 0), 0xA20E: IFDRational(72)},
        {0x920A: IFDRational(8)},
    ],
)
def test_without_usable_exif_there_is_no_focal_length(exif, tmp_path):
    assert read_photo_facts(save_photo(tmp_path / "1.jpg", exif=exif)).focal is None


def test_device_and_time_are_read_from_exif(tmp_path):
    first = save_photo(
        tmp_path / "1.jpg", base={0x010F: "Apple", 0x0110: "iPhone 12"}, exif={0x9003: "2024:05:01 12:00:00"}
    )
    exif = {0x9003: "2024:05:01 12:00:02", 0x9291: "5"}
    second = save_photo(tmp_path / "2.jpg", base={0x010F: "Canon", 0x0110: "Canon EOS R5"}, exif=exif)
    assert read_photo_facts(first).device == "Apple iPhone 12"
    assert read_photo_facts(second).device == "Canon EOS R5"
    assert read_photo_facts(second).taken - read_photo_facts(first).taken == pytest.approx(2.5)
    bare = read_photo_facts(save_photo(tmp_path / "3.png"))
    assert (bare.device, bare.taken) == ("", None)


@pytest.mark.parametrize("error", [OSError(22, "Invalid argument"), OverflowError("mktime argument out of range")])
def test_a_time_that_the_system_cannot_convert_is_ignored(error, tmp_path, monkeypatch):
    """On Windows, `datetime.timestamp` raises OSError for times near or before 1970."""

    class UnconvertibleTime(datetime):
        def timestamp(self):
            raise error

    monkeypatch.setattr("hyrfpack.data.folder.datetime", UnconvertibleTime)
    photo = save_photo(tmp_path / "1.jpg", base={0x0110: "Canon EOS R5"}, exif={0x9003: "1970:01:01 00:00:00"})
    facts = read_photo_facts(photo)
    assert (facts.device, facts.taken) == ("Canon EOS R5", None)


def test_a_file_that_is_no_picture_is_a_clear_error(tmp_path):
    (tmp_path / "1.jpg").write_bytes(b"no picture at all")
    with pytest.raises(HyrfDataError, match="not a picture that can be read"):
        read_photo_facts(tmp_path / "1.jpg")


@pytest.mark.parametrize("ending", ["jpg", "tif"])
@pytest.mark.parametrize("orientation", [1, 3, 6, 7])
def test_tiff_files_that_pillow_rotates_itself_are_read_right(orientation, ending, tmp_path):
    exif = {0xA405: 26}
    facts = read_photo_facts(save_photo(tmp_path / f"1.{ending}", (4000, 3000), base={0x0112: orientation}, exif=exif))
    assert facts.orientation == orientation
    assert facts.size == ((3000, 4000) if orientation >= 5 else (4000, 3000))
    assert facts.focal == pytest.approx(26 / math.sqrt(36**2 + 24**2) * 5000)


def test_all_pictures_include_masks_and_previews_but_no_hidden_files(tmp_path):
    wanted = ["1.png", "images/1.png", "images_4/1.png", "masks/1.png", "run/1.png"]
    for name in [*wanted, ".hidden/1.png", ".1.png", "__MACOSX/1.png", "@eaDir/1.png", "run/poses.json"]:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    assert [path.relative_to(tmp_path).as_posix() for path in list_pictures(tmp_path)] == wanted


def test_a_folder_with_links_to_it_is_listed_once_under_its_own_name(tmp_path):
    save_photo(tmp_path / "set" / "b" / "1.png")
    save_photo(tmp_path / "elsewhere" / "2.png")
    (tmp_path / "set" / "a").symlink_to(tmp_path / "set" / "b")
    (tmp_path / "set" / "c").symlink_to(tmp_path / "elsewhere")
    assert list_names(tmp_path / "set") == ["b/1.png", "c/2.png"]
