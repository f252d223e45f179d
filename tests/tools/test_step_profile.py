"""The profile of a training step: rows add up, sizes are those of the view, counts match a count by hand."""

from __future__ import annotations

from collections import defaultdict

import numpy as np
import pytest
import torch
from scenes import ball_points, ball_scene, small_model

from hyrfpack.model import HybridModel
from hyrfpack.ops.rasterize import RasterSettings, rasterize
from hyrfpack.render import RenderSettings
from hyrfpack.scene import Scene
from tools.gpu.scene import decode_splats
from tools.gpu.timing import Rates
from tools.studies import step_profile
from tools.studies.step_profile import (
    OPERATION_ROWS,
    StepProfile,
    StepRecorder,
    count_evaluations,
    find_backward_row,
    iterate_new_nodes,
    profile_steps,
    split_step,
    table_rows,
)
from tools.studies.step_work import FieldSizes, ModelSizes, ViewSizes, count_step, measure_model_sizes

PROFILED_STEPS = 3
# A thread that copies 1 GB/s and computes 10 GFLOP/s.
MADE_UP_RATES = Rates(copy=1e9, bf16=1e10, fp32=1e10)


def make_scene() -> Scene:
    return ball_scene(views=2, points=50, side=32)


def make_model(*, background: bool) -> HybridModel:
    return small_model(ball_points(50)[0], background=background, fields=0.5)


@pytest.fixture(scope="module")
def profile() -> StepProfile:
    return profile_steps(make_scene(), make_model(background=True), PROFILED_STEPS)


def test_each_step_has_every_row_with_a_positive_time(profile: StepProfile) -> None:
    assert [tuple(step) for step in profile.steps] == PROFILED_STEPS * [OPERATION_ROWS]
    assert all(seconds > 0 for step in profile.steps for seconds in step.values())


def test_a_model_without_a_background_sphere_has_no_rows_of_it() -> None:
    steps = profile_steps(make_scene(), make_model(background=False), 1).steps
    assert [tuple(step) for step in steps] == [tuple(row for row in OPERATION_ROWS if not row.startswith("background"))]
    assert all(seconds > 0 for seconds in steps[0].values())


def test_every_row_but_the_remainders_has_a_positive_count(profile: StepProfile) -> None:
    works = profile.median_works()
    assert set(OPERATION_ROWS) - set(works) == {"backward: autograd", "other"} and set(works) < set(OPERATION_ROWS)
    assert all(work.bytes > 0 and work.flops > 0 for work in works.values())


def test_rows_add_up_to_the_step_without_the_time_to_add_hooks() -> None:
    recorder = StepRecorder()
    recorder.seconds |= {
        "decode: MLP": 2,
        "composite": 1,
        "background: MLP": 3,
        "blend backward": 4,
        "loss backward": 1,
    }
    recorder.overhead = 0.5
    stages = {"data": 1, "decode": 5, "background": 7, "loss": 2, "backward": 11, "density": 1, "optimizer": 2}
    rows = split_step(defaultdict(float, stages), 30.5, recorder, True)
    assert sum(rows.values()) == pytest.approx(30)
    assert (rows["decode: rest"], rows["background: rest"], rows["loss"]) == (3, 3, 1.5)
    assert (rows["backward: autograd"], rows["Adam"], rows["other"]) == (6, 2, 1.5)


def test_profiling_leaves_the_model_as_it_is() -> None:
    model = make_model(background=True)
    before = {name: value.clone() for name, value in model.state_dict().items()}
    profile_steps(make_scene(), model, 1)
    for name, value in model.state_dict().items():
        torch.testing.assert_close(value, before[name], rtol=0, atol=1e-9)


def test_sizes_of_a_step_are_those_of_its_view(profile: StepProfile) -> None:
    model, settings = make_model(background=True), RenderSettings()
    expected = set()
    for view in make_scene().train:
        splats = decode_splats(model, view.camera)
        raster = rasterize(splats.gaussians, splats.colors, splats.viewport, RasterSettings(settings.near))
        grid = model.background_grid(
            raster.transmittance, splats.viewport, threshold=settings.background_threshold, stride=2
        )
        expected.add((32 * 32, int(raster.visible.sum()), raster.pairs, 17 * 17, int(grid.any(-1).sum())))
    assert {(v.pixels, v.drawn, v.pairs, v.nodes, v.needed) for v in profile.views} <= expected
    for sizes in profile.views:
        assert 0 < sizes.drawn <= sizes.in_view <= len(model) and 0 < sizes.reached <= sizes.pairs
        assert 16 * sizes.reached <= sizes.evaluations <= 256 * sizes.reached
        assert 0 < sizes.blended <= sizes.evaluations / sizes.pixels


def test_evaluations_are_the_pixels_of_the_rows_that_pairs_touch() -> None:
    # The lowest 4 bits of a pair are its first row, the next 4 its last one.
    pairs = np.array([0x00, 0xF0, 0x75, (123 << 36) | (45 << 8) | 0xFF], np.uint64)
    assert count_evaluations(pairs) == 16 * (1 + 16 + 3 + 1)


def test_a_node_of_the_graph_belongs_to_the_first_result_that_it_leads_to() -> None:
    x = torch.ones(2, requires_grad=True)
    first = x.exp()
    second = (first * x).sum()
    seen: set = set()
    assert {node.name() for node in iterate_new_nodes([first], seen)} == {
        "ExpBackward0",
        "torch::autograd::AccumulateGrad",
    }
    assert [node.name() for node in iterate_new_nodes([second], seen)] == ["SumBackward0", "MulBackward0"]
    assert list(iterate_new_nodes([first, second], seen)) == []


@pytest.mark.parametrize(
    ("operation", "node", "row"),
    [
        ("decode", "_HashEncodeBackward", "decode backward: hash encoding"),
        ("background", "_CpuMlpBackward", "background backward: MLP"),
        ("background", "SigmoidBackward0", "background backward: rest"),
        ("loss", "_CpuLossBackward", "loss backward"),
        ("rasterize", "_RasterizeBackward", None),
        ("decode", "torch::autograd::AccumulateGrad", None),
    ],
)
def test_a_node_is_assigned_to_its_row(operation: str, node: str, row: str | None) -> None:
    assert find_backward_row(operation, node) == row


def test_counts_of_a_small_step_match_a_count_by_hand() -> None:
    # Both fields have one level of 10 rows; MLPs of 2-4-4-8 (56 weights) and (2 + 9)-4-4-3 (72 weights).
    model = ModelSizes(
        100, 1000, FieldSizes((2, 4, 4, 8), 1, 10), FieldSizes((11, 4, 4, 3), 1, 10), directions=9, background=True
    )
    view = ViewSizes(
        pixels=512,
        photo_bytes=3,
        in_view=50,
        drawn=40,
        pairs=60,
        reached=30,
        evaluations=2000,
        blended=2.0,
        nodes=160,
        needed=20,
    )
    works = count_step(model, view)
    counts = {row: (work.bytes, work.flops) for row, work in works.items()}
    assert counts["data"] == (512 * (3 + 3 * 4), 512 * 3)
    assert counts["cull"] == (100 * 12 + 50 * 8, 100 * 32)
    assert counts["decode: hash encoding"] == (2 * (50 * (12 + 8) + 10 * 8), 2 * 50 * (49 + 32))
    assert counts["decode: MLP"] == (4 * (50 * (2 + 8 + 11 + 3) + 56 + 72), 2 * 50 * (56 + 72))
    assert counts["project"] == (50 * 4 * (11 + 7), 50 * 146)
    assert counts["sort"] == (50 * 4 + 3 * 40 * (8 + 8), 3 * 4 * 40)
    assert counts["bin"] == (40 * (4 + 28) + 60 * (8 + 5 + 5), 40 * 20 + 60 * 10)
    assert counts["blend"] == (30 * 40 + 512 * 16, 2000 * 23 + 2 * 512 * 10)
    assert counts["blend backward"] == (30 * 40 + 60 * 44 + 512 * 4 * (3 + 1 + 3 + 1), 2000 * 23 + 2 * 512 * 40)
    assert counts["project backward"] == (60 * 44 + 40 * 44 + 50 * 4 * (14 + 2), 40 * 292 + 60 * 11)
    assert counts["background: MLP"] == (4 * (20 * (11 + 3) + 72), 2 * 20 * 72)
    # The hidden layers (11 x 4 + 4 x 4 weights) once more, then two products for each layer.
    assert counts["background backward: MLP"][1] == 2 * 20 * (60 + 2 * 72)
    assert counts["composite"] == (4 * (512 * (3 + 1 + 3) + 160 * 3), 512 * 3 * 11)
    assert counts["loss backward"] == (512 * 3 * (4 + 4), 512 * 3)
    assert counts["Adam"] == (1000 * 7 * 4, 1000 * 14)
    without = count_step(ModelSizes(100, 1000, model.geometry, model.radiance, 9, background=False), view)
    assert not any(row.startswith("background") for row in without)
    assert without["composite"].bytes == 512 * 4 * (3 + 1 + 3)


def test_sizes_of_a_model_are_those_of_its_tensors() -> None:
    sizes = measure_model_sizes(make_model(background=True))
    # 3 levels of 2 features; 128 rows at most per level, and 27 vertices on the first.
    assert sizes.geometry == FieldSizes((6, 16, 16, 8), 3, 27 + 128 + 128)
    assert sizes.radiance == FieldSizes((6 + 24, 16, 16, 3), 3, 27 + 128 + 128)
    weights = 6 * 16 + 16 * 16 + 16 * 8 + 30 * 16 + 16 * 16 + 16 * 3
    assert sizes.parameters == 50 * 8 + 2 * 2 * 283 + weights + (16 + 16 + 8) + (16 + 16 + 3)


def test_the_table_divides_measured_time_by_the_bound(profile: StepProfile) -> None:
    cells = {row[0]: row for row in table_rows(profile, MADE_UP_RATES)}
    assert list(cells) == [*OPERATION_ROWS, "total"]
    work = profile.median_works()["Adam"]
    bound = 1e3 * max(work.bytes / 1e9, work.flops / 1e10)
    assert float(cells["Adam"][5]) == pytest.approx(bound, abs=0.01) and cells["Adam"][6] == "memory"
    assert float(cells["Adam"][7]) == pytest.approx(profile.median_ms("Adam") / bound, abs=0.06)
    assert cells["other"][3:] == 5 * [""]


def test_the_command_prints_the_sizes_above_the_table(monkeypatch, capsys) -> None:
    monkeypatch.setattr("hyrfpack.load_scene", lambda path, max_size: make_scene())
    monkeypatch.setattr("hyrfpack.load_model", lambda path: make_model(background=True))
    monkeypatch.setattr(step_profile, "COPIED_FLOATS_PER_THREAD", 1 << 10)
    monkeypatch.setattr(step_profile, "MATRIX_SIDE", 16)
    monkeypatch.setattr(step_profile, "RATE_REPEATS", 2)
    monkeypatch.setenv("HYRFPACK_THREADS", "2")  # restored after the test, as --threads sets it
    step_profile.main(["--data", "balls", "--model", "balls.hyrf", "--steps", "1", "--threads", "1"])
    heading, empty, *table = capsys.readouterr().out.splitlines()
    assert heading.startswith("photos of 32 x 32, 50 Gaussians, ") and "1 thread, " in heading and empty == ""
    assert [line.split(" | ")[0] for line in table[2:]] == [f"| {row}" for row in (*OPERATION_ROWS, "total")]


def test_a_missing_model_is_an_error_of_one_line(tmp_path, capsys) -> None:
    with pytest.raises(SystemExit) as exit_info:
        step_profile.main(["--data", str(tmp_path), "--model", str(tmp_path / "none.hyrf")])
    assert exit_info.value.code == 2
    assert "none.hyrf" in capsys.readouterr().err.splitlines()[-1]
