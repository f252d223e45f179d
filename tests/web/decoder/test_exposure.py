"""The JavaScript decoder predicts the same gains as hyrfpack and refuses the same damaged exposure maps."""

from __future__ import annotations

import dataclasses
import json
import struct
from pathlib import Path

import numpy as np
import pytest
from exposures import random_map
from scenes import ball_points, small_model
from web.scripts import run_script

from hyrfpack.format import encode_model
from hyrfpack.format.container import MINOR_VERSION, read_container, write_container
from hyrfpack.format.exposure import encode_exposure
from hyrfpack.format.sections import EXPOSURE
from hyrfpack.model import HybridModel
from hyrfpack.model.exposure import MAX_CENTERS, ExposureMap
from tools.safety.fuzz_browser import find_disagreement, read_in_javascript, read_in_python
from tools.safety.synthetic_encoding import encode

LOG_GAINS_SCRIPT = Path(__file__).with_name("log_gains.mjs")
VIEWPOINT_COUNT = 40


def model_with(exposure: ExposureMap | None, count: int = 20) -> HybridModel:
    model = small_model(ball_points(count)[0])
    model.exposure = exposure
    return model


def random_viewpoints(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return positions inside the box of the map and far outside, and unit directions."""
    rng = np.random.default_rng(seed)
    positions = rng.normal(size=(VIEWPOINT_COUNT, 3)) * 10.0 ** rng.uniform(-2, 3, (VIEWPOINT_COUNT, 1))
    directions = rng.normal(size=(VIEWPOINT_COUNT, 3))
    return positions, directions / np.linalg.norm(directions, axis=1, keepdims=True)


def log_gains_in_javascript(folder: Path, files: dict[str, bytes], seed: int, partial: int = 0) -> list:
    """Return the log gains (VIEWPOINT_COUNT, 3) of each file, None for a file without a map."""
    positions, directions = (values.tolist() for values in random_viewpoints(seed))
    cases = []
    for name, data in files.items():
        (folder / name).write_bytes(data)
        case = {"file": str(folder / name), "partial": partial, "positions": positions, "directions": directions}
        cases.append(case)
    (folder / "cases.json").write_text(json.dumps(cases))
    return run_script(LOG_GAINS_SCRIPT, folder / "cases.json")


def test_log_gains_equal_those_of_python(tmp_path: Path):
    maps = [random_map(seed) for seed in range(25)] + [random_map(99, centers) for centers in (0, 1, MAX_CENTERS)]
    files = {f"{k}.hyrf": encode_model(model_with(exposure)) for k, exposure in enumerate(maps)}

    answers = log_gains_in_javascript(tmp_path, files, seed=5)

    for exposure, answer in zip(maps, answers, strict=True):
        np.testing.assert_allclose(answer, exposure.predict_log_gains(*random_viewpoints(5)), rtol=0, atol=1e-12)


def test_files_without_a_map_have_no_log_gains(tmp_path: Path):
    answers = log_gains_in_javascript(tmp_path, {"plain.hyrf": encode_model(model_with(None))}, seed=0)

    assert answers == [None]


def test_the_map_is_available_with_the_first_layer(tmp_path: Path):
    exposure = random_map(3, 8)
    data = encode(model_with(exposure, 400), "compact", prune=False, layered=True)
    entries = read_container(data).entries
    first_layer = max(entry.end for tag, entry in entries.items() if tag[-1].isalpha())
    assert list(entries)[:2] == ["META", EXPOSURE] and first_layer < len(data)

    (answer,) = log_gains_in_javascript(tmp_path, {"layers.hyrf": data}, seed=1, partial=first_layer)

    np.testing.assert_allclose(answer, exposure.predict_log_gains(*random_viewpoints(1)), rtol=0, atol=1e-12)


def file_with_map_bytes(stored: bytes, **changes: object) -> bytes:
    """Build a file with these bytes as its exposure map, unchecked by the writer."""
    container = read_container(encode_model(model_with(random_map(0, 3))))
    changed = {"data": stored, "raw_length": len(stored), **changes}
    sections = [container[tag] for tag in container.entries]
    replaced = [dataclasses.replace(part, **changed) if part.type == EXPOSURE else part for part in sections]
    return write_container(replaced, minor=MINOR_VERSION)


STORED_MAP = bytes(encode_exposure(random_map(0, 3)).data)
FIRST_FLOAT_INDEX = {"length": 0, "box": 2, "mean": 8, "limit": 11, "step": 17}


def replace_float(index: int, value: float) -> bytes:
    return STORED_MAP[: 4 + 4 * index] + struct.pack("<f", value) + STORED_MAP[8 + 4 * index :]


DAMAGED_FILES = {
    "no bytes": file_with_map_bytes(b""),
    "half a head": file_with_map_bytes(STORED_MAP[:50]),
    "a byte too few": file_with_map_bytes(STORED_MAP[:-1]),
    "a byte too many": file_with_map_bytes(STORED_MAP + b"\0"),
    "another decoded size": file_with_map_bytes(STORED_MAP, raw_length=len(STORED_MAP) + 1),
    "a center too few": file_with_map_bytes(b"\4" + STORED_MAP[1:]),
    "reserved bytes": file_with_map_bytes(STORED_MAP[:2] + b"\1" + STORED_MAP[3:]),
    "65 centers": file_with_map_bytes(b"\x41" + STORED_MAP[1:84] + bytes(12 * 65)),
    "a length of 0": file_with_map_bytes(replace_float(FIRST_FLOAT_INDEX["length"], 0.0)),
    "a negative length": file_with_map_bytes(replace_float(FIRST_FLOAT_INDEX["length"] + 1, -1.0)),
    "corners out of order": file_with_map_bytes(replace_float(FIRST_FLOAT_INDEX["box"], 1e6)),
    "limits out of order": file_with_map_bytes(replace_float(FIRST_FLOAT_INDEX["limit"] + 3, -7.5)),
    "a limit too high": file_with_map_bytes(replace_float(FIRST_FLOAT_INDEX["limit"] + 3, 8.5)),
    "a limit too low": file_with_map_bytes(replace_float(FIRST_FLOAT_INDEX["limit"], -8.5)),
    **{f"{value} as {name}": file_with_map_bytes(replace_float(at, value)) for name, at in FIRST_FLOAT_INDEX.items()
       for value in (float("nan"), float("inf"), float("-inf"))},
    "another codec": file_with_map_bytes(STORED_MAP, codec=1),
}  # fmt: skip


@pytest.fixture(scope="module")
def error_messages() -> dict[str, str]:
    verdicts = read_in_javascript([(data, False) for data in DAMAGED_FILES.values()])
    assert not any(verdict.failed for verdict in verdicts), verdicts
    return {name: verdict.refused for name, verdict in zip(DAMAGED_FILES, verdicts, strict=True)}


@pytest.mark.parametrize("case", DAMAGED_FILES)
def test_the_error_for_a_damaged_map_contains_its_section(error_messages: dict[str, str], case: str):
    assert "ection 'EXPO'" in error_messages[case]
    assert "EXPO" in read_in_python(DAMAGED_FILES[case]).refused


def test_a_file_with_a_required_map_is_read():
    data = file_with_map_bytes(STORED_MAP, required=True)

    (verdict,) = read_in_javascript([(data, False)])

    assert not find_disagreement(read_in_python(data), verdict) and not verdict.refused


def test_a_map_with_a_wrong_checksum_is_refused():
    data = bytearray(file_with_map_bytes(STORED_MAP))
    data[data.index(STORED_MAP) + 40] ^= 4

    (verdict,) = read_in_javascript([(bytes(data), False)])

    assert "checksum of section 'EXPO'" in verdict.refused


@pytest.mark.parametrize("count", [100, pytest.param(300, marks=pytest.mark.acceptance)])
def test_both_readers_refuse_the_same_damaged_maps(count):
    rng, files = np.random.default_rng(2), []
    for _ in range(count):
        stored = bytearray(STORED_MAP)
        for place in rng.integers(0, len(stored), rng.integers(1, 4)):
            stored[place] = rng.integers(256)
        files.append(file_with_map_bytes(bytes(stored)))

    verdicts = read_in_javascript([(data, False) for data in files])

    assert [
        find_disagreement(read_in_python(data), verdict) for data, verdict in zip(files, verdicts, strict=True)
    ] == [""] * count
    assert {bool(verdict.refused) for verdict in verdicts} == {True, False}
