"""The files of a scene, in a folder or in a .zip: what cannot be read is a format error, whatever the cause."""

from __future__ import annotations

import json
import multiprocessing
import os
import pickle
import shutil
import zipfile
import zlib
from functools import partial
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hyrfpack.errors import HyrfError, HyrfFormatError
from hyrfpack.format import describe_file, load_model, repack
from hyrfpack.format.scene_folder import SceneFolder, is_scene
from tools.safety.make_golden import GOLDEN_SCENE_FOLDER

ZIP_METHODS = [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA]


def write_zip(path: Path, method: int, changed: dict[str, bytes] | None = None) -> Path:
    """Write a .zip of the golden scene, in which some files have other bytes."""
    with zipfile.ZipFile(path, "w", method) as archive:
        for file in sorted(GOLDEN_SCENE_FOLDER.iterdir()):
            archive.writestr(file.name, (changed or {}).get(file.name, file.read_bytes()))
    return path


@pytest.fixture(scope="module")
def archives(tmp_path_factory) -> list[bytes]:
    folder = tmp_path_factory.mktemp("archives")
    return [write_zip(folder / "scene.zip", method).read_bytes() for method in ZIP_METHODS]


@pytest.mark.parametrize("method", ZIP_METHODS)
def test_an_archive_of_any_method_is_read_like_the_folder(tmp_path, method):
    archive = write_zip(tmp_path / "scene.zip", method)

    assert is_scene(archive) and describe_file(archive) == describe_file(GOLDEN_SCENE_FOLDER)
    assert len(load_model(archive)) == len(load_model(GOLDEN_SCENE_FOLDER))


@given(st.data())
def test_a_damaged_archive_is_read_or_refused_without_another_exception(archives, tmp_path_factory, data):
    damaged = bytearray(data.draw(st.sampled_from(archives)))
    is_at_end = data.draw(st.booleans())  # where the directory is
    for _ in range(data.draw(st.integers(1, 4))):
        low = len(damaged) - 600 if is_at_end else 0
        damaged[data.draw(st.integers(low, len(damaged) - 1))] = data.draw(st.integers(0, 255))
    path = tmp_path_factory.mktemp("damaged") / "scene.zip"
    path.write_bytes(damaged)

    is_scene(path)
    for read in (SceneFolder, describe_file, load_model):
        try:
            read(path)
        except HyrfError as error:
            assert str(error).isprintable()


def with_entry_bytes(data: bytes, local: int, central: int, change: bytes) -> bytes:
    """Return an archive with other bytes at these places in both headers of each of its files."""
    changed, end = bytearray(data), bytes(data)
    for magic, place in ((b"PK\x03\x04", local), (b"PK\x01\x02", central)):
        at = end.find(magic)
        while at >= 0:
            changed[at + place : at + place + len(change)] = change
            at = end.find(magic, at + 4)
    return bytes(changed)


UNUSUAL_ARCHIVES = {
    "encrypted": lambda data: with_entry_bytes(data, 6, 8, b"\1\0"),
    "unknown method": lambda data: with_entry_bytes(data, 8, 10, b"\x63\0"),
    "newer version": lambda data: with_entry_bytes(data, 4, 6, b"\xff\0"),
    "name that is no UTF-8": lambda data: with_entry_bytes(
        with_entry_bytes(data, 6, 8, b"\0\x08"), 30, 46, b"\xff\xfe"
    ),
    "cut": lambda data: data[: len(data) // 2],
    "empty": lambda data: b"",
}


@pytest.mark.parametrize("case", UNUSUAL_ARCHIVES)
def test_an_unusual_archive_is_no_scene(archives, tmp_path, case):
    path = tmp_path / "scene.zip"
    path.write_bytes(UNUSUAL_ARCHIVES[case](archives[1]))

    assert not is_scene(path)
    with pytest.raises(HyrfFormatError, match=r"scene.zip"):
        SceneFolder(path)
    with pytest.raises(HyrfFormatError):
        load_model(path)


@pytest.mark.parametrize("name", ["scene.json", "shared.hyrf", "chunk-0000-0.hyrf", "new.hyrf"])
def test_nothing_is_decompressed_into_the_scene_folder_that_is_read(tmp_path, name):
    folder = Path(shutil.copytree(GOLDEN_SCENE_FOLDER, tmp_path / "scene"))

    for source in (folder, folder / "scene.json"):
        with pytest.raises(HyrfError, match="the output is an input itself|reads what lies in this folder"):
            repack(source, folder / name)
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == {
        path.name: path.read_bytes() for path in GOLDEN_SCENE_FOLDER.iterdir()
    }


def test_a_path_with_a_nul_character_is_no_scene():
    assert not is_scene("a\0b/scene.json") and not is_scene("a\0b.zip")
    with pytest.raises(HyrfFormatError):
        load_model("a\0b/scene.json")


def test_a_file_of_an_archive_that_unpacks_to_much_more_is_not_read(tmp_path):
    """LZMA packs these zeros at 6,000 to 1; no `.hyrf` file may decode to more than 1,024 to 1 beyond 48 MiB."""
    zeros = bytes(60_000_000)
    manifest = json.loads((GOLDEN_SCENE_FOLDER / "scene.json").read_text())
    manifest["shared"] |= {"bytes": len(zeros), "crc32": f"{zlib.crc32(zeros):08x}"}
    changed = {"scene.json": json.dumps(manifest).encode(), "shared.hyrf": zeros}
    path = write_zip(tmp_path / "scene.zip", zipfile.ZIP_LZMA, changed)

    with pytest.raises(HyrfFormatError, match=r"shared.hyrf: its [\d,]+ bytes would unpack to 60,000,000, more than"):
        load_model(path)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="this system has no named pipes")
@pytest.mark.parametrize("name", ["scene.json", "shared.hyrf", "chunk-0000-0.hyrf"])
def test_a_named_pipe_among_the_files_is_refused_without_waiting_for_a_writer(tmp_path, name):
    folder = Path(shutil.copytree(GOLDEN_SCENE_FOLDER, tmp_path / "scene"))
    (folder / name).unlink()
    os.mkfifo(folder / name)

    with pytest.raises(HyrfFormatError, match=f"{name}: (this is not a regular file|the manifest says)"):
        SceneFolder(folder).load()


def read_often(scene: SceneFolder, failures: multiprocessing.Queue) -> None:
    count = 0
    for _ in range(50):
        for item in scene.manifest.files:
            try:
                scene.read_file(item)
            except HyrfFormatError:
                count += 1
    failures.put(count)


@pytest.mark.integration
@pytest.mark.skipif("fork" not in multiprocessing.get_all_start_methods(), reason="processes cannot fork")
def test_forked_processes_read_an_archive_at_once(tmp_path):
    scene = SceneFolder(write_zip(tmp_path / "scene.zip", zipfile.ZIP_STORED))
    fork = multiprocessing.get_context("fork")
    failures = fork.Queue()
    processes = [fork.Process(target=read_often, args=(scene, failures)) for _ in range(2)]
    for process in processes:
        process.start()
    assert [failures.get(timeout=60) for _ in processes] == [0, 0]
    for process in processes:
        process.join()


def test_a_scene_is_pickled_and_closed_and_still_read(tmp_path):
    scene = SceneFolder(write_zip(tmp_path / "scene.zip", zipfile.ZIP_STORED))
    count = len(scene.load_chunk(0))
    scene.close()
    assert len(scene.load_chunk(0)) == count
    assert len(pickle.loads(pickle.dumps(scene)).load_chunk(0)) == count


def test_running_out_of_memory_is_no_damage_of_an_archive(tmp_path, monkeypatch):
    path = write_zip(tmp_path / "scene.zip", zipfile.ZIP_STORED)

    def fail(*_, **__):
        raise MemoryError

    monkeypatch.setattr(zipfile.ZipFile, "open", fail)
    with pytest.raises(MemoryError):
        is_scene(path)


def test_a_caller_that_changes_provenances_changes_no_later_ones():
    scene = SceneFolder(GOLDEN_SCENE_FOLDER)
    scene.read_provenances()[0]["added"] = 1
    assert "added" not in scene.read_provenances()[0]


def test_no_fraction_of_a_scene_folder_is_read(tmp_path):
    for call in (load_model, describe_file, partial(repack, target=tmp_path / "x.hyrf")):
        with pytest.raises(HyrfFormatError, match="has levels in place of layers.*leave out `fraction`"):
            call(GOLDEN_SCENE_FOLDER, fraction=0.5)
