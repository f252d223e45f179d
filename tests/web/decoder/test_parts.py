"""hyrf.js reads the parts of merged files bit by bit, and refuses the files that hyrfpack refuses."""

from __future__ import annotations

import hashlib
from pathlib import Path

from format.test_parts import (
    BAD_NAMES,
    COMPACT,
    FORGED_FILES,
    GOLDEN_FOLDER,
    MERGED,
    NAMES,
    names_section,
    with_sections,
)
from web.scripts import run_script

from hyrfpack.format.arrays import to_arrays
from hyrfpack.format.codec import decode_model
from hyrfpack.format.parts import load_merged_model

READ_PARTS_SCRIPT = Path(__file__).with_name("read_parts.mjs")
ARRAYS = ("POSI", "COLO", "GTAB", "GMLP", "RTAB", "RMLP")


def read_in_javascript(folder: Path, files: list[bytes]) -> list:
    paths = []
    for number, data in enumerate(files):
        paths.append(folder / f"{number}.hyrf")
        paths[-1].write_bytes(data)
    return run_script(READ_PARTS_SCRIPT, *paths)


def test_parts_have_the_same_bits_as_in_python(tmp_path: Path):
    (answer,) = read_in_javascript(tmp_path, [MERGED])

    *parts, facts = answer
    assert [part["name"] for part in parts] == NAMES
    models = load_merged_model(tmp_path / "0.hyrf").parts
    for part, model in zip(parts, models, strict=True):
        arrays = to_arrays(model)
        assert part["count"] == len(model)
        assert part["hashes"] == [hashlib.sha256(arrays[name].tobytes()).hexdigest() for name in ARRAYS]
        assert part["hasMap"] == (model.exposure is not None)
    assert "holds merged models" in facts["single"] and "readParts" in facts["single"]
    assert facts["needed"] == len(MERGED)


def test_a_file_of_one_model_is_read_as_its_only_part(tmp_path: Path):
    ((part,),) = read_in_javascript(tmp_path, [COMPACT])

    assert part["count"] == len(decode_model(COMPACT))


def test_forged_and_damaged_merged_files_are_refused(tmp_path: Path):
    files = [*FORGED_FILES.values(), MERGED[:-8], MERGED[:-1] + b"\1", (GOLDEN_FOLDER / "sizes.json").read_bytes()]

    answers = read_in_javascript(tmp_path, files)

    assert all("refused" in answer for answer in answers)
    refusals = dict(zip(FORGED_FILES, answers, strict=False))
    assert "'PT01' refers to another file" in refusals["a part refers to another file"]["refused"]


def test_names_that_are_not_valid_are_refused(tmp_path: Path):
    files = [with_sections(names_section({"names": names})) for names in [BAD_NAMES[0], *BAD_NAMES[2:]]]

    assert all("names of its parts" in answer["refused"] for answer in read_in_javascript(tmp_path, files))
