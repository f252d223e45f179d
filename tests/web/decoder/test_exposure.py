"""The exposure map in JavaScript: the gains that hyrfpack predicts, and the same bytes refused."""

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

SCRIPT = Path(__file__).with_name("log_gains.mjs")
VIEWPOINTS = 40


def model_with(exposure: ExposureMap | None, count: int = 20) -> HybridModel:
    model = small_model(ball_points(count)[0])
    model.exposure = exposure
    return model


def viewpoints(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Positions inside the box of the map and far outside, unit directions."""
    rng = np.random.default_rng(seed)
    positions = rng.normal(size=(VIEWPOINTS, 3)) * 10.0 ** rng.uniform(-2, 3, (VIEWPOINTS, 1))
    directions = rng.normal(size=(VIEWPOINTS, 3))
    return positions, directions / np.linalg.norm(directions, axis=1, keepdims=True)


def log_gains_in_javascript(folder: Path, files: dict[str, bytes], seed: int, partial: int = 0) -> list:
    """The log gains (VIEWPOINTS, 3) of each file, None where it has no map."""
    positions, directions = (values.tolist() for values in viewpoints(seed))
    cases = []
    for name, data in files.items():
        (folder / name).write_bytes(data)
        case = {"file": str(folder / name), "partial": partial, "positions": positions, "directions": directions}
        cases.append(case)
    (folder / "cases.json").write_text(json.dumps(cases))
    return run_script(SCRIPT, folder / "cases.json")


def test_log_gains_equal_those_of_python(tmp_path: Path):
    maps = [random_map(seed) for seed in range(25)] + [random_map(99, centers) for centers in (0, 1, MAX_CENTERS)]
    files = {f"{k}.hyrf": encode_model(model_with(exposure)) for k, exposure in enumerate(maps)}

    answers = log_gains_in_javascript(tmp_path, files, seed=5)

    for exposure, answer in zip(maps, answers, strict=True):
        np.testing.assert_allclose(answer, exposure.predict_log_gains(*viewpoints(5)), rtol=0, atol=1e-12)


def test_files_without_a_map_have_none(tmp_path: Path):
    answers = log_gains_in_javascript(tmp_path, {"plain.hyrf": encode_model(model_with(None))}, seed=0)

    assert answers == [None]


def test_the_first_layer_of_a_file_comes_with_the_map(tmp_path: Path):
    exposure = random_map(3, 8)
    data = encode(model_with(exposure, 400), "compact", prune=False, layered=True)
    entries = read_container(data).entries
    first_layer = max(entry.end for tag, entry in entries.items() if tag[-1].isalpha())
    assert list(entries)[:2] == ["META", EXPOSURE] and first_layer < len(data)

    (answer,) = log_gains_in_javascript(tmp_path, {"layers.hyrf": data}, seed=1, partial=first_layer)

    np.testing.assert_allclose(answer, exposure.predict_log_gains(*viewpoints(1)), rtol=0, atol=1e-12)


def file_with(stored: bytes, **changes: object) -> bytes:
    """A file with these bytes as its exposure map, which no writer has checked."""
    container = read_container(encode_model(model_with(random_map(0, 3))))
    changed = {"data": stored, "raw_length": len(stored), **changes}
    sections = [container[tag] for tag in container.entries]
    replaced = [dataclasses.replace(part, **changed) if part.type == EXPOSURE else part for part in sections]
    return write_container(replaced, minor=MINOR_VERSION)


STORED = bytes(encode_exposure(random_map(0, 3)).data)
FLOATS = {"length": 0, "box": 2, "mean": 8, "limit": 11, "step": 17}  # first of each among the floats


def with_float(index: int, value: float) -> bytes:
    return STORED[: 4 + 4 * index] + struct.pack("<f", value) + STORED[8 + 4 * index :]


DAMAGED = {
    "no bytes": file_with(b""),
    "half a head": file_with(STORED[:50]),
    "a byte too few": file_with(STORED[:-1]),
    "a byte too many": file_with(STORED + b"\0"),
    "another decoded size": file_with(STORED, raw_length=len(STORED) + 1),
    "a center too few": file_with(b"\4" + STORED[1:]),
    "reserved bytes": file_with(STORED[:2] + b"\1" + STORED[3:]),
    "65 centers": file_with(b"\x41" + STORED[1:84] + bytes(12 * 65)),
    "a length of 0": file_with(with_float(FLOATS["length"], 0.0)),
    "a negative length": file_with(with_float(FLOATS["length"] + 1, -1.0)),
    "corners out of order": file_with(with_float(FLOATS["box"], 1e6)),
    "limits out of order": file_with(with_float(FLOATS["limit"] + 3, -7.5)),
    "a limit too high": file_with(with_float(FLOATS["limit"] + 3, 8.5)),
    "a limit too low": file_with(with_float(FLOATS["limit"], -8.5)),
    **{f"{value} as {name}": file_with(with_float(at, value)) for name, at in FLOATS.items()
       for value in (float("nan"), float("inf"), float("-inf"))},
    "another codec": file_with(STORED, codec=1),
}  # fmt: skip


@pytest.fixture(scope="module")
def refusals() -> dict[str, str]:
    verdicts = read_in_javascript([(data, False) for data in DAMAGED.values()])
    assert not any(verdict.failed for verdict in verdicts), verdicts
    return {name: verdict.refused for name, verdict in zip(DAMAGED, verdicts, strict=True)}


@pytest.mark.parametrize("case", DAMAGED)
def test_a_damaged_map_is_refused_with_the_name_of_its_section(refusals: dict[str, str], case: str):
    assert "ection 'EXPO'" in refusals[case]
    assert "EXPO" in read_in_python(DAMAGED[case]).refused


def test_a_file_that_requires_its_map_is_read():
    data = file_with(STORED, required=True)

    (verdict,) = read_in_javascript([(data, False)])

    assert not find_disagreement(read_in_python(data), verdict) and not verdict.refused


def test_a_map_whose_bytes_changed_on_the_way_is_refused():
    data = bytearray(file_with(STORED))
    data[data.index(STORED) + 40] ^= 4

    (verdict,) = read_in_javascript([(bytes(data), False)])

    assert "checksum of section 'EXPO'" in verdict.refused


def test_both_readers_refuse_the_same_maps():
    rng, files = np.random.default_rng(2), []
    for _ in range(300):
        stored = bytearray(STORED)
        for place in rng.integers(0, len(stored), rng.integers(1, 4)):
            stored[place] = rng.integers(256)
        files.append(file_with(bytes(stored)))

    verdicts = read_in_javascript([(data, False) for data in files])

    assert [
        find_disagreement(read_in_python(data), verdict) for data, verdict in zip(files, verdicts, strict=True)
    ] == [""] * 300
    assert {bool(verdict.refused) for verdict in verdicts} == {True, False}
