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


def test_a_hint_does_not_replace_the_message_that_the_graphics_context_is_lost(loads: dict):
    assert loads["lost"].startswith("The graphics device was lost")


def test_a_frame_is_made_again_by_the_same_src_only_after_an_error(loads: dict):
    assert loads["frame"] == [1, 1, 0]
