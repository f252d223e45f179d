"""Training by two processes agrees with one process that averages their views; stopping, resuming and errors."""

from __future__ import annotations

import dataclasses
import math
import shutil
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import rank_tasks as tasks
import torch
from hypothesis import given
from hypothesis import strategies as st
from rank_processes import ProcessOutcome, needs_ranks, run_on_ranks

from hyrfpack.config.train import FIELD_WARMUP_STEPS
from hyrfpack.errors import HyrfError
from hyrfpack.ops.ssim import photometric_loss
from hyrfpack.parallel.ranks import SINGLE_PROCESS, Ranks
from hyrfpack.render import render_view
from hyrfpack.scene import Scene
from hyrfpack.train import TrainConfig, Trainer
from hyrfpack.train.density import DensityControl
from hyrfpack.train.distributed import StepStats, average_gradients, check_settings, digest, pack_step_stats
from hyrfpack.train.optimizer import Optimizer
from hyrfpack.train.setup import build_model
from hyrfpack.train.trainer import shuffled

WORLD_SIZE = 2


class StepResult(NamedTuple):
    """The results of one step."""

    loss: float
    error: float
    gaussians: int


def train_on_one_process(scene: Scene, config: TrainConfig) -> tuple[list[StepResult], Trainer]:
    """Train as two processes should: render the views of both in turn and average their gradients.

    Returns:
        The results of each step, and the trainer with the trained model and exposures.
    """
    trainer = Trainer(scene, config)
    model, exposures = trainer.model, trainer.exposures
    optimizer = Optimizer(model, trainer.learning_rates, WORLD_SIZE, FIELD_WARMUP_STEPS)
    steps = math.ceil(config.steps / WORLD_SIZE)
    density = DensityControl(config.density, steps, trainer.budget, len(model), config.seed)
    views, rows = list(shuffled(scene.train, config.seed, range(steps * WORLD_SIZE))), []
    for step in range(1, steps + 1):
        own, losses, errors = views[(step - 1) * WORLD_SIZE : step * WORLD_SIZE], [], []
        learnt = [*model.parameters(), *([exposures.values] if exposures else [])]
        sums = [torch.zeros_like(parameter) for parameter in learnt]
        for view in own:
            settings = trainer.resolution.render_settings(view.camera, step)
            drawn = render_view(model, view.camera, settings, absgrad=density.watching(step))
            image = exposures.exposed(drawn.rgb, exposures.row(view)) if exposures else drawn.rgb
            photo = torch.from_numpy(view.load().composite())
            loss = photometric_loss(image, photo, None, ssim_weight=config.ssim_weight)
            loss.backward()
            density.observe(drawn, view.camera, model)
            for total, parameter in zip(sums, learnt, strict=True):
                if parameter.grad is not None:
                    total += parameter.grad
                parameter.grad = None
            losses.append(loss.item())
            errors.append((image.detach() - photo).square().mean().item())
        for total, parameter in zip(sums, learnt, strict=True):
            parameter.grad = total / WORLD_SIZE
        optimizer.step(step - 1, steps)
        if exposures:
            exposures.step(config.learning_rates.at("exposure", WORLD_SIZE * (step - 1), WORLD_SIZE * steps), own)
        density.act(step, model, optimizer)
        rows.append(StepResult(float(np.mean(losses)), float(np.mean(errors)), len(model)))
    return rows, trainer


# -- statistics of a step --------------------------------------------------------------------------------------------

ERROR_VALUES = st.floats(0, 10, width=32)


@given(
    st.lists(st.tuples(ERROR_VALUES, st.none() | ERROR_VALUES, st.booleans(), st.booleans()), min_size=1, max_size=6)
)
def test_step_statistics_are_means_over_views_and_flags_of_any_rank(rows):
    """An error of None belongs to a photo that is masked completely."""
    messages = [
        pack_step_stats(
            torch.tensor(loss), torch.tensor(math.nan if error is None else error), stop=stop, problem=problem
        )
        for loss, error, stop, problem in rows
    ]
    found = StepStats.from_sums(torch.stack(messages).sum(0).tolist(), len(rows))
    errors = [error for _, error, _, _ in rows if error is not None]
    assert found.loss == pytest.approx(np.mean([row[0] for row in rows]), rel=1e-5, abs=1e-30)
    assert found.error == pytest.approx(np.mean(errors) if errors else math.nan, rel=1e-5, abs=1e-30, nan_ok=True)
    assert found.stop is any(row[2] for row in rows) and found.problem is any(row[3] for row in rows)


def test_a_loss_that_is_not_finite_stays_so_in_the_step_statistics():
    messages = torch.stack(
        [pack_step_stats(torch.tensor(loss), torch.tensor(1.0), stop=False, problem=False) for loss in (1, math.nan)]
    )
    assert math.isnan(StepStats.from_sums(messages.sum(0).tolist(), 2).loss)


def test_one_process_keeps_its_gradients_and_its_settings():
    weight = torch.nn.Parameter(torch.zeros(3, 2))
    weight.grad = torch.arange(6.0).view(3, 2)
    expected = weight.grad.clone()
    assert average_gradients(SINGLE_PROCESS, [weight], torch.tensor([2.0, 5.0])).tolist() == [2.0, 5.0]
    assert torch.equal(weight.grad, expected)
    check_settings(SINGLE_PROCESS, {"seed": 1})


def test_averaged_gradients_lie_at_multiples_of_16_bytes():
    """The Adam kernel then reads 16 bytes at a time."""
    parameters = [torch.nn.Parameter(torch.zeros(size)) for size in (3, 5, 8, 1)]
    for number, parameter in enumerate(parameters, 1):
        parameter.grad = torch.full_like(parameter, number)
    sums = average_gradients(Ranks(), parameters, torch.tensor([7.0]))
    start = parameters[0].grad.data_ptr()
    assert all((parameter.grad.data_ptr() - start) % 16 == 0 for parameter in parameters)
    assert all(bool((p.grad == number).all()) for number, p in enumerate(parameters, 1)) and sums.tolist() == [7.0]


def test_a_digest_depends_on_every_bit():
    tensors = [torch.zeros(3), torch.arange(4.0).view(2, 2).T]
    changed = [tensors[0].clone(), tensors[1]]
    changed[0][1] = -0.0
    assert digest(tensors) == digest([tensor.clone() for tensor in tensors]) != digest(changed)


# -- two processes against one ---------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def outcomes_of_both() -> list[ProcessOutcome]:
    return run_on_ranks(tasks.train_both_scenes)


TRAINING_CASES = {
    "six photos": (0, tasks.six_photo_scene, tasks.SIX_PHOTO_CONFIG),
    "three photos, exposed": (1, tasks.three_photo_scene, tasks.EXPOSURE_CONFIG),
}


@pytest.fixture(scope="module", params=TRAINING_CASES)
def two_ranks_and_one(request, outcomes_of_both) -> tuple[list[dict], list[StepResult], Trainer]:
    """The results of each rank, and those of one process that does the work of both."""
    number, scene, config = TRAINING_CASES[request.param]
    return [end.result[number] for end in outcomes_of_both], *train_on_one_process(scene(), config)


@needs_ranks
def test_two_processes_have_the_curve_of_one_that_averages_their_views(two_ranks_and_one):
    (first, second), expected, _ = two_ranks_and_one
    assert first["rows"] == second["rows"] and len(expected) in (30, 200)
    np.testing.assert_allclose(first["rows"], expected, rtol=0, atol=1e-5)


@needs_ranks
def test_two_processes_end_with_the_model_of_one_that_averages_their_views(two_ranks_and_one):
    (first, _), _, trainer = two_ranks_and_one
    for name, parameter in trainer.model.named_parameters():
        np.testing.assert_allclose(first["parameters"][name], parameter.detach(), rtol=0, atol=1e-3)
    if trainer.exposures is not None:
        np.testing.assert_allclose(first["gains"], trainer.exposures.values.detach(), rtol=0, atol=1e-5)


@needs_ranks
def test_the_compared_runs_add_and_prune_gaussians(two_ranks_and_one):
    """Without this, the comparison would prove little."""
    (first, _), _, _ = two_ranks_and_one
    counts = [count for _, _, count in first["rows"]]
    assert len(set(counts)) >= 3 and counts[0] <= counts[-1] < max(counts)


@needs_ranks
def test_both_ranks_have_identical_parameters_after_every_step(two_ranks_and_one):
    (first, second), _, _ = two_ranks_and_one
    assert first["digests"] == second["digests"] and len(set(first["digests"])) == len(first["digests"])


@needs_ranks
def test_all_ranks_start_from_the_model_of_the_main_process():
    """Depths that differ by rounding, as on processors of two kinds, would give other points and colours."""
    first, second = (outcome.result for outcome in run_on_ranks(tasks.digest_of_first_model))
    assert first == second == tasks.digest_of_first_model(SINGLE_PROCESS)


@needs_ranks
def test_both_ranks_record_the_same_curve_except_for_times(two_ranks_and_one):
    (first, second), _, _ = two_ranks_and_one
    curves = [[{**record, "seconds": 0} for record in rank["records"]] for rank in (first, second)]
    assert curves[0] == curves[1] and [record["step"] for record in curves[0]] == list(range(1, len(curves[0]) + 1))


@needs_ranks
def test_gains_agree_on_both_ranks_also_where_both_render_the_same_photo(outcomes_of_both):
    names = [view.name for view in shuffled(tasks.three_photo_scene().train, tasks.EXPOSURE_CONFIG.seed, range(60))]
    assert sum(names[place] == names[place + 1] for place in range(0, 60, 2)) > 1  # otherwise the test proves little
    gains = [end.result[1]["gains"] for end in outcomes_of_both]
    np.testing.assert_array_equal(gains[0], gains[1])
    untrained = Trainer(tasks.three_photo_scene(), tasks.EXPOSURE_CONFIG).exposures.values
    assert np.abs(gains[0] - untrained.detach().numpy()).max() > 1e-3


@pytest.mark.parametrize(("size", "steps"), [(1, 7), (2, 4), (3, 3), (7, 1), (8, 1)])
def test_ranks_together_follow_the_view_order_of_one_process(size, steps):
    config = dataclasses.replace(tasks.SIX_PHOTO_CONFIG, steps=7)
    ranks = [dataclasses.replace(SINGLE_PROCESS, rank=rank, size=size) for rank in range(size)]
    scene = tasks.six_photo_scene()
    model, _, _ = build_model(scene, config)  # Else ranks would communicate while they make their models.
    trainers = [Trainer(scene, config, model=model, ranks=rank) for rank in ranks]
    orders = [[view.name for view in trainer._order()] for trainer in trainers]
    assert {trainer.steps for trainer in trainers} == {steps}
    names = [name for step in zip(*orders, strict=True) for name in step]
    assert names == [view.name for view in shuffled(tasks.six_photo_scene().train, config.seed, range(size * steps))]


# -- stopping and resuming -------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def run_folder_and_outcomes(tmp_path_factory) -> tuple[Path, list[ProcessOutcome]]:
    """A folder with an uninterrupted run and one in three parts, and the outcomes of the processes."""
    folder = tmp_path_factory.mktemp("parts")
    alone = Trainer(tasks.held_out_scene(), tasks.RUN_CONFIG)
    (folder / "alone").mkdir()
    alone.run(checkpoint=folder / "alone" / "checkpoint.pt", stop=lambda: alone.step == 3)
    return folder, run_on_ranks(tasks.stop_and_resume, folder / "whole", folder / "parts", folder / "alone")


def read_model_bytes(folder: Path) -> bytes:
    return (folder / "model.hyrf").read_bytes()


@needs_ranks
def test_a_stop_of_one_rank_stops_all_after_the_same_step_and_keeps_the_checkpoint(run_folder_and_outcomes):
    folder, ends = run_folder_and_outcomes
    for end in ends:
        assert end.result["first"] == (False, 3, False) and end.result["second"] == (False, 17, False)
        assert end.result["checkpoint stays"]
    assert not (folder / "parts" / "model.hyrf").exists()


@needs_ranks
def test_a_stopped_and_resumed_run_gives_the_bytes_of_the_uninterrupted_one(run_folder_and_outcomes, tmp_path):
    folder, ends = run_folder_and_outcomes
    resumed = tmp_path / "resumed"
    shutil.copytree(folder / "parts", resumed)
    again = run_on_ranks(tasks.train_run, resumed, True)
    assert (
        [end.result for end in again] == [end.result["whole"] for end in ends] == [(True, 30, True), (True, 30, False)]
    )
    assert read_model_bytes(resumed) == read_model_bytes(folder / "whole")
    assert not (resumed / "checkpoint.pt").exists()


@needs_ranks
def test_all_ranks_leave_out_the_pilots_that_rank_0_has_finished(tmp_path):
    ends = run_on_ranks(tasks.resume_pilots, tmp_path / "whole", tmp_path / "parts")
    assert [end.result[0] for end in ends] == [2, 2]
    assert read_model_bytes(tmp_path / "parts") == read_model_bytes(tmp_path / "whole")
    assert not (tmp_path / "parts" / "pilots.json").exists()


@needs_ranks
def test_all_ranks_use_the_teachers_that_an_interrupted_run_has_left(tmp_path):
    ends = run_on_ranks(tasks.resume_teachers, tmp_path / "whole", tmp_path / "parts")
    assert [end.result for end in ends] == [[2, 3], [2, 3]]
    assert read_model_bytes(tmp_path / "parts") == read_model_bytes(tmp_path / "whole")
    assert {path.name for path in (tmp_path / "parts").iterdir()} >= {"model.hyrf", "metrics.json"}
    assert not list((tmp_path / "parts").glob("teacher-*"))


@needs_ranks
def test_only_rank_0_writes_and_its_metrics_name_two_processes(run_folder_and_outcomes):
    folder, _ = run_folder_and_outcomes
    assert {path.name for path in (folder / "whole").iterdir()} == {"model.hyrf", "metrics.json", "curve.png", "views"}
    assert {path.name for path in (folder / "parts").iterdir()} == {"checkpoint.pt"}


@needs_ranks
def test_only_rank_0_logs_that_a_checkpoint_cannot_be_written(tmp_path):
    (tmp_path / "file").write_bytes(b"")
    first, second = (end.result for end in run_on_ranks(tasks.log_lost_checkpoints, tmp_path / "file" / "a.pt"))
    assert len(first) == 2 and all("without the checkpoint of step" in message for message in first)
    assert second == []


@needs_ranks
def test_a_run_resumes_only_with_the_same_number_of_processes(run_folder_and_outcomes):
    folder, ends = run_folder_and_outcomes
    with pytest.raises(HyrfError, match=r"other settings \(processes\)"):
        Trainer(tasks.held_out_scene(), tasks.RUN_CONFIG).load(folder / "parts" / "checkpoint.pt")
    assert all("other settings (processes)" in end.result["other size"] for end in ends)
    assert len({end.result["other size"] for end in ends}) == 1


@needs_ranks
def test_all_ranks_reject_a_folder_that_holds_a_run(run_folder_and_outcomes):
    _, ends = run_folder_and_outcomes
    assert {"the folder holds an earlier run" in end.result["there already"] for end in ends} == {True}


@needs_ranks
def test_processes_that_are_started_again_continue_from_the_checkpoint_if_there_is_one(
    run_folder_and_outcomes, tmp_path
):
    folder, _ = run_folder_and_outcomes
    shutil.copytree(folder / "parts", tmp_path / "some")
    for end in run_on_ranks(tasks.train_after_restart, tmp_path):
        assert end.result == [2, list(range(18, 31))]
    assert read_model_bytes(tmp_path / "some") == read_model_bytes(folder / "whole")


@needs_ranks
@pytest.mark.parametrize(("killed", "step"), [(0, 17), (1, 13)])
def test_a_process_that_is_killed_ends_the_other_and_the_run_can_be_resumed(
    killed, step, run_folder_and_outcomes, tmp_path
):
    ends = run_on_ranks(tasks.train_and_kill, tmp_path, killed, step, timeout_seconds=30)
    assert ends[killed].exit_code == -9
    assert "one of the 2 processes has ended" in ends[1 - killed].error_text
    assert f"the checkpoint of step {step // 5 * 5} is kept" in ends[1 - killed].error_text
    assert "\n" not in ends[1 - killed].error_text
    assert [path.name for path in tmp_path.iterdir()] == ["checkpoint.pt"]

    run_on_ranks(tasks.train_run, tmp_path, True)
    assert read_model_bytes(tmp_path) == read_model_bytes(run_folder_and_outcomes[0] / "whole")


# -- errors ----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def errors_by_rank() -> list[dict]:
    return [end.result for end in run_on_ranks(tasks.collect_errors)]


@needs_ranks
@pytest.mark.parametrize(
    ("case", "words"),
    [
        ("photo", ["process 1 of 2: 003.png: cannot be read"]),
        ("nan", ["'003.png'", "not finite", "photo itself"]),
        ("nan on one", ["'003.png'", "not finite", "photo itself"]),
        ("seed", ["process 1 of 2", "other settings", "(seed)", "versions"]),
        ("photos", ["process 1 of 2", "views)"]),
        ("version", ["process 1 of 2", "(versions)"]),
        ("memory", ["process 1 of 2: the GPU's memory ran out", "reduce `max_gaussians`"]),
        ("checkpoint", ["no checkpoint to resume"]),
    ],
)
def test_an_input_that_one_rank_cannot_use_ends_both_with_the_same_error(case, words, errors_by_rank):
    first, second = (rank[case] for rank in errors_by_rank)
    assert first == second and all(word in first for word in words), first


@needs_ranks
def test_ranks_can_still_communicate_after_an_error(errors_by_rank):
    assert [rank["none"] for rank in errors_by_rank] == [None, None]


@needs_ranks
def test_both_ranks_reject_unusable_input_before_the_first_step(tmp_path):
    first, second = (end.result for end in run_on_ranks(tasks.collect_setup_errors, tmp_path))
    assert first == second
    assert "held.png: cannot be read" in first["held out"]
    assert "there is no checkpoint to resume" in first["nothing to resume"]
    assert "process 1 of 2: 'what' is not a device" in first["device"]
    assert list(tmp_path.iterdir()) == []
