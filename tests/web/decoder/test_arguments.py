"""hyrf.js refuses wrong arguments by a sentence that says what it takes, what it was given and what to do."""

from __future__ import annotations

from pathlib import Path

import pytest
from web.scripts import run_script

from tools.safety.make_golden import GOLDEN_SCENE_FOLDER

GOLDEN_FILE = Path(__file__).parents[2] / "golden" / "v1.1_compact_layers.hyrf"
FIX_SENTENCE = "pass new Uint8Array(await response.arrayBuffer())."
CLASS_BY_INPUT = {
    "undefined": "Undefined",
    "null": "Null",
    "a string": "String",
    "a number": "Number",
    "an Array": "Array",
    "an ArrayBuffer": "ArrayBuffer",
    "a Float32Array": "Float32Array",
    "a Response": "Response",
    "a Promise": "Promise",
}


@pytest.fixture(scope="module")
def answers() -> dict:
    files = [GOLDEN_FILE, GOLDEN_SCENE_FOLDER / "chunk-0000-0.hyrf", GOLDEN_SCENE_FOLDER / "scene.json"]
    return run_script(Path(__file__).with_name("wrong_arguments.mjs"), *files)


@pytest.mark.parametrize(
    ("function", "file"),
    [
        ("describe", "The file"),
        ("read", "The file"),
        ("readParts", "The file"),
        ("parseManifest", "The manifest"),
    ],
)
def test_values_that_are_no_bytes_are_refused_by_their_type(answers: dict, function: str, file: str):
    refused = {what: answer for what, answer in answers[function].items() if answer}
    assert refused == {
        what: f"TypeError: {file} must be a Uint8Array, not {type_name}; {FIX_SENTENCE}"
        for what, type_name in CLASS_BY_INPUT.items()
    }


def test_what_open_file_returns_is_refused_by_the_name_of_the_file(answers: dict):
    assert answers["openFile"] == {
        what: f"TypeError: shared.hyrf must be a Uint8Array, not {CLASS_BY_INPUT[what]}; {FIX_SENTENCE}"
        for what in ("undefined", "a Response")
    }


def test_harmonics_are_fitted_for_degrees_0_to_3_only(answers: dict):
    given = {"undefined": "undefined", "null": "null", "-1": "-1", "1.5": "1.5", "4": "4", "a string": "1"}
    assert {what: answer for what, answer in answers["fitHarmonics"].items() if answer} == {
        what: f"RangeError: degree must be 0 to 3, not {value}." for what, value in given.items()
    }
