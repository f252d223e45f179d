"""Merged files hold several models, and damaged or forged ones are refused."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from forged_files import file_with_most_gaussians
from hypothesis import given
from hypothesis import strategies as st
from scenes import small_model

from hyrfpack.edit import merge_models
from hyrfpack.errors import HyrfError, HyrfFormatError
from hyrfpack.format import describe_file, encode_model, load_merged_model, load_model, repack
from hyrfpack.format.arrays import to_arrays
from hyrfpack.format.codec import load_parts
from hyrfpack.format.container import MINOR_VERSION, Section, read_container, write_container
from hyrfpack.format.metadata import read_metadata
from hyrfpack.format.part_names import write_part_names
from hyrfpack.format.parts import encode_parts, write_parts
from tools.safety import minimal_reader
from tools.safety.make_golden import GOLDEN_MERGED_FILE, GOLDEN_PARTS, GOLDEN_SCENE_FOLDER, encode_golden_parts

GOLDEN_FOLDER = Path(__file__).parents[1] / "golden"
PAPER, COMPACT = ((GOLDEN_FOLDER / name).read_bytes() for name in ("v1.0_paper.hyrf", "v1.2_compact_exposure.hyrf"))
CHUNK_BYTES = (GOLDEN_SCENE_FOLDER / "chunk-0000-0.hyrf").read_bytes()
NAMES = ["room", "a chair, caf\u00e9"]
MERGED = encode_parts(list(zip(NAMES, (PAPER, COMPACT), strict=True)))


def write_file(folder: Path, data: bytes) -> Path:
    path = folder / "merged.hyrf"
    path.write_bytes(data)
    return path


def names_section(value: object) -> Section:
    data = json.dumps(value).encode()
    return Section("PRTS", 0, data, len(data))


def with_sections(*changed: Section, without: str = "") -> bytes:
    """Return MERGED with changed or further sections."""
    sections = {section.type: section for section in read_container(MERGED).sections if section.type != without}
    return write_container(list((sections | {section.type: section for section in changed}).values()), MINOR_VERSION)


def part(data: bytes, number: int = 1, **changes) -> Section:
    return replace(Section(f"PT{number:02d}", 10, data, len(data)), **changes)


def test_a_merged_file_holds_the_models_and_their_names(tmp_path):
    merged = load_merged_model(write_file(tmp_path, MERGED))

    assert list(merged.names) == NAMES
    for model, file in zip(merged.parts, ("v1.0_paper", "v1.2_compact_exposure"), strict=True):
        expected = load_model(GOLDEN_FOLDER / f"{file}.hyrf")
        assert model.config == expected.config
        for name, values in expected.state_dict().items():
            assert torch.equal(model.state_dict()[name], values), name
    assert [model.exposure is None for model in merged.parts] == [True, False]


def test_part_files_are_stored_unchanged():
    sections = {section.type: bytes(section.data) for section in read_container(MERGED).sections}

    assert (sections["PT00"], sections["PT01"]) == (PAPER, COMPACT)


def test_a_reader_written_from_the_specification_reads_the_same_bits(tmp_path):
    merged = load_merged_model(write_file(tmp_path, MERGED))

    read = minimal_reader.read_parts(MERGED)

    assert [name for name, _ in read] == NAMES
    for (_, (metadata, groups, _)), model in zip(read, merged.parts, strict=True):
        assert metadata["gaussians"] == len(model)
        for tag, values in to_arrays(model).items():
            assert np.array_equal(values.view(np.uint32), groups[tag].view(np.uint32)), tag


def test_a_file_of_one_model_is_read_as_its_only_part():
    merged = load_merged_model(GOLDEN_FOLDER / "v1.0_raw.hyrf")

    assert len(merged.parts) == 1
    assert len(merged) == len(load_model(GOLDEN_FOLDER / "v1.0_raw.hyrf"))


def test_the_description_is_that_of_the_scene_with_sizes_of_the_whole(tmp_path):
    facts = describe_file(write_file(tmp_path, MERGED))

    assert facts["bytes"] == len(MERGED)
    assert facts["version"] == "1.4"
    assert facts["gaussians"] == sum(part["gaussians"] for part in facts["parts"])
    assert facts["config"] == describe_file(GOLDEN_FOLDER / "v1.0_paper.hyrf")["config"]
    assert [(part["name"], part["bytes"]) for part in facts["parts"]] == list(
        zip(NAMES, (len(PAPER), len(COMPACT)), strict=True)
    )
    assert [section["type"] for section in facts["sections"]] == ["PRTS", "PT00", "PT01"]


def test_a_file_of_one_model_has_no_parts_in_its_description():
    assert "parts" not in describe_file(GOLDEN_FOLDER / "v1.0_paper.hyrf")


def test_what_needs_one_model_says_how_to_get_it(tmp_path):
    with pytest.raises(HyrfFormatError, match=r"merged models.*`part`"):
        load_model(write_file(tmp_path, MERGED))


def test_a_merged_file_is_rewritten_with_all_its_parts(tmp_path):
    path = write_file(tmp_path, MERGED)

    repack(path, tmp_path / "raw.hyrf")

    parts = [[(name, provenance) for name, _, provenance in load_parts(file)] for file in (path, tmp_path / "raw.hyrf")]
    assert parts[0] == parts[1]
    models = [load_merged_model(file).parts for file in (path, tmp_path / "raw.hyrf")]
    for one, other in zip(*models, strict=True):
        assert all(torch.equal(a, b) for a, b in zip(one.parameters(), other.parameters(), strict=True))


def test_earlier_readers_refuse_merged_files():
    """They know the section types of version 1.2, and must refuse a required section of another type."""
    entries = read_container(MERGED).entries

    assert all(entry.required for entry in entries.values())
    assert not {"META", "POSI"} & entries.keys()


BAD_NAMES = [
    [],
    ["room"],
    ["room", "room"],
    ["room", ""],
    ["room", "two\nlines"],
    ["room", "x" * 65],
    ["room", 7],
    ["room", None],
    "room",
    None,
    [f"part {number}" for number in range(65)],
]


@pytest.mark.parametrize("names", BAD_NAMES[:1] + BAD_NAMES[2:], ids=repr)
def test_names_that_are_not_valid_are_refused(tmp_path, names):
    data = with_sections(names_section({"names": names}))

    with pytest.raises(HyrfFormatError, match="names of its parts"):
        load_merged_model(write_file(tmp_path, data))
    with pytest.raises(ValueError):
        minimal_reader.read_parts(data)


@pytest.mark.parametrize("names", [[], ["a", "a"], [""], ["x" * 65], ["tab\t"], [str(n) for n in range(65)]], ids=repr)
def test_names_that_are_not_valid_are_not_written(names):
    with pytest.raises(ValueError):
        write_part_names(names)


FORGED_FILES = {
    "a part is missing": with_sections(without="PT01"),
    "a part is a merged file": with_sections(part(MERGED)),
    "a part is no file": with_sections(part(b"nothing")),
    "a part is cut": with_sections(part(COMPACT[:-8])),
    "a part refers to another file": with_sections(part(CHUNK_BYTES)),
    "a part has another codec": with_sections(part(COMPACT, codec=5)),
    "a part has another raw length": with_sections(part(COMPACT, raw_length=len(COMPACT) + 1)),
    "names are no object": with_sections(names_section(NAMES)),
    "names are not JSON": with_sections(Section("PRTS", 0, b"{", 1)),
    "names have another codec": with_sections(replace(write_part_names(NAMES), codec=5)),
    "names are too long": with_sections(names_section({"names": NAMES, "note": "x" * (1 << 16)})),
    "names are nested deeply": with_sections(Section("PRTS", 0, b"[" * 60_000, 60_000)),
}


@pytest.mark.parametrize("case", FORGED_FILES)
def test_forged_merged_files_are_refused(tmp_path, case):
    path = write_file(tmp_path, FORGED_FILES[case])

    for read in (load_merged_model, describe_file):
        with pytest.raises(HyrfFormatError):
            read(path)
    with pytest.raises((ValueError, RecursionError)):
        minimal_reader.read_parts(path.read_bytes())


def test_parts_together_may_not_claim_more_than_the_limits_of_one_file(tmp_path):
    """Each of these parts is within the limits of its own size; 64 of them are not within those of their file."""
    small = read_container(encode_model(small_model(np.zeros((0, 3))))).sections
    large = write_container([*small, Section("NOTE", 5, b"x", 3 << 24, required=False)], MINOR_VERSION)
    read_container(large)

    sections = [write_part_names([str(number) for number in range(64)]), *(part(large, n) for n in range(64))]
    path = write_file(tmp_path, write_container(sections, MINOR_VERSION))

    with pytest.raises(HyrfFormatError, match="more than"):
        load_merged_model(path)
    with pytest.raises(ValueError):
        minimal_reader.read_parts(path.read_bytes())


@given(st.data())
def test_damaged_bytes_of_a_merged_file_raise_only_format_errors(tmp_path_factory, data):
    place = data.draw(st.integers(0, len(MERGED) - 1))
    damaged = bytearray(MERGED)
    damaged[place] ^= data.draw(st.integers(1, 255))
    path = write_file(tmp_path_factory.mktemp("damaged"), bytes(damaged))

    with pytest.raises(HyrfFormatError):
        load_merged_model(path)


@given(st.integers(0, len(MERGED) - 1))
def test_a_truncated_merged_file_is_refused(tmp_path_factory, length):
    path = write_file(tmp_path_factory.mktemp("cut"), MERGED[:length])

    with pytest.raises(HyrfFormatError):
        load_merged_model(path)


def test_the_golden_merged_file_is_read_and_written_as_before():
    merged = load_merged_model(GOLDEN_MERGED_FILE)

    assert list(merged.names) == list(GOLDEN_PARTS)
    for model, file in zip(merged.parts, GOLDEN_PARTS.values(), strict=True):
        for name, values in load_model(GOLDEN_FOLDER / f"{file}.hyrf").state_dict().items():
            assert torch.equal(model.state_dict()[name], values), name
    assert encode_golden_parts() == GOLDEN_MERGED_FILE.read_bytes()


def test_the_same_parts_give_the_same_bytes(tmp_path):
    written = write_parts(list(zip(NAMES, (PAPER, COMPACT), strict=True)), tmp_path / "again.hyrf").file

    assert Path(written).read_bytes() == MERGED


def test_parts_with_and_without_antialiasing_are_refused_in_one_line(tmp_path):
    files = [encode_model(small_model(np.zeros((3, 3)), antialiased=antialiased)) for antialiased in (False, True)]
    sections = [write_part_names(["a", "b"]), *(part(file, number) for number, file in enumerate(files))]
    path = write_file(tmp_path, write_container(sections, MINOR_VERSION))

    for read in (load_merged_model, load_parts, describe_file):
        with pytest.raises(HyrfFormatError, match=r"merged.hyrf: some of its parts are antialiased and others are not"):
            read(path)
    with pytest.raises(ValueError, match="antialiased"):
        minimal_reader.read_parts(path.read_bytes())
    with pytest.raises(HyrfFormatError, match="some of its parts are antialiased and others are not"):
        encode_parts([("a", files[0]), ("b", files[1])])


def test_parts_together_may_not_claim_more_gaussians_than_one_file(tmp_path):
    """A file of a kilobyte may hold 2^18 Gaussians; so may not two in a file of two kilobytes."""
    data = file_with_most_gaussians()
    sections = [write_part_names(["a", "b"]), part(data, 0), part(data, 1)]
    path = write_file(tmp_path, write_container(sections, MINOR_VERSION))

    for read in (load_merged_model, load_parts, describe_file):
        with pytest.raises(HyrfFormatError, match=r"parts claim 524,088 Gaussians.*the file is damaged"):
            read(path)
    with pytest.raises(HyrfError, match=r"parts claim 524,088 Gaussians.*merge fewer models"):
        encode_parts([("a", data), ("b", data)])


def test_a_damaged_part_is_not_blamed_on_the_number_of_models():
    with pytest.raises(HyrfError, match="part 'b': .*copy or write it again") as error:
        encode_parts([("a", PAPER), ("b", COMPACT[:-8])])
    assert "fewer models" not in str(error.value)


def test_an_error_of_a_configuration_names_the_file_and_the_part(tmp_path):
    container = read_container(PAPER)
    metadata = read_metadata(container)
    changed = replace(metadata, config={**metadata.config, "hidden": 5000}).to_section()
    data = write_container([changed, *(each for each in container.sections if each.type != "META")], MINOR_VERSION)
    path = write_file(tmp_path, encode_parts([("room", PAPER), ("chair", data)]))

    for read in (load_merged_model, lambda file: merge_models([file], tmp_path / "again.hyrf")):
        with pytest.raises(HyrfFormatError, match=r"merged.hyrf: part 'chair': the model's configuration is not valid"):
            read(path)


def test_an_optional_section_of_unknown_type_with_the_number_of_a_reference_is_skipped(tmp_path):
    note = Section("NOTE", 12, b"\0" * 16, 16, required=False)
    data = write_container([*read_container(PAPER).sections, note], MINOR_VERSION)

    merged = load_merged_model(write_file(tmp_path, encode_parts([("a", data), ("b", COMPACT)])))

    assert list(merged.names) == ["a", "b"]
