"""The worker's part of streaming, without a browser."""

from __future__ import annotations

from pathlib import Path

import pytest
from web.native_models import random_model
from web.scripts import run_script

import hyrfpack
from hyrfpack.config.split import SplitConfig
from hyrfpack.context import RunContext
from hyrfpack.format import encode_model
from hyrfpack.format.parts import encode_parts
from hyrfpack.lod import split, split_model
from tools.safety.make_golden import GOLDEN_SCENE_FOLDER

MAX_WAITING_ROWS, MAX_REQUESTS = 512, 6
CHUNK_COUNT = 700  # of one row each
GAUSSIANS_PER_CHUNK, ROW_WIDTH = 19, 256


@pytest.mark.acceptance
def test_few_levels_wait_for_a_slow_device_and_no_file_is_requested_twice():
    answer = run_script(Path(__file__).with_name("stream_scene.mjs"), GOLDEN_SCENE_FOLDER, CHUNK_COUNT)
    first_picture = 200  # at most so many chunks are drawn at once, of 1 kB each
    assert MAX_WAITING_ROWS <= answer["waiting"] <= MAX_WAITING_ROWS + MAX_REQUESTS + first_picture
    assert answer["all"] == CHUNK_COUNT
    assert answer["requests"] == CHUNK_COUNT + 1  # and the shared file


@pytest.mark.acceptance
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


PART_COUNT, GAUSSIANS_PER_PART, CHUNK_GAUSSIANS = 6, 384, 128


@pytest.fixture(scope="module")
def parts_folder(tmp_path_factory) -> Path:
    """Return a scene folder of several parts, whose fields have 25.6 kB each in memory."""
    path = tmp_path_factory.mktemp("parts")
    models = [(f"part {seed}", encode_model(random_model(GAUSSIANS_PER_PART, seed))) for seed in range(PART_COUNT)]
    (path / "all.hyrf").write_bytes(encode_parts(models))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(split, "MEASURED_VIEWS_PER_PART", 1)
        config = SplitConfig(chunk_gaussians=CHUNK_GAUSSIANS, levels=2, refit_steps=0)
        split_model(path / "all.hyrf", path / "scene", config, context=RunContext(progress=None))
    return path / "scene"


@pytest.mark.acceptance
@pytest.mark.parametrize(("budget", "most_parts"), [(400, 2), (650, 3), (10**6, PART_COUNT - 1)])
def test_the_memory_for_fields_of_parts_has_a_limit(parts_folder: Path, budget: int, most_parts: int):
    """The limit is 128 bytes a Gaussian of the budget, but at least two further parts.

    Each level arrives after the fields of its part, which are kept until it is evaluated.
    """
    answer = run_script(Path(__file__).with_name("stream_parts.mjs"), parts_folder, budget)
    chunks = hyrfpack.SceneFolder(parts_folder).manifest.chunks
    assert len(chunks) <= answer["levels"] <= sum(len(chunk.levels) for chunk in chunks)
    assert answer["most"] == most_parts
    assert (answer["again"] > 0) == (most_parts < PART_COUNT - 1)
    assert answer["early"] == answer["dropped"] == 0
    assert answer["kept"] == PART_COUNT * GAUSSIANS_PER_PART  # what can be drawn needs no fields any more
    assert answer["left"] == (PART_COUNT - 1) * GAUSSIANS_PER_PART
