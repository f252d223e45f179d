"""Sets in .zip archives are unpacked once into their own folder, and bad archives are a clear error."""

from __future__ import annotations

import json
import os
import shutil
import zipfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given
from hypothesis import strategies as st
from property_tests import examples

from hyrfpack.data import archive, load_scene
from hyrfpack.errors import HyrfDataError, HyrfError
from hyrfpack.outputs import Outputs


@pytest.fixture(autouse=True)
def cache(tmp_path_factory, monkeypatch) -> Path:
    folder = tmp_path_factory.mktemp("cache")
    monkeypatch.setenv("XDG_CACHE_HOME", str(folder))
    return folder / "hyrfpack" / "archives"


def zip_folder(folder: Path, target: Path, top: str = "") -> Path:
    with zipfile.ZipFile(target, "w") as content:
        for file in sorted(path for path in folder.rglob("*") if path.is_file()):
            content.write(file, top + file.relative_to(folder).as_posix())
    return target


@pytest.fixture
def zipped_set(tmp_path, colmap_folder) -> Path:
    """A small set as an archive, with its folder `set` beside it."""
    colmap_folder(tmp_path / "set", count=4)
    return zip_folder(tmp_path / "set", tmp_path / "set.zip", "set/")


def test_an_archive_is_read_like_its_folder(zipped_set):
    scene, plain = load_scene(zipped_set), load_scene(zipped_set.with_suffix(""))

    assert [view.name for view in scene.views] == [view.name for view in plain.views]
    for ours, theirs in zip(scene.views, plain.views, strict=True):
        assert ours.camera == theirs.camera
        np.testing.assert_array_equal(ours.load().rgb, theirs.load().rgb)
    assert scene.notes[0].startswith("set.zip was unpacked into ")


@pytest.mark.parametrize("top", ["", "top/", "top/keyframes/"])
def test_an_archive_of_polycams_keyframes_alone_is_read_like_its_folder(tmp_path, pictures, top):
    pictures(tmp_path / "set" / "keyframes" / "images", ["1.jpg", "2.jpg"])
    (tmp_path / "set" / "keyframes" / "cameras").mkdir()
    for stem, x in (("1", 0), ("2", 1)):
        camera = {"fx": 30, "fy": 30, "cx": 16, "cy": 12, "width": 32, "height": 24}
        camera |= {f"t_{row}{column}": int(row == column) for row in range(3) for column in range(4)} | {"t_03": x}
        (tmp_path / "set" / "keyframes" / "cameras" / f"{stem}.json").write_text(json.dumps(camera))

    scene = load_scene(zip_folder(tmp_path / "set", tmp_path / "set.zip", top))

    assert (scene.layout, [view.name for view in scene.views]) == ("polycam", ["1.jpg", "2.jpg"])


def test_photos_in_a_folder_named_keyframes_have_names_below_it(tmp_path, pictures):
    pictures(tmp_path / "set" / "keyframes", ["left/1.jpg", "right/1.jpg"])

    folder = archive.unpack(zip_folder(tmp_path / "set", tmp_path / "set.zip"))

    assert folder.name == "keyframes" and (folder / "left" / "1.jpg").is_file()


def test_an_archive_is_unpacked_again_only_after_a_change(zipped_set, cache):
    folder = archive.unpack(zipped_set)
    first = folder / "images" / "000.png"
    about = os.stat(first)

    assert archive.unpack(zipped_set) == folder and os.stat(first).st_mtime_ns == about.st_mtime_ns
    first.unlink()
    assert archive.unpack(zipped_set) == folder and first.is_file()
    os.utime(zipped_set, ns=(1, 1))
    assert archive.unpack(zipped_set) != folder
    assert sorted(path.name[:4] for path in cache.iterdir()) == ["set-", "set-"]


def test_outputs_may_lie_beside_the_archive_and_never_replace_it(zipped_set):
    outputs = Outputs(scene=load_scene(zipped_set), overwrite=True)

    outputs.file(zipped_set.parent / "small.hyrf")
    with pytest.raises(HyrfError, match="the output is an input itself"):
        outputs.file(zipped_set)
    with pytest.raises(HyrfError, match="the same command reads what lies in this folder"):
        outputs.file(archive.unpack(zipped_set) / "images" / "new.hyrf")


def test_an_archive_is_read_also_with_an_unwritable_home_folder(zipped_set, monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", os.devnull + "/none")
    monkeypatch.setattr(archive.tempfile, "gettempdir", lambda: str(tmp_path / "temporary"))
    monkeypatch.setattr(archive.tempfile, "tempdir", str(tmp_path))

    assert archive.unpack(zipped_set).is_relative_to(tmp_path / "temporary")


def test_a_lack_of_space_is_reported_before_anything_is_written(zipped_set, cache, monkeypatch):
    monkeypatch.setattr(shutil, "disk_usage", lambda path: shutil._ntuple_diskusage(100, 99, 1))

    with pytest.raises(HyrfDataError, match="do not fit on the disk"):
        load_scene(zipped_set)
    assert list(cache.iterdir()) == []


def test_a_disk_that_fills_up_leaves_nothing(zipped_set, cache, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(shutil, "copyfileobj", full)

    with pytest.raises(HyrfDataError, match="No space left on device.*make room"):
        load_scene(zipped_set)
    assert list(cache.iterdir()) == []


def test_files_of_a_killed_process_are_removed_after_a_day(zipped_set, cache):
    archive.unpack(zipped_set)
    for name in (".partial-old", ".partial-new"):
        (cache / name).mkdir()
    os.utime(cache / ".partial-old", (1, 1))
    os.utime(zipped_set, ns=(1, 1))

    archive.unpack(zipped_set)

    assert not (cache / ".partial-old").exists() and (cache / ".partial-new").exists()


@pytest.mark.parametrize(
    ("names", "says"),
    [
        (["a.jpg", "a.jpg"], "twice"),
        (["a.jpg", "./a.jpg"], "twice"),
        (["a", "a/b"], "cannot be unpacked"),
        (["../a"], "outside its folder"),
        (["a/../../b"], "outside its folder"),
        (["/a"], "outside its folder"),
        (["C:/a"], "outside its folder"),
        (["..\\a"], "outside its folder"),
        (["a" * 300], "cannot be unpacked"),
        (["a/"], "holds no file"),
    ],
)
@pytest.mark.filterwarnings("ignore:Duplicate name")
def test_archives_with_unsafe_names_are_rejected_and_leave_nothing(names, says, tmp_path, cache):
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as content:
        for name in names:
            content.writestr(name, "x")

    with pytest.raises(HyrfDataError, match=says) as caught:
        load_scene(tmp_path / "a.zip")
    assert "\n" not in str(caught.value) and str(tmp_path / "a.zip") in str(caught.value)
    assert not cache.exists() or list(cache.iterdir()) == []


@pytest.mark.parametrize(
    ("names", "says"),
    [
        (["top/a", "top/a/b"], "'top/a' is both a file and a folder in it"),
        (["a/b/c", "a"], "'a' is both a file and a folder in it"),
        (["a" * 300], "File name too long"),
    ],
)
def test_names_that_no_disk_can_hold_are_not_reported_as_a_lack_of_space(names, says, tmp_path):
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as content:
        for name in names:
            content.writestr(name, "x")

    with pytest.raises(HyrfDataError, match=says) as caught:
        load_scene(tmp_path / "a.zip")
    assert "make room" not in caught.value.fix


@pytest.mark.parametrize("content", [b"", b"PK\x05\x06" + bytes(10), b"no archive at all"])
def test_a_file_that_is_an_archive_only_by_name_is_rejected(content, tmp_path):
    (tmp_path / "a.zip").write_bytes(content)

    with pytest.raises(HyrfDataError, match="the archive is damaged"):
        load_scene(tmp_path / "a.zip")


@examples(150, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(names=st.lists(st.text(alphabet="ab./\\: \0é", min_size=1, max_size=8), min_size=1, max_size=4, unique=True))
@pytest.mark.filterwarnings("ignore:Duplicate name")
def test_no_name_writes_outside_the_folder(names, tmp_path_factory):
    top = tmp_path_factory.mktemp("zip")
    place = top / "1" / "2" / "3" / "4"  # deeper than the longest name can climb
    place.mkdir(parents=True)
    with zipfile.ZipFile(place / "a.zip", "w") as content:
        for name in names:
            info = zipfile.ZipInfo("x")
            info.filename = name  # set afterwards, because the constructor corrects names
            content.writestr(info, name)

    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(place / "cache"))
        try:
            folder = archive.unpack(place / "a.zip")
        except HyrfDataError as error:
            assert "\n" not in str(error)
        else:
            assert all(path.resolve().is_relative_to(folder) for path in folder.rglob("*"))
    outside = [path for path in top.rglob("*") if path.is_file() and not path.is_relative_to(place / "cache")]
    inside = [path for path in (place / "cache").rglob("*") if path.is_file()]
    assert outside == [place / "a.zip"] and all(len(path.relative_to(place).parts) > 4 for path in inside)


@examples(100, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_damaged_archives_are_read_or_rejected(zipped_set, tmp_path_factory, data):
    content = bytearray(zipped_set.read_bytes())
    for _ in range(data.draw(st.integers(1, 3))):
        at = data.draw(st.integers(0, len(content) - 1))
        content[at] ^= data.draw(st.integers(1, 255))
    if data.draw(st.booleans()):
        content = content[: data.draw(st.integers(0, len(content)))]
    damaged = tmp_path_factory.mktemp("damaged") / "a.zip"
    damaged.write_bytes(bytes(content))

    try:
        archive.unpack(damaged)
    except HyrfDataError as error:
        assert "\n" not in str(error)


def test_names_in_archives_of_macos_are_read_as_utf_8(tmp_path):
    """macOS writes UTF-8 names without the flag for it; zipfile then reads them as cp437."""

    class AsMacOSWrites(zipfile.ZipInfo):
        def _encodeFilenameFlags(self):
            return self.filename.encode(), self.flag_bits

    with zipfile.ZipFile(tmp_path / "set.zip", "w") as content:
        content.writestr(AsMacOSWrites("Straße/Müller.txt"), b"1")
    assert zipfile.ZipFile(tmp_path / "set.zip").namelist() != ["Straße/Müller.txt"]

    assert (archive.unpack(tmp_path / "set.zip") / "Müller.txt").read_bytes() == b"1"


def test_two_processes_can_unpack_the_same_archive(zipped_set, monkeypatch):
    """The folder of the other process exists when this one is about to be moved there."""
    replace = os.replace

    def after_another(partial, folder):
        shutil.copytree(partial, folder)
        replace(partial, folder)

    monkeypatch.setattr(os, "replace", after_another)

    folder = archive.unpack(zipped_set)

    assert (folder / "images" / "000.png").is_file() and [*folder.parent.iterdir()] == [folder]
