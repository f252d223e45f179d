"""What the player drops is no longer loaded, without a browser."""

from __future__ import annotations

from pathlib import Path

import pytest
from web.scripts import run_script

from tools.safety.make_golden import GOLDEN_SCENE_FOLDER


@pytest.fixture(scope="module")
def loading() -> dict:
    return run_script(Path(__file__).with_name("loading.mjs"))


@pytest.fixture(scope="module")
def closed_stream() -> dict:
    return run_script(Path(__file__).with_name("closed_stream.mjs"), GOLDEN_SCENE_FOLDER)


def test_a_loader_that_waits_for_a_manifest_rejects_when_it_is_disposed_of(loading: dict):
    assert loading["loaderError"] == "SupersededError"


def test_a_folder_whose_name_has_a_bare_percent_sign_names_its_scene(loading: dict):
    assert loading["folderName"] == "50%"


def test_answers_that_nobody_reads_are_cancelled(loading: dict):
    assert loading["cancelled"] == [True, True]


def test_a_pointer_that_was_pressed_elsewhere_shows_no_hint(loading: dict):
    assert loading["lifted"] == []


def test_a_key_that_flies_reports_a_change_also_on_a_canvas_in_a_dialog(loading: dict):
    assert loading["changes"] == [1, 1]  # no change is added by a key in a field of the dialog


def test_a_closed_stream_requests_nothing_more(closed_stream: dict):
    assert closed_stream["late"] == 0


def test_answers_of_files_that_cannot_be_used_are_cancelled(closed_stream: dict):
    assert closed_stream["refused"] == [200, 404]


def test_a_file_that_is_fetched_again_counts_once(closed_stream: dict):
    assert closed_stream["bytes"] == 10


def test_a_scene_that_memory_is_too_short_for_is_an_error_of_the_page(closed_stream: dict):
    assert "memory" in closed_stream["sentence"]


def test_few_beginnings_of_files_that_are_no_longer_wanted_are_kept(closed_stream: dict):
    assert closed_stream["partials"] == 32


def test_cancelled_requests_do_not_count_as_breaks_of_the_connection(closed_stream: dict):
    assert closed_stream["breaks"] == 21


def test_a_part_with_the_first_exposure_map_of_its_scene_is_an_event(loading: dict):
    assert loading["partEvents"] == [["exposure", True]]


def test_a_wheel_with_shift_zooms_although_browsers_turn_it_to_the_side(loading: dict):
    assert loading["zooms"] == [1, -1, 1, 0]


def test_a_scene_reports_its_error_although_one_that_should_replace_it_has_failed(loading: dict):
    assert loading["openErrors"] == ["second", "first"]


def test_a_scene_that_arrives_late_is_shown_if_those_that_the_user_opened_meanwhile_fail(loading: dict):
    own = {"shown": ["own"], "cancelled": []}
    assert loading["lateScenes"] == [own, {"shown": ["a"], "cancelled": ["own"]}, own]
