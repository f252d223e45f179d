"""A viewer ends what it no longer needs, and refuses wrong arguments, without a browser."""

from __future__ import annotations

from pathlib import Path

import pytest
from web.scripts import run_script

MAX_POSE_ERROR = 1e-6


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


def test_an_error_of_a_listener_is_reported_and_changes_nothing_else(loads: dict):
    assert loads["listeners"]["called"] == ["first", "second"]
    assert loads["listeners"]["reported"] == ["an error of the page"]
    assert loads["listeners"]["loadError"].startswith("A scene is an address")


def test_the_first_camera_is_used_by_the_first_load_only(loads: dict):
    assert loads["firstCameras"] == [[], [5]]


@pytest.mark.parametrize(
    ("what", "words"),
    [
        ("no options", "createViewer needs a container: element or selector."),
        ("an empty selector", "createViewer needs a container: element or selector."),
        ("no listener", 'The listener of "ready" must be a function.'),
        ("no load options", "A scene is an address"),
        ("a stream of texts", "the scene cannot be opened: the stream must yield Uint8Arrays."),
        ("a locked stream", "The stream is locked"),
        ("a destroyed viewer", "The viewer has been destroyed"),
    ],
)
def test_wrong_arguments_are_refused_by_a_sentence(loads: dict, what: str, words: str):
    assert loads["wrong"][what].startswith(words)


def test_a_policy_that_requires_trusted_types_is_named(loads: dict):
    assert "it must allow trusted-types hyrf-viewer." in loads["refusal"]


def test_viewers_start_workers_by_one_policy_for_trusted_types(loads: dict):
    assert loads["policies"] == [["hyrf-viewer"], ["blob", "http"]]


def test_each_change_of_the_pixel_ratio_requests_a_frame_until_the_viewer_is_destroyed(loads: dict):
    found = loads["pixelRatios"]
    assert found["requested"] == [1, 1] and found["afterEnd"] == 0
    assert found["queries"] == [f"(resolution: {ratio}dppx)" for ratio in (1, 2, 1.5)]


def test_setting_the_camera_that_was_read_moves_nothing(loads: dict):
    assert loads["cameras"]["drift"] < MAX_POSE_ERROR and loads["cameras"]["error"] < MAX_POSE_ERROR
