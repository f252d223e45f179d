"""The worker's part of streaming, without a browser."""

from __future__ import annotations

from pathlib import Path

from web.scripts import run_script

from tools.safety.make_golden import GOLDEN_SCENE_FOLDER

MAX_WAITING_ROWS, MAX_REQUESTS = 512, 6
CHUNK_COUNT = 700  # of one row each


def test_few_levels_wait_for_a_slow_device_and_no_file_is_requested_twice():
    answer = run_script(Path(__file__).with_name("stream_scene.mjs"), GOLDEN_SCENE_FOLDER, CHUNK_COUNT)
    first_picture = 200  # at most so many chunks are drawn at once, of 1 kB each
    assert MAX_WAITING_ROWS <= answer["waiting"] <= MAX_WAITING_ROWS + MAX_REQUESTS + first_picture
    assert answer["all"] == CHUNK_COUNT
    assert answer["requests"] == CHUNK_COUNT + 1  # and the shared file
