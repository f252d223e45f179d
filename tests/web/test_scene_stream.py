"""The worker's part of streaming, without a browser."""

from __future__ import annotations

from pathlib import Path

from web.scripts import run_script

from tools.safety.make_golden import GOLDEN_SCENE_FOLDER

MAX_WAITING_ROWS, MAX_REQUESTS = 512, 6
CHUNK_COUNT = 700  # of one row each
GAUSSIANS_PER_CHUNK, ROW_WIDTH = 19, 256


def test_few_levels_wait_for_a_slow_device_and_no_file_is_requested_twice():
    answer = run_script(Path(__file__).with_name("stream_scene.mjs"), GOLDEN_SCENE_FOLDER, CHUNK_COUNT)
    first_picture = 200  # at most so many chunks are drawn at once, of 1 kB each
    assert MAX_WAITING_ROWS <= answer["waiting"] <= MAX_WAITING_ROWS + MAX_REQUESTS + first_picture
    assert answer["all"] == CHUNK_COUNT
    assert answer["requests"] == CHUNK_COUNT + 1  # and the shared file


def test_the_memory_for_gaussians_does_not_grow_with_the_scene():
    """Chunks around the eye stay in memory; others are drawn where the view shows them."""
    budget, script = 10_000, Path(__file__).with_name("turn_in_scene.mjs")
    small, large = (run_script(script, GOLDEN_SCENE_FOLDER, side**2, budget) for side in (27, 51))
    assert small["rows"] == large["rows"] < 1.25 * budget / ROW_WIDTH + 2 * 256 + 1
    for answer in (small, large):
        first, second = (set(view["drawn"]) for view in answer["views"])
        assert set(answer["nearest"]) <= first & second
        assert len(first - second) > 100 < len(second - first)
        for view in answer["views"]:
            assert view["ahead"] > 0.8
            assert len(view["drawn"]) <= budget / ROW_WIDTH + 256 + 1
            assert view["resident"] <= GAUSSIANS_PER_CHUNK * answer["rows"]
