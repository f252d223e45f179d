"""Runs in blocks: their files, how they resume, and their errors."""

from __future__ import annotations

import dataclasses
import errno
import json
import os
import shutil
import signal

import numpy as np
import pytest
import torch
from commands import refused, succeeded
from layers import only_in_acceptance
from rank_tasks import BLOCK_CONFIG, block_scene
from scenes import QUIET_CONTEXT

from hyrfpack.blocks import run, train_blocks
from hyrfpack.blocks.journal import Journal, is_begun
from hyrfpack.blocks.plan import MIN_BLOCK_PHOTOS, plan_blocks
from hyrfpack.blocks.run import BYTES_PER_BUDGETED_GAUSSIAN, choose_grid
from hyrfpack.context import RunContext
from hyrfpack.errors import HyrfError
from hyrfpack.format import load_merged_model, load_model
from hyrfpack.format.run_folder import CHECKPOINT_FILE, MODEL_FILE
from hyrfpack.format.sections import MAX_PARTS
from hyrfpack.model.merged import world_positions
from hyrfpack.parallel.ranks import SINGLE_PROCESS, Ranks
from hyrfpack.progress import StepEvent
from hyrfpack.render import render_view
from hyrfpack.scene import View
from hyrfpack.train import load_training_scene, train_model
from hyrfpack.train.results import RECORD_FILE
from hyrfpack.train.setup import PACKED_BYTES_PER_GAUSSIAN, PACKED_HEADER_BYTES


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    out = tmp_path_factory.mktemp("blocks") / "run"
    return out, train_blocks(block_scene(), out, BLOCK_CONFIG, "2x1", context=QUIET_CONTEXT)


def test_a_run_in_blocks_leaves_one_model_with_a_part_for_each_block(finished):
    out, result = finished
    assert {path.name for path in out.iterdir()} == {"model.hyrf", "metrics.json", "views", "blocks"}
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics == json.loads(json.dumps(result.metrics))
    assert result.complete and result.step == 24 == metrics["curve"][-1]["step"]
    model = load_merged_model(result.model)
    assert len(model) == metrics["gaussians"] and result.model.stat().st_size == metrics["bytes"]
    assert {name.removeprefix("block ") for name in model.names} == {block["name"] for block in metrics["blocks"]}
    for part in model.parts:
        assert part.exposure is not None


def test_a_single_block_is_a_run_without_blocks(tmp_path):
    config = dataclasses.replace(BLOCK_CONFIG, steps=2, preset="auto")
    result = train_blocks(block_scene(), tmp_path / "run", config, "1x1", context=QUIET_CONTEXT)
    assert result.complete and len(load_model(result.model)) == result.metrics["gaussians"]
    assert not is_begun(tmp_path / "run")
    assert "asked for" not in result.metrics["choices"]["preset"]  # It is still the scene that decides.


def test_a_new_run_in_blocks_removes_the_checkpoint_of_a_run_without_blocks(tmp_path):
    for name in (CHECKPOINT_FILE, RECORD_FILE):
        (tmp_path / name).write_bytes(b"of an earlier run")
    Journal(tmp_path / "blocks" / "blocks.json", {}, {}).start()
    assert is_begun(tmp_path) and [path.name for path in tmp_path.iterdir()] == ["blocks"]


def test_a_file_of_an_earlier_run_that_cannot_be_removed_is_a_clear_error(tmp_path):
    (tmp_path / CHECKPOINT_FILE).mkdir()
    with pytest.raises(HyrfError, match=f"{CHECKPOINT_FILE}: this file of an earlier run cannot be removed"):
        Journal(tmp_path / "blocks" / "blocks.json", {}, {}).start()


def test_logs_of_blocks_do_not_replace_other_files(tmp_path):
    (tmp_path / "log-2-1.jsonl").write_bytes(b"of somebody else")
    with pytest.raises(HyrfError, match=r"log-2-1\.jsonl.*overwrite=True"):
        train_blocks(
            block_scene(), tmp_path / "run", BLOCK_CONFIG, "2x1", log=tmp_path / "log.jsonl", context=QUIET_CONTEXT
        )
    assert (tmp_path / "log-2-1.jsonl").read_bytes() == b"of somebody else"
    assert not (tmp_path / "run" / "blocks").exists()


def test_a_target_size_that_no_file_can_have_is_refused_before_training(tmp_path):
    config = dataclasses.replace(BLOCK_CONFIG, max_gaussians=None, target_bytes=100)
    with pytest.raises(HyrfError, match="below the smallest possible file"):
        train_blocks(block_scene(), tmp_path / "run", config, "2x1", context=QUIET_CONTEXT)
    assert not (tmp_path / "run").exists()


def test_a_run_without_blocks_replaces_one_in_blocks_only_if_asked_and_then_removes_its_journal(finished, tmp_path):
    run, config = tmp_path / "run", dataclasses.replace(BLOCK_CONFIG, steps=2)
    shutil.copytree(finished[0], run)
    with pytest.raises(HyrfError, match="is one in blocks; resume it with the same `blocks`"):
        train_model(block_scene(), run, config, resume=True, context=QUIET_CONTEXT)
    (run / MODEL_FILE).unlink()  # as while the blocks are trained
    with pytest.raises(HyrfError, match=r"holds an earlier run \(blocks/blocks.json\)"):
        train_model(block_scene(), run, config, context=QUIET_CONTEXT)
    assert is_begun(run)

    train_model(block_scene(), run, config, overwrite=True, context=QUIET_CONTEXT)

    assert not is_begun(run)
    with pytest.raises(HyrfError, match="no run in blocks to resume"):
        train_blocks(block_scene(), run, BLOCK_CONFIG, "2x1", resume=True, context=QUIET_CONTEXT)


def test_a_part_is_what_its_block_has_learnt_in_its_cells(finished):
    out, result = finished
    plan = plan_blocks(block_scene(), 2, 1)
    model = load_merged_model(result.model)
    parts = dict(zip(model.names, model.parts, strict=True))
    for block, facts in zip(plan.blocks, result.metrics["blocks"], strict=True):
        trained = load_model(out / facts["folder"])
        keep = plan.core_mask(block, world_positions(trained))
        part = parts[f"block {block.name}"]
        assert 0 < len(part) == keep.sum() == facts["kept"] < len(trained) == facts["gaussians"]
        assert torch.equal(part.gaussians.positions, trained.gaussians.positions[torch.from_numpy(keep)])


def test_scores_are_those_of_the_merged_file(finished):
    _, result = finished
    model = load_merged_model(result.model)
    expected = {}
    for view in block_scene().test:
        with torch.no_grad():
            rgb = render_view(model, view.camera).rgb.double().numpy().clip(0, 1)
        expected[view.name] = -10 * np.log10(np.mean((rgb - view.load().composite()) ** 2))
    found = {view["name"]: view["psnr"] for view in result.metrics["evaluation"]["views"]}
    assert found == pytest.approx(expected, abs=0.1)  # renders are rounded to 8 bits


def test_a_total_budget_is_shared_out_by_the_points_of_blocks(finished):
    out, result = finished
    for facts in result.metrics["blocks"]:
        settings = json.loads((out / facts["folder"] / "metrics.json").read_text())["settings"]
        assert settings["max_gaussians"] == round(150 * facts["points"] / 80)
        assert facts["gaussians"] <= settings["max_gaussians"]


@pytest.mark.parametrize("stop_at", only_in_acceptance([5, 17], [5]))
def test_an_interrupted_run_resumes_to_the_same_bytes_and_keeps_finished_blocks(finished, tmp_path, stop_at):
    steps: list[StepEvent] = []

    def count(event: object) -> None:
        if isinstance(event, StepEvent):
            steps.append(event)

    interrupted = RunContext(progress=count, stop=lambda: len(steps) >= stop_at)
    first = train_blocks(block_scene(), tmp_path / "run", BLOCK_CONFIG, "2x1", context=interrupted)
    assert not first.complete and first.step == stop_at and first.model is None
    steps.clear()
    resumed = RunContext(progress=count)
    second = train_blocks(block_scene(), tmp_path / "run", BLOCK_CONFIG, "2x1", resume=True, context=resumed)
    assert len(steps) == 24 - stop_at
    assert second.model.read_bytes() == finished[1].model.read_bytes()


def test_a_finished_run_is_neither_replaced_nor_resumed_with_other_settings(finished):
    out, result = finished
    before = result.model.read_bytes()
    with pytest.raises(HyrfError, match="holds an earlier run; `resume=True` continues it"):
        train_blocks(block_scene(), out, BLOCK_CONFIG, "2x1", context=QUIET_CONTEXT)
    other = dataclasses.replace(BLOCK_CONFIG, steps=13)
    for config, blocks, named in ((other, "2x1", "steps"), (BLOCK_CONFIG, "1x2", "blocks")):
        with pytest.raises(HyrfError, match=rf"started with other settings \({named}\)"):
            train_blocks(block_scene(), out, config, blocks, resume=True, context=QUIET_CONTEXT)
    fewer = dataclasses.replace(block_scene(), train=block_scene().train[1:])
    with pytest.raises(HyrfError, match="started with other photos"):
        train_blocks(fewer, out, BLOCK_CONFIG, "2x1", resume=True, context=QUIET_CONTEXT)
    assert result.model.read_bytes() == before


def test_a_run_is_not_resumed_with_other_poses(finished):
    out, result = finished
    before, scene = result.model.read_bytes(), block_scene()

    def twice_as_far(view: View) -> View:
        pose = view.camera.camera_from_world.copy()
        pose[:3, 3] *= 2
        return dataclasses.replace(view, camera=dataclasses.replace(view.camera, camera_from_world=pose))

    views = {name: [twice_as_far(view) for view in getattr(scene, name)] for name in ("train", "test")}
    larger = dataclasses.replace(scene, points=2 * scene.points, **views)
    with pytest.raises(HyrfError, match="started with other poses or points"):
        train_blocks(larger, out, BLOCK_CONFIG, "2x1", resume=True, context=QUIET_CONTEXT)
    assert result.model.read_bytes() == before


def test_a_journal_of_an_earlier_version_is_resumed(finished, tmp_path):
    shutil.copytree(finished[0], tmp_path / "run")
    path = tmp_path / "run" / "blocks" / "blocks.json"
    content = json.loads(path.read_text())
    assert len(content.pop("division")) == 6 + 3 + 4 + 2
    path.write_text(json.dumps(content))
    resumed = train_blocks(block_scene(), tmp_path / "run", BLOCK_CONFIG, "2x1", resume=True, context=QUIET_CONTEXT)
    assert resumed.model.read_bytes() == finished[1].model.read_bytes()


def test_a_target_size_counts_the_decoders_of_each_block(monkeypatch, tmp_path):
    budgets = []
    monkeypatch.setattr(run, "train_model", lambda scene, out, config, **_: budgets.append(config.max_gaussians))
    config = dataclasses.replace(BLOCK_CONFIG, max_gaussians=None, target_bytes=30_000)
    scene = block_scene()
    plan = plan_blocks(scene, 2, 1)
    with pytest.raises(AttributeError):  # the replaced function returns nothing
        train_blocks(scene, tmp_path / "run", config, "2x1", context=QUIET_CONTEXT)
    all_gaussians = (30_000 - 2 * PACKED_HEADER_BYTES) / PACKED_BYTES_PER_GAUSSIAN
    assert budgets == [round(all_gaussians * plan.blocks[0].point_count / len(scene.points))]


def test_there_is_no_run_to_resume_in_an_empty_folder(tmp_path):
    with pytest.raises(HyrfError, match="no run in blocks to resume"):
        train_blocks(block_scene(), tmp_path / "run", BLOCK_CONFIG, "2x1", resume=True, context=QUIET_CONTEXT)


def test_an_error_names_the_block_and_says_how_to_continue(tmp_path):
    """Exposure compensation refuses transparent photos when the first block begins."""
    scene = dataclasses.replace(block_scene(), has_alpha=True)
    with pytest.raises(HyrfError, match=r"^block \d-1 \(1 of 2\): .*transparent.*kept.*`resume=True` continues"):
        train_blocks(scene, tmp_path / "run", BLOCK_CONFIG, "2x1", context=QUIET_CONTEXT)


@pytest.mark.usefixtures("signals")
@pytest.mark.parametrize("block", [1, 2])
def test_a_signal_in_the_last_step_of_a_block_starts_no_other_block(tmp_path, block):
    steps: list[StepEvent] = []

    def stop_at_the_end(event: object) -> None:
        if isinstance(event, StepEvent):
            steps.append(event)
            if len(steps) == block * BLOCK_CONFIG.steps:
                signal.raise_signal(signal.SIGTERM)

    context = RunContext(progress=stop_at_the_end)
    result = train_blocks(block_scene(), tmp_path / "run", BLOCK_CONFIG, "2x1", context=context)
    assert result.complete == (block == 2) and len(steps) == block * BLOCK_CONFIG.steps == result.step


@pytest.mark.acceptance
def test_a_stop_before_the_first_step_can_be_resumed(finished, tmp_path):
    stopped = RunContext(progress=None, stop=lambda: True)
    first = train_blocks(block_scene(), tmp_path / "run", BLOCK_CONFIG, "2x1", context=stopped)
    assert not first.complete and is_begun(tmp_path / "run")
    second = train_blocks(block_scene(), tmp_path / "run", BLOCK_CONFIG, "2x1", resume=True, context=QUIET_CONTEXT)
    assert second.model.read_bytes() == finished[1].model.read_bytes()


class _SecondOfTwo(Ranks):
    """Process 1 of 2, whose process 0 was started with one step more."""

    def all_gather(self, item):
        return [{**item, "steps": item["steps"] + 1} if item else item, item]


def test_processes_that_were_started_with_other_settings_are_refused_before_anything_is_written(tmp_path):
    context = dataclasses.replace(QUIET_CONTEXT, ranks=_SecondOfTwo(rank=1, size=2, local_rank=1, local_size=2))
    with pytest.raises(HyrfError, match=r"process 1 of 2 was started with other settings than process 0 \(steps\)"):
        train_blocks(block_scene(), tmp_path / "run", BLOCK_CONFIG, "2x1", context=context)
    assert not (tmp_path / "run").exists()


def test_a_resumed_run_in_automatic_blocks_keeps_its_grid(finished, tmp_path, monkeypatch):
    shutil.copytree(finished[0], tmp_path / "run")
    monkeypatch.setattr(run, "choose_grid", lambda *_: pytest.fail("the grid of the run was not kept"))
    resumed = train_blocks(block_scene(), tmp_path / "run", BLOCK_CONFIG, "auto", resume=True, context=QUIET_CONTEXT)
    assert resumed.model.read_bytes() == finished[1].model.read_bytes()


def test_results_of_an_earlier_run_do_not_lie_beside_the_merged_model(finished, tmp_path):
    shutil.copytree(finished[0], tmp_path / "run")
    (tmp_path / "run" / "curve.png").write_bytes(b"of a run without blocks")
    train_blocks(block_scene(), tmp_path / "run", BLOCK_CONFIG, "2x1", resume=True, context=QUIET_CONTEXT)
    assert {path.name for path in (tmp_path / "run").iterdir()} == {"model.hyrf", "metrics.json", "views", "blocks"}


def test_a_picture_that_cannot_be_written_is_a_missing_result_of_the_run(finished, tmp_path, monkeypatch):
    shutil.copytree(finished[0], tmp_path / "run")
    move = os.replace

    def refuse_pictures(source: str, target: str) -> None:
        if str(target).endswith(".png"):
            raise OSError(errno.ENOSPC, "No space left on device")
        move(source, target)

    monkeypatch.setattr("hyrfpack.atomic.os.replace", refuse_pictures)
    result = train_blocks(block_scene(), tmp_path / "run", BLOCK_CONFIG, "2x1", resume=True, context=QUIET_CONTEXT)
    assert result.complete and "the model is finished, but views is missing" in result.missing
    assert (tmp_path / "run" / "metrics.json").is_file()


@pytest.mark.parametrize("content", ["{", "[]", "{}"])
@pytest.mark.parametrize("file", ["blocks.json", "1-1/metrics.json"])
def test_a_damaged_journal_or_result_of_a_block_is_one_clear_error(finished, tmp_path, file, content):
    run = tmp_path / "run"
    shutil.copytree(finished[0], run)
    (run / "blocks" / file).write_text(content)
    with pytest.raises(HyrfError, match=r"damaged; train anew with `overwrite=True`"):
        train_blocks(block_scene(), run, BLOCK_CONFIG, "2x1", resume=True, context=QUIET_CONTEXT)


@pytest.mark.parametrize(
    ("name", "value"), [("curve", []), ("settings", {}), ("log_gains", [1]), ("seconds", "1"), ("stage_seconds", None)]
)
def test_a_damaged_value_in_the_results_of_a_block_is_one_clear_error(finished, tmp_path, name, value):
    run = tmp_path / "run"
    shutil.copytree(finished[0], run)
    path = run / "blocks" / "1-1" / "metrics.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), name: value}))
    with pytest.raises(HyrfError, match=r"damaged; train anew with `overwrite=True`$"):
        train_blocks(block_scene(), run, BLOCK_CONFIG, "2x1", resume=True, context=QUIET_CONTEXT)


def test_the_photos_of_a_block_are_not_taken_for_those_of_the_whole_set(finished):
    out, result = finished
    assert load_training_scene(out / result.metrics["blocks"][0]["folder"]) is None


@pytest.mark.parametrize(("gibibytes", "processes", "blocks"), [(1000, 1, 1), (4, 1, 2), (8, 2, 2), (2, 1, 3)])
def test_auto_takes_as_many_blocks_as_the_memory_of_each_process_asks_for(monkeypatch, gibibytes, processes, blocks):
    """A budget of 1.3 million Gaussians needs 3.03 GiB, in half of the memory."""
    monkeypatch.setattr("hyrfpack.blocks.run.memory_bytes", lambda: gibibytes * 2**30)
    config = dataclasses.replace(BLOCK_CONFIG, max_gaussians=1_300_000)
    photos = (2 * block_scene().train)[:14]  # for at most three blocks
    scene, ranks = dataclasses.replace(block_scene(), train=photos), Ranks(size=processes, local_size=processes)
    columns, rows = choose_grid(scene, config, torch.device("cpu"), ranks)
    assert columns * rows == blocks


@pytest.mark.parametrize("photos", [4, 11, 12, 20, 400])
@pytest.mark.parametrize("needed", [1, 2, 3, 5, 7, 64])
def test_auto_has_neither_too_few_blocks_nor_blocks_with_too_few_photos(monkeypatch, photos, needed):
    monkeypatch.setattr("hyrfpack.blocks.run.memory_bytes", lambda: 2**30)
    budget = int(needed * 2**29 / BYTES_PER_BUDGETED_GAUSSIAN)
    scene = dataclasses.replace(block_scene(), train=(40 * block_scene().train)[:photos])
    config = dataclasses.replace(BLOCK_CONFIG, max_gaussians=budget)
    columns, rows = choose_grid(scene, config, torch.device("cpu"), SINGLE_PROCESS)
    most = min(photos // MIN_BLOCK_PHOTOS, MAX_PARTS)
    assert min(needed, most) <= columns * rows <= most


@pytest.mark.parametrize(
    ("grid", "problem"),
    [
        ("2x", "Error: '2x' is no grid of blocks; use --blocks auto, or columns and rows as in --blocks 2x2"),
        ("99x99", "99x99 are 9,801 blocks, and a file holds at most 64 parts; use a smaller grid as --blocks"),
        ("3x1", "8 training photos are too few for 3x1 blocks; use at most 2 blocks; each needs 4 photos"),
    ],
)
def test_the_command_refuses_a_grid_that_does_not_suit_the_photos(data, tmp_path, grid, problem):
    assert problem in refused("train", data, "-o", tmp_path / "run", "--blocks", grid)
    assert not (tmp_path / "run").exists()


def test_the_command_trains_blocks(data, tmp_path):
    run = succeeded("train", data, "-o", tmp_path / "run", "--blocks", "2x1", "--steps", 2, "--max-gaussians", 60)
    assert "block 1-1" in run.stderr and "held-out views" in run.stdout
    assert "part" in succeeded("info", tmp_path / "run").stdout
    assert "holds an earlier run" in refused("train", data, "-o", tmp_path / "run", "--blocks", "2x1")
