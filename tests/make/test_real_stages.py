"""Calls of `make` with the real stages: the products, their scores, target sizes and an interruption.

The other tests of `make` use fake stages.
"""

from __future__ import annotations

import re
import shutil
import signal
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from commands import hyrfpack, refused, succeeded
from explicit_balls import ball_splats
from exposures import random_map

from hyrfpack import evaluate_model, load_model, load_scene, save_model
from hyrfpack.config.make import MakeConfig
from hyrfpack.context import RunContext
from hyrfpack.format import describe_file
from hyrfpack.format.codec import load_with_provenance
from hyrfpack.make import Stopped, make_scene, stages
from hyrfpack.make.progress import Reporter
from hyrfpack.progress import StageEvent, ignore_progress
from hyrfpack.progress.lines import LineDisplay
from hyrfpack.splats.formats import ply
from hyrfpack.train import teachers

pytestmark = pytest.mark.usefixtures("quick_calibration")
PRODUCT_PATHS = ("model.hyrf", "run/model.hyrf", "export/scene.html")


@pytest.fixture(scope="module")
def reports() -> list[StageEvent]:
    """The progress that the call of `finished_work` reported."""
    return []


@pytest.fixture(scope="module")
def finished_work(reports, posed, tmp_path_factory) -> Path:
    """The work folder of a scene that was made with the real stages. Tests must not change it."""
    return make_scene(
        posed, tmp_path_factory.mktemp("made") / "scene.html", context=RunContext(progress=reports.append)
    ).work


@pytest.mark.acceptance
def test_every_stage_reports_its_progress_and_the_remaining_time(finished_work, reports):
    assert list(dict.fromkeys(progress.stage for progress in reports)) == [
        "training", "compression", "scoring", "export"
    ]  # fmt: skip
    for progress in reports:
        assert 0 <= progress.share <= 1 and progress.seconds_left is not None and progress.seconds_left >= 0, progress
    for stage in ("training", "compression", "scoring"):
        assert max(progress.share for progress in reports if progress.stage == stage) > 0.5


@pytest.mark.acceptance
def test_a_stop_asked_by_the_context_leaves_a_preview(posed, tmp_path):
    details: list[str] = []
    context = RunContext(progress=lambda event: details.extend(event.details[:1]), stop=lambda: "step 5/9" in details)
    with pytest.raises(Stopped, match="stopped in training") as stopped:
        make_scene(posed, tmp_path / "scene.html", context=context)
    assert stopped.value.scene == tmp_path / "scene.work" / "preview.hyrf" and stopped.value.scene.is_file()


@pytest.mark.acceptance
def test_a_call_that_is_stopped_before_the_steps_of_its_teachers_leaves_or_keeps_their_preview(
    posed, tmp_path, monkeypatch
):
    monkeypatch.setattr(teachers, "usual_steps", lambda _: 9)
    monkeypatch.setattr(teachers, "TEACHER_STEPS", 4)
    preview = tmp_path / "scene.work" / "preview.hyrf"

    def stop_after(detail: str) -> int:
        details: list[str] = []
        context = RunContext(progress=lambda event: details.extend(event.details[:1]), stop=lambda: detail in details)
        with pytest.raises(Stopped, match="stopped in training") as stopped:
            make_scene(posed, tmp_path / "scene.html", context=context)
        assert stopped.value.scene == preview
        return describe_file(preview)["provenance"]["steps"]

    assert stop_after("teacher run 2/3: training 1/4") == 4
    assert stop_after("step 2/9") == 4
    assert stop_after("step 6/9") == 6
    assert make_scene(posed, tmp_path / "scene.html").output.exists() and not preview.exists()


@pytest.mark.acceptance
def test_an_interrupted_command_resumes_from_its_checkpoint_to_the_same_products(
    finished_work, posed, tmp_path, monkeypatch, signals
):
    words: list[str] = []

    def show(display: LineDisplay, event: StageEvent) -> None:
        words.extend(event.details[:1])
        if words[-1:] == ["step 5/9"]:
            signal.raise_signal(signal.SIGTERM)

    monkeypatch.setattr(LineDisplay, "__call__", show)
    arguments = ("make", posed, "-o", tmp_path / "scene.html")
    stopped = hyrfpack(*arguments)
    work = tmp_path / "scene.work"
    preview = work / "preview.hyrf"
    sentence = f"stopped in training; the same command resumes; the scene so far: {preview}\n"
    assert stopped.exit_code == 1 and stopped.stderr.endswith(sentence)
    assert (work / "run" / "checkpoint.pt").is_file()
    facts = describe_file(preview)
    assert facts["profile"] == "compact" and facts["provenance"]["steps"] == 5
    assert sorted(path.name for path in work.iterdir()) == ["make.json", "preview.hyrf", "run"]

    words.clear()
    (sentence,) = succeeded(*arguments).stderr.splitlines()  # everything else is shown as progress
    assert sentence.startswith("training: 9 steps") and sentence.endswith("; on cpu")
    assert "step 6/9" in words and "step 5/9" not in words
    for name in PRODUCT_PATHS:
        assert (work / name).read_bytes() == (finished_work / name).read_bytes(), name
    assert (tmp_path / "scene.html").read_bytes() == (finished_work / "export" / "scene.html").read_bytes()


def test_the_score_is_that_of_the_packed_model_on_held_out_photos(finished_work, posed, tmp_path):
    work = shutil.copytree(finished_work, tmp_path / "work")
    result = make_scene(posed, tmp_path / "scene.hyrf", work=work)
    scores = evaluate_model(load_model(result.output), load_scene(posed).test)
    assert (result.psnr, result.ssim, result.views) == (scores.psnr, scores.ssim, 3)
    assert result.psnr_consistent is None  # the model has no exposure map


def test_a_model_with_an_exposure_map_is_scored_as_render_shows_it_and_at_one_exposure(finished_work, posed, tmp_path):
    model, provenance = load_with_provenance(finished_work / "model.hyrf")
    model.exposure = random_map(3, centers=6)
    save_model(model, tmp_path / "model.hyrf", provenance=provenance)
    state = SimpleNamespace(inputs=lambda stage: {"photos and poses": ""})
    reporter = Reporter(["scoring"], ignore_progress)
    stage = lambda name, inputs, act: act(False)[0]  # noqa: E731
    work = SimpleNamespace(folder=tmp_path, state=state, reporter=reporter, run_stage=stage)
    scene = load_scene(posed)

    scores = stages.run_scoring_stage(work, scene, torch.device("cpu"))

    expected = evaluate_model(model, scene.test)
    assert scores == {
        "views": 3, "psnr": expected.psnr, "psnr_consistent": expected.psnr_consistent, "ssim": expected.ssim
    }  # fmt: skip
    assert (
        expected.psnr
        != expected.psnr_consistent
        == evaluate_model(load_model(finished_work / "model.hyrf"), scene.test).psnr
    )


@pytest.mark.acceptance
def test_an_unreachable_target_size_names_a_reachable_one_which_is_met(finished_work, posed, tmp_path):
    work = shutil.copytree(finished_work, tmp_path / "work")
    arguments = ("make", posed, "-o", tmp_path / "scene.hyrf", "--work", work)
    sentence = refused(*arguments, "--target-size", 2_100)
    assert "the trained model does not fit into 2,100 bytes" in sentence and "--max-gaussians" not in sentence
    assert "another work folder (--work)" in sentence
    (possible,) = re.findall(r"ask for ([\d,]+) bytes or more", sentence)
    smallest = int(possible.replace(",", ""))
    succeeded(*arguments, "--target-size", smallest)
    assert (tmp_path / "scene.hyrf").stat().st_size <= smallest < (finished_work / "model.hyrf").stat().st_size


@pytest.mark.usefixtures("quick_import")
def test_splats_of_other_programs_are_imported(tmp_path):
    (tmp_path / "ball.ply").write_bytes(ply.encode(ball_splats(40)))
    result = make_scene(tmp_path / "ball.ply", tmp_path / "scene.html", MakeConfig(quality="draft"))
    assert list(result.seconds) == ["import", "export"] and result.export["import"]["gaussians_before"] == 40
    again = make_scene(tmp_path / "ball.ply", tmp_path / "scene.spz", MakeConfig(quality="draft"))
    assert again.kept == ("import",)


@pytest.mark.usefixtures("quick_import")
def test_the_command_warns_of_clamped_colours(tmp_path):
    splats = ball_splats(40)
    splats.harmonics[0, 0, 0] = 1e20
    (tmp_path / "ball.ply").write_bytes(ply.encode(splats))
    result = succeeded("make", tmp_path / "ball.ply", "-o", tmp_path / "scene.hyrf", "--quality", "draft")
    assert "harmonics of 1 of 40 Gaussians are beyond 100,000" in result.stderr
