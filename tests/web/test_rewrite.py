"""A file that the player saves after an edit equals the one that `hyrfpack edit` writes."""

from __future__ import annotations

import json
import shlex
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from web.scripts import run_script

from hyrfpack.cameras.placement import Placement
from hyrfpack.cli.edit import edit
from hyrfpack.edit.transform import move_provenance
from hyrfpack.format.arrays import read_config
from hyrfpack.format.container import Container, Section, read_container
from hyrfpack.format.metadata import read_metadata, writer_name
from hyrfpack.format.rewrite import with_metadata
from hyrfpack.format.sections import EXPOSURE, METADATA, POSITIONS, SECTION_CONTENTS, SHAPES, layer_section
from hyrfpack.format.shared import read_provenance
from hyrfpack.format.versions import lowest_minor_version

GOLDEN_FOLDER = Path(__file__).parents[1] / "golden"
FILES = [
    "trained/demo.hyrf",
    "trained/demo_compact.hyrf",
    "trained/exposed_balls.hyrf",
    "v1.0_paper.hyrf",
    "v1.1_compact_layers.hyrf",
    "v1.3_compact_rotated.hyrf",
    "v1.6_compact_residuals.hyrf",
]
UP = {"option": "up", "value": [0.3, -0.8, 0.52]}
EDITS = {
    "up": [UP],
    "upright": [UP, {"option": "upright", "value": "z"}],
    "half a turn": [{"option": "up", "value": [0.1, -0.9, -0.2]}, {"option": "upright", "value": "y"}],
    "scaled": [{"option": "scale", "value": 0.254}],
    "all": [
        {"option": "scale", "value": 3},
        UP,
        {"option": "upright", "value": "y"},
        {"option": "up", "value": [0, 0.6, 0.8]},
        {"option": "upright", "value": "z"},
        {"option": "scale", "value": 0.5},
    ],
    "moved before": [UP, {"option": "upright", "value": "y"}, {"option": "scale", "value": 0.5}],
    "cleaned": [{"option": "min-opacity", "value": 0.5}],
    "turned and cleaned": [UP, {"option": "upright", "value": "y"}, {"option": "min-opacity", "value": 0.6}],
}


def assert_equal_numbers(first: Any, second: Any, path: str = "") -> None:
    """Assert that two JSON values are equal, numbers to nine digits."""
    if isinstance(first, dict):
        assert isinstance(second, dict) and sorted(first) == sorted(second), path
        for key in first:
            assert_equal_numbers(first[key], second[key], f"{path}.{key}")
    elif isinstance(first, list):
        assert isinstance(second, list) and len(first) == len(second), path
        for number, (one, other) in enumerate(zip(first, second, strict=True)):
            assert_equal_numbers(one, other, f"{path}[{number}]")
    elif isinstance(first, (int, float)) and not isinstance(first, bool):
        assert first == pytest.approx(second, rel=2e-9, abs=2e-9), path
    else:
        assert first == second, path


def read_golden_file(name: str) -> bytes:
    return (GOLDEN_FOLDER / name).read_bytes()


def moved_file(name: str) -> bytes:
    """Return a golden file as if it had been moved already."""
    container = read_container(read_golden_file(name), SECTION_CONTENTS)
    placement = Placement(
        3.0, Placement.rotation_about_axis((0.3, -1.0, 0.4), 130).rotation, np.array([3.0, -2.0, 0.5])
    )
    return with_metadata(container, read_config(container), move_provenance(placement, read_provenance(container)))


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> dict[tuple[str, str], dict[str, Any]]:
    """Save every file after every edit as the player does; return the source, the target and the answers of each."""
    folder = tmp_path_factory.mktemp("saved")
    cases = {}
    for name in FILES:
        for edits, actions in EDITS.items():
            place = folder / str(len(cases))
            place.mkdir()
            (place / "scene.hyrf").write_bytes(moved_file(name) if edits == "moved before" else read_golden_file(name))
            paths = {"source": str(place / "scene.hyrf"), "target": str(place / "saved.hyrf")}
            cases[name, edits] = {**paths, "actions": actions}
    (folder / "cases.json").write_text(json.dumps(list(cases.values())))
    answers = run_script(Path(__file__).with_name("rewrite.mjs"), folder / "cases.json", writer_name())
    return {key: {**case, **answer} for (key, case), answer in zip(cases.items(), answers, strict=True)}


@pytest.mark.parametrize(
    ("name", "edits"),
    [
        # `make test` takes every file and every edit at least once, `make test-all` takes all pairs.
        pytest.param(name, edits, marks=[] if edits == "all" or name == FILES[-1] else pytest.mark.acceptance)
        for name, edits in product(FILES, EDITS)
    ],
)
def test_a_saved_file_equals_that_of_the_command(name: str, edits: str, saved, monkeypatch):
    case = saved[name, edits]
    source, target = Path(case["source"]), Path(case["target"])
    monkeypatch.chdir(source.parent)
    monkeypatch.setattr("hyrfpack.edit.run.MAX_COMPARED_VIEWS", 1)

    profile = [] if case["keeps"] else ["--profile", "raw"]  # because pages cannot compress
    edit.main([*shlex.split(case["command"])[2:], *profile], standalone_mode=False)

    written_file = source.with_name("scene-edited.hyrf")
    assert case["keeps"] == ("min-opacity" not in str(case["actions"]))
    with Container.open(target) as saved_file, Container.open(written_file) as written:
        assert list(saved_file.entries) == list(written.entries)
        for section in written.entries:
            if section != METADATA:
                assert bytes(saved_file[section].data) == bytes(written[section].data)
            assert saved_file.entries[section].codec == written.entries[section].codec
        assert_equal_numbers(vars(read_metadata(saved_file)), vars(read_metadata(written)))
    assert target.read_bytes()[:16] == written_file.read_bytes()[:16]  # with the format version


def test_the_minor_version_of_a_saved_file_is_that_of_python(tmp_path: Path):
    frames: tuple[dict, ...] = ({}, {"rotation": [1, 0, 0, 0]})
    configs = [{"frame": frame, **more} for frame in frames for more in ({}, {"residual_degree": 1})]
    types = (POSITIONS, layer_section(POSITIONS, 1), SHAPES, layer_section(SHAPES, 1), EXPOSURE)
    cases = [
        {"sections": [{"type": METADATA, "codec": 0}, {"type": kind, "codec": codec}], "config": config}
        for kind, codec, config in product(types, range(16), configs)
    ]
    (tmp_path / "cases.json").write_text(json.dumps(cases))
    found = run_script(Path(__file__).with_name("minor_versions.mjs"), tmp_path / "cases.json")
    expected = [
        lowest_minor_version(
            [Section(data=b"", raw_length=0, **section) for section in case["sections"]], case["config"]
        )
        for case in cases
    ]
    assert found == expected and set(expected) == {0, 1, 2, 3, 5, 6}
