"""What the player drops is no longer loaded, without a browser."""

from __future__ import annotations

from pathlib import Path

import pytest
from web.scripts import run_script

from tools.safety.make_golden import GOLDEN_SCENE_FOLDER


@pytest.fixture(scope="module")
def closed_stream() -> dict:
    return run_script(Path(__file__).with_name("closed_stream.mjs"), GOLDEN_SCENE_FOLDER)


def test_a_closed_stream_requests_nothing_more(closed_stream: dict):
    assert closed_stream["late"] == 0


def test_answers_of_files_that_cannot_be_used_are_cancelled(closed_stream: dict):
    assert closed_stream["refused"] == [200, 404]


def test_few_beginnings_of_files_that_are_no_longer_wanted_are_kept(closed_stream: dict):
    assert closed_stream["partials"] == 32
