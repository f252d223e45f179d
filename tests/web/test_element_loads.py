"""<hyrf-viewer> loads its scene again if the same `src` is set after a failure, without a browser."""

from __future__ import annotations

from pathlib import Path

import pytest
from web.scripts import run_script


@pytest.fixture(scope="module")
def loads() -> dict:
    return run_script(Path(__file__).with_name("element_loads.mjs"))


def test_the_same_src_starts_another_load_only_after_a_failure(loads: dict):
    first, while_loading, after_failure, with_another_src = loads["inline"]
    assert first == ["a.hyrf"] and while_loading == []
    assert after_failure == ["a.hyrf"] and with_another_src == ["a.hyrf"]


def test_the_same_src_loads_a_shown_scene_again_only_if_files_of_it_are_missing(loads: dict):
    assert loads["shown"] == [[], ["a.hyrf"]]


def test_the_property_src_is_the_attribute(loads: dict):
    assert loads["property"] == [["early.hyrf"], ["later.hyrf"], "later.hyrf", None]


def test_the_error_is_hidden_when_the_next_attempt_begins(loads: dict):
    assert loads["message"] == [True, False]


def test_a_hint_and_progress_do_not_replace_the_message_that_the_graphics_context_is_lost(loads: dict):
    text, is_shown = loads["lost"]
    assert text.startswith("The graphics device was lost") and is_shown


def test_an_error_stays_until_a_later_load_makes_progress(loads: dict):
    after_failure, with_progress_of_the_shown_scene, with_progress_of_a_later_load, of_an_attribute = loads[
        "overlapping"
    ]
    assert after_failure and with_progress_of_the_shown_scene and not with_progress_of_a_later_load
    assert of_an_attribute, "the progress of the scene hides an error of another attribute"


@pytest.mark.parametrize(
    ("shown", "addresses", "camera"),
    [
        ("own", ["own.hyrf"], "its camera"),
        ("other", ["other.hyrf"], "its camera"),
        ("bytes", [], "its camera"),
        ("stream", ["own.hyrf"], "2"),
        ("camera", ["other.hyrf"], "3"),
        ("src", ["new.hyrf"], "2"),
    ],
)
def test_a_suspended_element_resumes_the_scene_that_it_showed(
    loads: dict, shown: str, addresses: list[str], camera: str
):
    found = loads["suspended"][shown]
    assert (found["addresses"], found["camera"]) == (addresses, camera)
    assert found["size"] == (7 if shown == "bytes" else None)
    assert found["name"] == ("a name" if shown in ("other", "bytes", "camera") else None)


def test_a_frame_is_made_again_by_the_same_src_only_after_an_error(loads: dict):
    assert loads["frame"] == [1, 1, 0]


def test_a_suspended_element_comes_back_with_what_it_showed_and_else_with_its_own_scene(loads: dict):
    assert loads["failing"] == ["its camera", "other.hyrf", "own.hyrf"]


def test_a_wrong_attribute_that_is_corrected_keeps_the_scene_of_a_script(loads: dict):
    assert loads["corrected"] == "other.hyrf"
