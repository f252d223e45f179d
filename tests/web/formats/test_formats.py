"""Splats of other programs, dropped on the player: what its readers make of them, and what they refuse."""

from __future__ import annotations

import gzip
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from made_up_splats import damage_file, random_splats
from splats.formats import test_compressed_ply, test_ply, test_splat, test_spz
from splats.formats.test_spz import file_of, sections_of_one
from web.formats.comparison import PageSplats, read_in_node

from hyrfpack.errors import HyrfDataError
from hyrfpack.splats.formats.hints import Hints
from hyrfpack.splats.splats import Splats
from hyrfpack.splats.table import FORMATS

IN_NODE = (".ply", ".splat", ".spz")  # .sog holds pictures, which browsers unpack


def in_python(name: str, data: bytes) -> Splats | None:
    """None where Python refuses it."""
    try:
        return FORMATS[Path(name).suffix].decode(data, name)
    except HyrfDataError:
        return None


def assert_same(folder: Path, files: list[tuple[str, bytes]]) -> int:
    """The player reads what Python reads, and refuses what Python refuses. How many files were refused."""
    answers, _ = read_in_node(folder, files)
    refused = 0
    for (name, data), answer in zip(files, answers, strict=True):
        expected = in_python(name, data)
        if isinstance(answer, PageSplats):
            assert expected is not None, f"{name} is read"
            answer.assert_are(expected)
        else:
            assert expected is None, answer
            refused += 1
    return refused


def spz3(splats: Splats) -> bytes:
    return FORMATS[".spz"].encode(splats, Hints(spz_version=3))


@pytest.mark.parametrize("ending", IN_NODE)
def test_files_are_read_as_python_reads_them(ending: str, tmp_path: Path) -> None:
    kinds = [random_splats(count, degree) for count in (0, 1, 600) for degree in range(4)]
    kinds += [replace(random_splats(50, 2), antialiased=True), random_splats(300, 1, shift=(4e5, -3e4, 7.0))]
    encode = spz3 if ending == ".spz" else FORMATS[ending].encode
    if ending == ".splat":
        kinds = [splats.with_degree(0) for splats in kinds]
    assert assert_same(tmp_path, [(f"{k}{ending}", encode(splats)) for k, splats in enumerate(kinds)]) == 0


def test_variants_of_ply_are_read_as_python_reads_them(tmp_path: Path) -> None:
    names, values = test_ply.NAMES, np.random.default_rng(3).normal(size=(5, 14))
    text = "\n".join(" ".join(f"{v:.9g}" for v in row) for row in values) + "\n"
    higher = [f"f_rest_{i}" for i in range(72)]
    infinite = values.copy()
    infinite[:, 6], infinite[:, 7:10] = np.inf, -np.inf
    variants = [
        test_ply.file_of(names[::-1], "double", values.tobytes(), 5),
        test_ply.file_of(names, "float", values.astype(">f4").tobytes(), 5, "binary_big_endian"),
        test_ply.file_of(names, "float32", values.astype("<f4").tobytes(), 5, before="element a 0\nproperty char b"),
        test_ply.file_of(names, "int", np.arange(14, dtype="<i4").tobytes(), 1),
        test_ply.file_of(names, "float", f"\n{text}\n".replace("\n", "\r\n").encode(), 5, "ascii"),
        test_ply.file_of(
            names, "float", b"1 2 3\n" + text.encode(), 5, "ascii", "element face 1\nproperty list int int f"
        ),
        test_ply.file_of([*names, *higher], "double", np.tile(np.arange(86.0), 2).tobytes(), 2),
        test_ply.file_of(names, "double", infinite.tobytes(), 5),
        test_ply.file_of(names, "double", np.zeros((3, 14)).tobytes(), 3),
        *(test_compressed_ply.file_of(count, test_compressed_ply.WORDS, colored, rest)
          for count, colored, rest in ((0, True, 9), (1, False, 0), (300, True, 45), (257, False, 24))),
    ]  # fmt: skip
    assert assert_same(tmp_path, [("a.ply", data) for data in variants]) == 0


def test_every_version_of_spz_with_gzip_is_read_as_python_reads_it(tmp_path: Path) -> None:
    variants = [
        file_of(sections_of_one(version, degree), version, degree) for version in (1, 2, 3) for degree in (0, 4)
    ]
    variants += [file_of([*sections_of_one(3), b"more"], 3, flags=2)]
    assert assert_same(tmp_path, [("a.spz", data) for data in variants]) == 0


def test_spz_4_is_read_or_refused_in_a_sentence_that_says_why(tmp_path: Path) -> None:
    splats = random_splats(200, 3)
    files = [("a.spz", FORMATS[".spz"].encode(splats, Hints(spz_version=4)))]
    (answer,), _ = read_in_node(tmp_path, files)
    if isinstance(answer, PageSplats):  # where zstd is known
        answer.assert_are(FORMATS[".spz"].decode(files[0][1], "a.spz"))
    else:
        assert "packed by zstd, which this browser cannot unpack" in answer


@pytest.mark.parametrize(
    "file", ["inria_sh3_small.ply", "playbot_lod3_sh2.ply", "biker.compressed.ply", "small_scene.splat"]
)
def test_files_of_other_programs_are_read_as_python_reads_them(file: str, shared_data: Path, tmp_path: Path) -> None:
    folder = shared_data / "trained_models"
    if not folder.is_dir():
        pytest.skip(f"trained models not found at {folder}")
    assert assert_same(tmp_path, [(file, (folder / file).read_bytes())]) == 0


def refusals(module: object) -> list[bytes]:
    """The files that a test of Python's reader has refused."""
    (mark,) = (mark for mark in module.test_decode_refuses_with_a_sentence.pytestmark if mark.name == "parametrize")
    return [case[0] for case in mark.args[1]]


def test_what_python_refuses_is_refused(tmp_path: Path) -> None:
    files = [("a.splat", data) for data in refusals(test_splat)]
    files += [("a.ply", data) for data in refusals(test_compressed_ply)[1:]]  # the first is a plain one
    files += [("a.spz", data) for data in refusals(test_spz)]
    (mark,) = (m for m in test_ply.test_read_ply_refuses_with_a_sentence.pytestmark if m.name == "parametrize")
    files += [("a.ply", case[0]) for case in mark.args[1]]
    assert assert_same(tmp_path, files) == len(files)


def test_damaged_files_meet_the_verdict_of_python(tmp_path: Path) -> None:
    rng = np.random.default_rng(7)
    text = " ".join(["0.5"] * 14)
    whole = [
        ("a.ply", FORMATS[".ply"].encode(random_splats(5, 1))),
        ("a.ply", test_ply.file_of(test_ply.NAMES, "float", f"{text}\n{text}\n".encode(), 2, "ascii")),
        ("a.ply", test_compressed_ply.file_of(5, test_compressed_ply.WORDS, colored=True, rest=9)),
        ("a.splat", FORMATS[".splat"].encode(random_splats(5, 0))),
    ]
    files = []
    for _ in range(100):
        for name, data in whole:
            places = (rng.random(rng.integers(1, 4)) ** 3).clip(0, 0.999)  # mostly near the start
            edits = [(place, rng.bytes(rng.integers(0, 3))) for place in places]
            files.append((name, damage_file(data, edits, rng.choice([1.0, 1.0, 0.9, 0.3]))))
        inside = bytearray(gzip.decompress(spz3(random_splats(20, 1))))
        for place in rng.random(2) ** 4:
            inside[int(place * len(inside))] = rng.integers(256)
        files.append(("a.spz", gzip.compress(bytes(inside))))
        files.append(
            ("a.spz", damage_file(spz3(random_splats(20, 1)), [(rng.random(), rng.bytes(1))], rng.choice([1.0, 0.7])))
        )
    refused = assert_same(tmp_path, files)
    assert len(files) / 4 < refused < len(files)


def test_small_files_that_promise_much_take_no_memory(tmp_path: Path) -> None:
    _, usual = read_in_node(tmp_path, [("a.splat", bytes(32))])
    bombs = [
        ("a.spz", file_of([*sections_of_one(3), bytes(400_000_000)], 3)),
        ("b.spz", gzip.compress(struct.pack("<4sIIBBBB", b"NGSP", 3, 4_000_000, 0, 8, 0, 0) + bytes(80_000_000))),
        ("a.ply", test_ply.GOOD.replace(b"vertex 1\n", b"vertex 99999999999\n")),
        ("b.ply", test_ply.file_of(test_ply.NAMES, "float", b"1 2 3\n", 999_999_999, "ascii")),
    ]
    (tmp_path / "bombs").mkdir()
    answers, kilobytes = read_in_node(tmp_path / "bombs", bombs)
    assert all(isinstance(answer, str) for answer in answers)
    assert kilobytes < usual + 40_000


def test_readers_are_chosen_by_the_ending_or_by_how_a_file_begins(tmp_path: Path) -> None:
    splats = random_splats(3, 1)
    ply, spz = FORMATS[".ply"].encode(splats), spz3(splats)
    files = [
        ("scene.PLY", ply),
        ("scene", ply),
        ("scene", spz),
        ("scene.bin", b"PK\3\4"),
        ("scene.txt", b"hello"),
        ("empty", b""),
    ]
    (first, second, third, zip_file, other, nothing), _ = read_in_node(tmp_path, files)
    for answer in (first, second):
        answer.assert_are(FORMATS[".ply"].decode(ply, ""))
    third.assert_are(FORMATS[".spz"].decode(spz, ""))
    assert "zip" in zip_file
    for sentence in (other, nothing):
        assert "it is none of .ply, .spz, .splat, .sog; convert it to one of them" in sentence
