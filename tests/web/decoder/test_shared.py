"""hyrf.js reads chunks of scene folders bit by bit, and refuses references that hyrfpack refuses."""

from __future__ import annotations

import hashlib
import shutil
import zlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from web.scripts import run_script

from hyrfpack.errors import HyrfFormatError
from hyrfpack.format import describe_file, load_model
from hyrfpack.format.arrays import to_arrays
from hyrfpack.format.container import MINOR_VERSION, Section, read_container, write_container
from hyrfpack.format.shared import CODEC_SHARED
from tools.safety import minimal_reader
from tools.safety.fuzz_browser import read_in_javascript
from tools.safety.make_golden import GOLDEN_SCENE_FOLDER

READ_CHUNKS_SCRIPT = Path(__file__).with_name("read_chunks.mjs")
CHUNK_FILE_NAME, SHARED_FILE_NAME = "chunk-0000-0.hyrf", "shared.hyrf"
SECTION_TAGS = ("POSI", "COLO", "SCAL", "OPAC", "GTAB", "GMLP", "RTAB", "RMLP")
BAD_NAMES = [b"../shared.hyrf", b"", b".hyrf", b"a\0.hyrf", b"shared.txt", b"x" * 70 + b".hyrf", b"shared.hyrf\n"]


def with_section(data: bytes, tag: str, change: Callable[[Section], Section | None]) -> bytes:
    """Return a file with one section changed, or without it."""
    sections = {section.type: section for section in read_container(data).sections}
    changed = change(sections.pop(tag))
    return write_container([*sections.values(), *([changed] if changed else [])], MINOR_VERSION)


def rename(name: bytes) -> Callable[[Section], Section]:
    """Return a change of the name that a reference has."""

    def change(section: Section) -> Section:
        data = bytes(section.data[:4]) + name
        return Section(section.type, CODEC_SHARED, data, len(data), section.required)

    return change


def damage(section: Section) -> Section:
    """Return the section with a bit of its first stream flipped, under a right checksum."""
    data = bytearray(section.data)
    data[6] ^= 64
    return Section(section.type, section.codec, bytes(data), section.raw_length, section.required)


def make_folders(folder: Path, chunks: list[bytes], shared: list[bytes]) -> list[Path]:
    """Write a folder for each chunk and its shared file; return the paths of the chunks."""
    paths = []
    for number, (chunk, other) in enumerate(zip(chunks, shared, strict=True)):
        (folder / str(number)).mkdir()
        (folder / str(number) / SHARED_FILE_NAME).write_bytes(other)
        paths.append(folder / str(number) / CHUNK_FILE_NAME)
        paths[-1].write_bytes(chunk)
    return paths


def test_a_chunk_has_the_bits_and_the_provenance_that_python_reads(tmp_path: Path):
    for copy in ("first", "second"):
        shutil.copytree(GOLDEN_SCENE_FOLDER, tmp_path / copy)
    path = tmp_path / "first" / CHUNK_FILE_NAME

    answers = run_script(READ_CHUNKS_SCRIPT, path, path, tmp_path / "second" / CHUNK_FILE_NAME)

    arrays, model = to_arrays(load_model(path)), load_model(path)
    for answer in answers:
        assert answer["count"] == len(model) and answer["opened"] == [SHARED_FILE_NAME]
        assert answer["hashes"] == [hashlib.sha256(arrays[tag].tobytes()).hexdigest() for tag in SECTION_TAGS]
        assert answer["hasMap"] and answer["provenance"] == describe_file(path)["provenance"]


def test_unknown_sections_with_the_codec_of_references_are_skipped(tmp_path: Path):
    chunk, shared = ((GOLDEN_SCENE_FOLDER / name).read_bytes() for name in (CHUNK_FILE_NAME, SHARED_FILE_NAME))
    sections = read_container(chunk).sections
    unknown = [Section(tag, CODEC_SHARED, b"any bytes", 9, required=False) for tag in ("ABCD", "POS5")]
    paths = make_folders(tmp_path, [chunk, write_container([*sections, *unknown], MINOR_VERSION)], [shared, shared])

    known, extended = run_script(READ_CHUNKS_SCRIPT, *paths)

    assert known == extended and known["hashes"]
    assert len(load_model(paths[1])) == known["count"]
    minimal_reader.read(paths[1].read_bytes(), folder={SHARED_FILE_NAME: shared})


def test_references_that_python_refuses_are_refused(tmp_path: Path):
    chunk, shared = ((GOLDEN_SCENE_FOLDER / name).read_bytes() for name in (CHUNK_FILE_NAME, SHARED_FILE_NAME))
    cases = {
        **{f"name {name!r}": (with_section(chunk, "GTAB", rename(name)), shared) for name in BAD_NAMES},
        "two names": (with_section(chunk, "GTAB", rename(b"other.hyrf")), shared),
        "positions elsewhere": (with_section(chunk, "POSI", rename(b"shared.hyrf")), shared),
        "not there": (chunk, with_section(shared, "RMLP", lambda section: None)),
        "another section": (chunk, with_section(shared, "RTAB", damage)),
        "a reference to a reference": (chunk, with_section(shared, "RTAB", rename(b"shared.hyrf"))),
        "another file": (chunk, chunk),
        "no file": (chunk, b"no file"),
        "cut": (chunk, shared[:-8]),
        "damaged": (chunk, shared[:-20] + bytes([shared[-20] ^ 1]) + shared[-19:]),
    }
    paths = make_folders(tmp_path, *map(list, zip(*cases.values(), strict=True)))

    answers = run_script(READ_CHUNKS_SCRIPT, *paths)

    for name, path, answer in zip(cases, paths, answers, strict=True):
        assert "refused" in answer and "\n" not in answer["refused"], name
        with pytest.raises(HyrfFormatError):
            load_model(path)


def test_errors_in_the_shared_file_name_it(tmp_path: Path):
    """Sections are damaged under right checksums, which the references have, too, or have a wrong checksum."""
    chunk, shared = ((GOLDEN_SCENE_FOLDER / name).read_bytes() for name in (CHUNK_FILE_NAME, SHARED_FILE_NAME))

    def flip(tag: str) -> bytes:
        place = read_container(shared).entries[tag].offset
        return shared[:place] + bytes([shared[place] ^ 1]) + shared[place + 1 :]

    damaged = with_section(shared, "GTAB", damage)
    reference = zlib.crc32(read_container(damaged)["GTAB"].data).to_bytes(4, "little")
    refer = rename(SHARED_FILE_NAME.encode())
    other = with_section(
        chunk, "GTAB", lambda section: refer(replace(section, data=reference + bytes(section.data[4:])))
    )
    paths = make_folders(tmp_path, [chunk, chunk, chunk, other], [*map(flip, ("META", "GTAB", "EXPO")), damaged])

    answers = run_script(READ_CHUNKS_SCRIPT, *paths)

    for tag, answer in zip(("META", "GTAB", "EXPO"), answers, strict=False):
        assert answer["refused"].startswith(f"shared.hyrf: The file is damaged: the checksum of section '{tag}'")
    assert answers[3]["refused"].startswith("shared.hyrf: Section 'GTAB' is damaged: ")


def test_a_table_whose_groups_depend_on_points_cannot_be_referred_to(tmp_path: Path):
    """Codec 8 derives the groups of a table from the points of its own file, of which another file has others."""
    chunk, shared = ((GOLDEN_SCENE_FOLDER / name).read_bytes() for name in (CHUNK_FILE_NAME, SHARED_FILE_NAME))
    grouped = with_section(shared, "GTAB", lambda section: replace(section, codec=8))
    paths = make_folders(tmp_path, [chunk], [grouped])

    (answer,) = run_script(READ_CHUNKS_SCRIPT, *paths)

    assert answer["refused"].startswith("shared.hyrf: The file is damaged: section 'GTAB' has codec 8")
    with pytest.raises(HyrfFormatError, match="section 'GTAB' has codec 8"):
        load_model(paths[0])


def test_damaged_groups_of_a_table_are_refused(tmp_path: Path):
    """The reference has the checksum of the damaged section, so that only the decoder can find the damage."""
    shared = (GOLDEN_SCENE_FOLDER / SHARED_FILE_NAME).read_bytes()
    table = read_container(shared)["RTAB"]
    cases = []
    for data in (b"", b"\xff" * 4 + bytes(table.data[4:]), bytes(table.data[:4]), bytes(table.data[:-1])):
        section = Section("RTAB", table.codec, data, table.raw_length, table.required)
        cases.append(with_section(shared, "RTAB", lambda _, section=section: section))

    refusals = [verdict.refused for verdict in read_in_javascript([(data, False) for data in cases])]

    assert all(refusal.startswith("Section 'RTAB' is damaged") for refusal in refusals), refusals


def test_the_bytes_of_a_chunk_alone_are_refused_with_the_way_to_open_it():
    chunk = (GOLDEN_SCENE_FOLDER / CHUNK_FILE_NAME).read_bytes()

    (verdict,) = read_in_javascript([(chunk, False)])

    assert "needs shared.hyrf of its scene folder; open the folder's scene.json in a player" in verdict.refused
    assert verdict.refused.endswith("give `read` the option openFile.")
