"""A viewer ends what it no longer needs, and refuses wrong arguments, without a browser."""

from __future__ import annotations

from pathlib import Path

import pytest
from web.scripts import run_script


@pytest.fixture(scope="module")
def loads() -> dict:
    return run_script(Path(__file__).with_name("viewer_loads.mjs"))


@pytest.mark.parametrize("case", ["superseded", "destroyed"])
def test_a_load_whose_server_does_not_answer_is_aborted_at_once(loads: dict, case: str):
    assert loads[case] == ["AbortError", True]


def test_a_download_that_stalls_is_aborted_at_once(loads: dict):
    assert loads["stalled"] == [["AbortError", True]] * 2


def test_a_stream_of_the_page_is_cancelled_with_its_load(loads: dict):
    assert loads["streams"] == [["AbortError", True]] * 2


def test_the_arrays_of_a_stream_stay_those_of_the_page(loads: dict):
    assert loads["kept"] == [10, 15]


@pytest.mark.parametrize(
    ("what", "words"),
    [
        ("a stream of texts", "the scene cannot be opened: the stream must yield Uint8Arrays."),
        ("a locked stream", "The stream is locked"),
    ],
)
def test_wrong_arguments_are_refused_by_a_sentence(loads: dict, what: str, words: str):
    assert loads["wrong"][what].startswith(words)
