"""Sections that lie in another file: partial files, unknown sections, and copies that hold all of their sections."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
import torch

from hyrfpack.config.edit import Scale
from hyrfpack.edit import merge_models
from hyrfpack.errors import HyrfFormatError
from hyrfpack.format import load_model
from hyrfpack.format.arrays import read_config
from hyrfpack.format.container import MINOR_VERSION, Container, Section, read_container, write_container
from hyrfpack.format.rewrite import with_metadata
from hyrfpack.format.sections import SECTION_CONTENTS
from hyrfpack.format.shared import CODEC_SHARED, refer_to_section, self_contained_bytes
from tools.safety import minimal_reader
from tools.safety.make_golden import GOLDEN_FOLDER, GOLDEN_SCENE_FOLDER

CHUNK_NAME, SHARED_NAME = "chunk-0000-0.hyrf", "shared.hyrf"
UNKNOWN_SECTION = Section("NOTE", 0, b"any bytes", 9, required=False)
MODEL_PATHS = [GOLDEN_FOLDER / f"{name}.hyrf" for name in ("v1.0_paper", "v1.2_compact_exposure")]


@pytest.fixture
def chunk(tmp_path) -> Path:
    return Path(shutil.copytree(GOLDEN_SCENE_FOLDER, tmp_path / "scene"), CHUNK_NAME)


def write_sections(path: Path, sections: list[Section]) -> None:
    path.write_bytes(write_container(sections, MINOR_VERSION))


def move_references_to_the_end(path: Path) -> list[int]:
    """Rewrite a chunk with its references last, the table of the geometry field last of all; return their ends."""
    sections = read_container(path.read_bytes()).sections
    write_sections(path, sorted(sections, key=lambda section: (section.codec == CODEC_SHARED, section.type == "GTAB")))
    return [entry.end for entry in read_container(path.read_bytes()).entries.values() if entry.codec == CODEC_SHARED]


@pytest.mark.parametrize("available", [0, 1, 4])
def test_a_partial_file_without_all_references_says_how_many_bytes_it_needs(chunk, available):
    ends = move_references_to_the_end(chunk)
    data = chunk.read_bytes()
    chunk.write_bytes(data[: ends[available] - 1])

    with pytest.raises(HyrfFormatError, match=f"the model needs the first {len(data):,} of {len(data):,} bytes"):
        load_model(chunk, fraction=1.0)


def test_a_reference_that_is_cut_off_needs_no_section_in_the_other_file(chunk):
    ends = move_references_to_the_end(chunk)
    chunk.write_bytes(chunk.read_bytes()[: ends[-1] - 1])
    shared = chunk.with_name(SHARED_NAME)
    write_sections(shared, [part for part in read_container(shared.read_bytes()).sections if part.type != "GTAB"])

    with pytest.raises(HyrfFormatError, match="the model needs the first"):
        load_model(chunk, fraction=1.0)


def test_a_table_whose_groups_depend_on_points_cannot_be_referred_to(chunk):
    """Codec 8 derives the groups of a table from the points of its own file, of which another file has others."""
    shared = chunk.with_name(SHARED_NAME)
    tables = {part.type: part for part in read_container(MODEL_PATHS[1].read_bytes()).sections}
    kept = [part for part in read_container(shared.read_bytes()).sections if part.type != "GTAB"]
    write_sections(shared, [*kept, tables["GTAB"]])
    entries = read_container(shared.read_bytes()).entries
    own = [part for part in read_container(chunk.read_bytes()).sections if part.codec != CODEC_SHARED]
    references = [refer_to_section(entries[tag], SHARED_NAME) for tag in ("GTAB", "RTAB", "GMLP", "RMLP")]
    write_sections(chunk, [*own, *references])

    with pytest.raises(HyrfFormatError, match="shared.hyrf: section 'GTAB' has codec 8"):
        load_model(chunk)
    with pytest.raises(ValueError, match="GTAB"):
        minimal_reader.read(chunk.read_bytes(), folder={SHARED_NAME: shared.read_bytes()})


@pytest.mark.parametrize("path", MODEL_PATHS, ids=lambda path: path.stem)
def test_a_file_with_an_unknown_optional_section_gets_other_metadata(path):
    sections = read_container(path.read_bytes()).sections
    container = read_container(write_container([*sections, UNKNOWN_SECTION], MINOR_VERSION), SECTION_CONTENTS)

    data = with_metadata(container, read_config(container), {"note": "moved"})

    rewritten = {part.type: bytes(part.data) for part in read_container(data).sections if part.type != "META"}
    assert rewritten == {part.type: bytes(part.data) for part in sections if part.type != "META"}


def test_a_chunk_with_an_unknown_optional_section_gets_copies_of_what_it_shares(chunk):
    write_sections(chunk, [*read_container(chunk.read_bytes()).sections, UNKNOWN_SECTION])

    with Container.open(chunk, SECTION_CONTENTS) as container:
        chunk.with_name("alone.hyrf").write_bytes(self_contained_bytes(container))

    models = [load_model(path) for path in (chunk, chunk.with_name("alone.hyrf"))]
    assert all(torch.equal(a, b) for a, b in zip(*(model.parameters() for model in models), strict=True))


def test_files_with_an_unknown_optional_section_are_merged_and_moved(tmp_path):
    for path in MODEL_PATHS:
        write_sections(tmp_path / path.name, [*read_container(path.read_bytes()).sections, UNKNOWN_SECTION])
    sources = [tmp_path / path.name for path in MODEL_PATHS]

    report = merge_models(sources, tmp_path / "both.hyrf", {sources[1].stem: [Scale(2.0)]})

    assert [part.gaussians for part in report.parts] == [len(load_model(path)) for path in MODEL_PATHS]
