"""Unusable photos are left out under the user's file names, counted in a note, and do not stop the others."""

from __future__ import annotations

import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
from made_up_photos import write_photos
from PIL import Image

import hyrfpack

HEIC_HEADER = b"\0\0\0\x18ftypheic" + bytes(40)


def save_truncated(path: Path) -> None:
    """Write a rotated picture with a complete header and truncated pixel data."""
    tags = Image.Exif()
    tags[0x0112] = 6
    pixels = np.random.default_rng(1).integers(0, 255, (150, 200, 3), np.uint8)
    Image.fromarray(pixels).save(path, exif=tags)
    path.write_bytes(path.read_bytes()[:20_000])


@pytest.fixture(scope="module")
def report(tmp_path_factory) -> hyrfpack.PosesReport:
    """The report on five good photos, a truncated one, two HEIC photos and two raw files."""
    folder = tmp_path_factory.mktemp("mixed") / "photos"
    write_photos(folder, 5)
    save_truncated(folder / "cut.tif")
    for name in ("a.heic", "b.HEIC"):
        (folder / name).write_bytes(HEIC_HEADER)
    for name in ("a.CR3", "b.CR3"):
        (folder / name).write_bytes(b"raw")
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(sys.modules, "pillow_heif", None)
        return hyrfpack.estimate_poses(folder, folder.parent / "scene")


@pytest.mark.acceptance
def test_the_other_photos_are_posed(report):
    assert (report.photos, report.registered) == (8, 5)


@pytest.mark.acceptance
def test_omitted_photos_are_named_by_the_users_files_and_not_by_internal_paths(report):
    assert set(report.left_out) == {"a.heic", "b.HEIC", "cut.tif"}
    assert report.left_out["a.heic"] == "reading HEIC photos needs pillow-heif"
    assert report.left_out["cut.tif"].startswith("cannot decode the picture (")
    assert not any(".poses" in text or "/" in text for text in report.left_out.values())


@pytest.mark.acceptance
def test_each_kind_of_unusable_photo_is_counted_in_one_note(report):
    notes = "\n".join(report.notes)
    assert notes.count("2 of 8 photos cannot be read: a.heic, b.HEIC (reading HEIC photos needs pillow-heif)") == 1
    assert notes.count("1 of 8 photos cannot be read: cut.tif (cannot decode the picture") == 1
    assert notes.count("2 raw files (.CR3) are ignored") == 1


def test_rejected_photos_of_an_archive_are_named_with_the_archive(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    write_photos(tmp_path / "photos", 2)
    with zipfile.ZipFile(tmp_path / "set.zip", "w") as archive:
        for path in sorted((tmp_path / "photos").iterdir()):
            archive.write(path, f"set/{path.name}")
    with pytest.raises(hyrfpack.HyrfDataError) as error:
        hyrfpack.estimate_poses(tmp_path / "set.zip", tmp_path / "scene")
    assert str(error.value).startswith(f"{tmp_path / 'set.zip'}: 2 photos are too few")
