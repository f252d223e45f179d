"""Every command counts and names raw and unreadable photos, and says what to do."""

from __future__ import annotations

import doctest
import shutil
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
from commands import refused
from PIL import Image

import hyrfpack
from hyrfpack.data import unusable
from hyrfpack.data.unusable import format_file_names, raw_photos_notes, unreadable_sentences
from hyrfpack.errors import HyrfDataError
from hyrfpack.make.source import LoadSettings, Source

HEIC_HEADER = b"\0\0\0\x18ftypheic" + bytes(40)


def save_photos(folder: Path, count: int) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    for number in range(count):
        pixels = np.random.default_rng(number).integers(0, 255, (48, 64, 3), np.uint8)
        Image.fromarray(pixels).save(folder / f"{number}.jpg")
    return folder


def save_raw_photos(folder: Path, *names: str) -> Path:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(b"II*\0" + bytes(60))
    return folder


@pytest.mark.parametrize(
    "command",
    [
        ("info", "{}"),
        ("make", "{}", "-o", "{}.html"),
        ("poses", "{}", "-o", "{}-scene"),
        ("train", "{}", "-o", "{}-run"),
    ],
    ids=lambda command: command[0],
)
@pytest.mark.parametrize("names, words", [(("1.CR3", "a/2.nef"), "all 2 photos here are raw files (.CR3, .NEF)")])
def test_each_command_rejects_a_folder_of_raw_photos_alike(command, names, words, tmp_path):
    folder = save_raw_photos(tmp_path / "photos", *names)
    sentence = refused(*(part.format(folder) for part in command))
    assert sentence == (
        f"Error: {folder}: {words}, and raw files are not supported; export them as JPEG and name the folder that "
        "holds the exported photos"
    )
    assert sorted(path.name for path in tmp_path.iterdir()) == ["photos"]


@pytest.mark.parametrize(
    "ending", ["CR2", "CR3", "NEF", "ARW", "DNG", "RAF", "ORF", "RW2", "PEF", "SRW", "X3F", "3FR", "IIQ"]
)
def test_a_single_raw_file_is_rejected_as_raw(ending, tmp_path):
    save_raw_photos(tmp_path, f"a.{ending}")
    for read in (hyrfpack.load_scene, hyrfpack.describe_photos):
        with pytest.raises(HyrfDataError, match=f"a.{ending}: raw files are not supported; export them as JPEG"):
            read(tmp_path / f"a.{ending}")


def test_raw_photos_of_an_archive_are_reported_by_its_name(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    with zipfile.ZipFile(tmp_path / "set.zip", "w") as archive:
        archive.writestr("a.arw", b"raw")
    for read in (hyrfpack.load_scene, hyrfpack.describe_photos):
        with pytest.raises(HyrfDataError, match=r"set\.zip: the only photo here is a raw file \(\.ARW\)"):
            read(tmp_path / "set.zip")


def test_raw_photos_beside_others_are_counted_in_one_note(tmp_path):
    folder = save_raw_photos(save_photos(tmp_path, 4), "1.CR3", "2.CR3", "masks/3.CR3")
    notes = [note for note in hyrfpack.describe_photos(folder).notes if "raw" in note]
    assert len(notes) == 1 and notes[0].startswith("2 raw files (.CR3) are ignored")


def test_raw_photos_beside_posed_ones_are_counted_in_one_note(data, tmp_path):
    shutil.copytree(data, tmp_path / "set")
    images = sorted((tmp_path / "set" / "images").iterdir())
    save_raw_photos(tmp_path / "set" / "images", f"{images[0].stem}.DNG")
    scene = hyrfpack.load_scene(tmp_path / "set")
    assert len(scene.views) == len(images)
    assert [note for note in scene.notes if "1 raw file (.DNG) is ignored" in note]


def test_poses_of_raw_files_apply_to_the_pictures_exported_from_them(data, tmp_path):
    shutil.copytree(data, tmp_path / "set")
    table = tmp_path / "set" / "transforms.json"
    table.write_text(table.read_text().replace(".png", ".CR2"))
    for image in (tmp_path / "set" / "images").iterdir():
        save_raw_photos(tmp_path / "set" / "images", f"{image.stem}.CR2")
    assert {Path(view.load.path).suffix for view in hyrfpack.load_scene(tmp_path / "set").views} == {".png"}


def test_heic_photos_without_the_package_do_not_stop_a_survey(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pillow_heif", None)
    folder = save_photos(tmp_path, 5)
    for name in ("a/x.heic", "b/x.heic", "y.HEIC", "z.jpg"):  # a phone may name it .jpg
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_bytes(HEIC_HEADER)
    survey = hyrfpack.describe_photos(folder)
    assert (survey.photos, survey.decoded) == (9, 5)
    # This note would mean that only some of the photos were examined.
    assert not any("evenly spread" in note for note in survey.notes)
    (problem,) = [sentence for sentence in survey.problems if "HEIC" in sentence]
    assert problem == (
        "4 of 9 photos cannot be read: a/x.heic, b/x.heic, y.HEIC and 1 more (reading HEIC photos needs pillow-heif); "
        "run 'pip install \"hyrfpack[heic]\"', or convert them to JPEG"
    )


def test_photos_that_are_all_heic_are_a_clear_error_without_the_package(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pillow_heif", None)
    (tmp_path / "photos").mkdir()
    for number in range(5):
        (tmp_path / "photos" / f"{number}.heic").write_bytes(HEIC_HEADER)
    for arguments in (("info", tmp_path / "photos"), ("poses", tmp_path / "photos", "-o", tmp_path / "scene")):
        sentence = refused(*arguments)
        assert "5 of 5 photos cannot be read: 0.heic, 1.heic, 2.heic and 2 more" in sentence
        assert sentence.count('pip install "hyrfpack[heic]"') == 1


def test_make_takes_a_folder_whose_first_photo_cannot_be_read(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pillow_heif", None)
    folder = save_photos(tmp_path / "photos", 3)
    (folder / "0-first.heic").write_bytes(HEIC_HEADER)
    source = Source.from_path(folder, LoadSettings())
    assert source.kind == "photos" and len(source.files()) == 4
    assert hyrfpack.data.folder.first_readable_photo(source.files()).size == (64, 48)


def test_photos_unreadable_for_several_reasons_are_counted_together():
    reasons = {f"{number}.jpg": f"reason {number}" for number in range(5)}
    assert unreadable_sentences(reasons, 1200) == [
        "5 of 1,200 photos cannot be read: 0.jpg, 1.jpg, 2.jpg and 2 more (0.jpg: reason 0); copy them again, "
        "or remove them"
    ]
    assert unreadable_sentences({}, 3) == []


def test_a_list_of_names_is_complete_or_counted():
    assert format_file_names(["a", "b", "c"]) == "a, b, c"
    assert format_file_names(["a", "b", "c", "d"]) == "a, b, c and 1 more"
    assert raw_photos_notes([]) == []


def test_the_examples_run():
    found = doctest.testmod(unusable)
    assert found.attempted and not found.failed
