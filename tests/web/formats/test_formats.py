"""The player's readers of splats return the same splats as Python's and refuse the same files."""

from __future__ import annotations

import gzip
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from made_up_splats import damage_file, random_splats
from splats.formats import test_compressed_ply, test_ply, test_splat, test_spz
from splats.formats.test_spz import build_spz, sections_of_one_gaussian
from web.formats.comparison import PageSplats, read_in_node

from hyrfpack.errors import HyrfDataError
from hyrfpack.splats.formats.hints import Hints
from hyrfpack.splats.splats import Splats
from hyrfpack.splats.table import FORMATS

SUFFIXES_READ_IN_NODE = (".ply", ".splat", ".spz")  # .sog contains pictures, which only browsers decode


def read_in_python(name: str, data: bytes) -> Splats | None:
    """Decode a file with Python's reader; return None if it refuses the file."""
    try:
        return FORMATS[Path(name).suffix].decode(data, name)
    except HyrfDataError:
        return None


def check_readers_agree(folder: Path, files: list[tuple[str, bytes]]) -> int:
    """Assert that the player reads and refuses the same files as Python; return the number of refused files."""
    answers, _ = read_in_node(folder, files)
    refused = 0
    for (name, data), answer in zip(files, answers, strict=True):
        expected = read_in_python(name, data)
        if isinstance(answer, PageSplats):
            assert expected is not None, f"{name} is read"
            answer.assert_equal(expected)
        else:
            assert expected is None, answer
            refused += 1
    return refused


def encode_spz_3(splats: Splats) -> bytes:
    return FORMATS[".spz"].encode(splats, Hints(spz_version=3))


@pytest.mark.parametrize("ending", SUFFIXES_READ_IN_NODE)
def test_files_of_hyrfpack_are_read_as_in_python(ending: str, tmp_path: Path) -> None:
    kinds = [random_splats(count, degree) for count in (0, 1, 600) for degree in range(4)]
    kinds += [replace(random_splats(50, 2), antialiased=True), random_splats(300, 1, shift=(4e5, -3e4, 7.0))]
    encode = encode_spz_3 if ending == ".spz" else FORMATS[ending].encode
    if ending == ".splat":
        kinds = [splats.with_degree(0) for splats in kinds]
    assert check_readers_agree(tmp_path, [(f"{k}{ending}", encode(splats)) for k, splats in enumerate(kinds)]) == 0


def test_variants_of_ply_are_read_as_in_python(tmp_path: Path) -> None:
    names, values = test_ply.PROPERTY_NAMES, np.random.default_rng(3).normal(size=(5, 14))
    text = "\n".join(" ".join(f"{v:.9g}" for v in row) for row in values) + "\n"
    higher = [f"f_rest_{i}" for i in range(72)]
    infinite = values.copy()
    infinite[:, 6], infinite[:, 7:10] = np.inf, -np.inf
    variants = [
        test_ply.build_ply(names[::-1], "double", values.tobytes(), 5),
        test_ply.build_ply(names, "float", values.astype(">f4").tobytes(), 5, "binary_big_endian"),
        test_ply.build_ply(names, "float32", values.astype("<f4").tobytes(), 5, before="element a 0\nproperty char b"),
        test_ply.build_ply(names, "int", np.arange(14, dtype="<i4").tobytes(), 1),
        test_ply.build_ply(names, "float", f"\n{text}\n".replace("\n", "\r\n").encode(), 5, "ascii"),
        test_ply.build_ply(
            names, "float", b"1 2 3\n" + text.encode(), 5, "ascii", "element face 1\nproperty list int int f"
        ),
        test_ply.build_ply([*names, *higher], "double", np.tile(np.arange(86.0), 2).tobytes(), 2),
        test_ply.build_ply(names, "double", infinite.tobytes(), 5),
        test_ply.build_ply(names, "double", np.zeros((3, 14)).tobytes(), 3),
        *(test_compressed_ply.build_compressed_ply(count, test_compressed_ply.PACKED_WORDS, colored, rest)
          for count, colored, rest in ((0, True, 9), (1, False, 0), (300, True, 45), (257, False, 24))),
    ]  # fmt: skip
    assert check_readers_agree(tmp_path, [("a.ply", data) for data in variants]) == 0


def test_every_version_of_spz_with_gzip_is_read_as_in_python(tmp_path: Path) -> None:
    variants = [
        build_spz(sections_of_one_gaussian(version, degree), version, degree)
        for version in (1, 2, 3)
        for degree in (0, 4)
    ]
    variants += [build_spz([*sections_of_one_gaussian(3), b"more"], 3, flags=2)]
    assert check_readers_agree(tmp_path, [("a.spz", data) for data in variants]) == 0


def test_spz_4_is_read_or_refused_with_the_reason(tmp_path: Path) -> None:
    splats = random_splats(200, 3)
    files = [("a.spz", FORMATS[".spz"].encode(splats, Hints(spz_version=4)))]
    (answer,), _ = read_in_node(tmp_path, files)
    if isinstance(answer, PageSplats):  # this node supports zstd
        answer.assert_equal(FORMATS[".spz"].decode(files[0][1], "a.spz"))
    else:
        assert "packed by zstd, which this browser cannot unpack" in answer


@pytest.mark.parametrize(
    "file", ["inria_sh3_small.ply", "playbot_lod3_sh2.ply", "biker.compressed.ply", "small_scene.splat"]
)
def test_files_of_other_programs_are_read_as_in_python(file: str, shared_data: Path, tmp_path: Path) -> None:
    folder = shared_data / "trained_models"
    if not folder.is_dir():
        pytest.skip(f"trained models not found at {folder}")
    assert check_readers_agree(tmp_path, [(file, (folder / file).read_bytes())]) == 0


def files_refused_in_test(module: object) -> list[bytes]:
    """Return the files that the test of a Python reader expects to be refused."""
    (mark,) = (
        mark for mark in module.test_invalid_files_are_refused_with_the_reason.pytestmark if mark.name == "parametrize"
    )
    return [case[0] for case in mark.args[1]]


def test_files_that_python_refuses_are_refused(tmp_path: Path) -> None:
    files = [("a.splat", data) for data in files_refused_in_test(test_splat)]
    # The first is an uncompressed PLY.
    files += [("a.ply", data) for data in files_refused_in_test(test_compressed_ply)[1:]]
    files += [("a.spz", data) for data in files_refused_in_test(test_spz)]
    (mark,) = (m for m in test_ply.test_invalid_files_are_refused_with_the_reason.pytestmark if m.name == "parametrize")
    files += [("a.ply", case[0]) for case in mark.args[1]]
    assert check_readers_agree(tmp_path, files) == len(files)


def test_damaged_files_are_read_or_refused_as_in_python(tmp_path: Path) -> None:
    rng = np.random.default_rng(7)
    text = " ".join(["0.5"] * 14)
    whole = [
        ("a.ply", FORMATS[".ply"].encode(random_splats(5, 1))),
        ("a.ply", test_ply.build_ply(test_ply.PROPERTY_NAMES, "float", f"{text}\n{text}\n".encode(), 2, "ascii")),
        ("a.ply", test_compressed_ply.build_compressed_ply(5, test_compressed_ply.PACKED_WORDS, colored=True, rest=9)),
        ("a.splat", FORMATS[".splat"].encode(random_splats(5, 0))),
    ]
    files = []
    for _ in range(100):
        for name, data in whole:
            places = (rng.random(rng.integers(1, 4)) ** 3).clip(0, 0.999)  # most edits are near the start
            edits = [(place, rng.bytes(rng.integers(0, 3))) for place in places]
            files.append((name, damage_file(data, edits, rng.choice([1.0, 1.0, 0.9, 0.3]))))
        inside = bytearray(gzip.decompress(encode_spz_3(random_splats(20, 1))))
        for place in rng.random(2) ** 4:
            inside[int(place * len(inside))] = rng.integers(256)
        files.append(("a.spz", gzip.compress(bytes(inside))))
        files.append(
            (
                "a.spz",
                damage_file(encode_spz_3(random_splats(20, 1)), [(rng.random(), rng.bytes(1))], rng.choice([1.0, 0.7])),
            )
        )
    refused = check_readers_agree(tmp_path, files)
    assert len(files) / 4 < refused < len(files)


@pytest.mark.acceptance
def test_small_files_that_declare_many_splats_take_little_memory(tmp_path: Path) -> None:
    _, usual = read_in_node(tmp_path, [("a.splat", bytes(32))])
    bombs = [
        ("a.spz", build_spz([*sections_of_one_gaussian(3), bytes(400_000_000)], 3)),
        ("b.spz", gzip.compress(struct.pack("<4sIIBBBB", b"NGSP", 3, 4_000_000, 0, 8, 0, 0) + bytes(80_000_000))),
        ("a.ply", test_ply.VALID_FILE.replace(b"vertex 1\n", b"vertex 99999999999\n")),
        ("b.ply", test_ply.build_ply(test_ply.PROPERTY_NAMES, "float", b"1 2 3\n", 999_999_999, "ascii")),
    ]
    (tmp_path / "bombs").mkdir()
    answers, kilobytes = read_in_node(tmp_path / "bombs", bombs)
    assert all(isinstance(answer, str) for answer in answers)
    assert kilobytes < usual + 40_000


def test_the_reader_is_chosen_by_suffix_or_first_bytes(tmp_path: Path) -> None:
    splats = random_splats(3, 1)
    ply, spz = FORMATS[".ply"].encode(splats), encode_spz_3(splats)
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
        answer.assert_equal(FORMATS[".ply"].decode(ply, ""))
    third.assert_equal(FORMATS[".spz"].decode(spz, ""))
    assert "zip" in zip_file
    for sentence in (other, nothing):
        assert "it is neither a .hyrf file nor one of .ply, .spz, .splat, .sog; fetch it again" in sentence
