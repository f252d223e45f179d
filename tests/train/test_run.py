"""A training run in a folder: its files, how it stops, and how it resumes after a kill at any moment."""

from __future__ import annotations

import dataclasses
import errno
import json
import os
import random
import signal
import subprocess
import sys
import time
import weakref
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from scenes import QUIET_CONTEXT, ball_scene

from hyrfpack import format as hyrf_format
from hyrfpack.context import RunContext
from hyrfpack.errors import HyrfError
from hyrfpack.evaluate.figures import draw_training_curve
from hyrfpack.progress import StepEvent
from hyrfpack.render import render_view
from hyrfpack.scene import Scene
from hyrfpack.train import DensityConfig, TrainConfig, Trainer, advice, train_model
from hyrfpack.train.stop import STOP_SIGNALS, catch_stop_signals

RUN_CONFIG = TrainConfig(
    steps=60,
    seed=1,
    max_gaussians=120,
    checkpoint_every=1,
    density=DensityConfig(start=0.05, stop=0.7, rounds=8, gradient=1e-5, resets=1),
)
QUICK_CONFIG = dataclasses.replace(RUN_CONFIG, steps=24)
# The run of RUN_CONFIG in another process. "train" takes at least 0.05 s a step, so that the test can stop it early;
# "loop" prints the number of each step.
CHILD_SCRIPT = """
import json, sys, time
from pathlib import Path
sys.path.append(sys.argv[1])
from scenes import QUIET_CONTEXT, ball_scene
from hyrfpack.train import Trainer, train_model
from test_run import QUIET_CONTEXT, RUN_CONFIG, make_scene
out = Path(sys.argv[2])
if sys.argv[3] == "train":
    resume = (out / "checkpoint.pt").exists()
    slow = lambda trainer: time.sleep(0.05)
    result = train_model(make_scene(), out, RUN_CONFIG, resume=resume, context=QUIET_CONTEXT, observer=slow)
    print(json.dumps({"complete": result.complete, "step": result.step, "model": result.model}))
else:
    trainer = Trainer(make_scene(), RUN_CONFIG)
    if (out / "checkpoint.pt").exists():
        trainer.load(out / "checkpoint.pt")
    trainer.run(checkpoint=out / "checkpoint.pt", progress=lambda event: print(event.step, flush=True))
"""


def make_scene(views: int = 6) -> Scene:
    return ball_scene(views=views, points=60, side=24)


def split_scene() -> Scene:
    scene = make_scene(8)
    return dataclasses.replace(scene, train=scene.train[2:], test=scene.train[:2])


def parameter_bytes(model) -> dict[str, bytes]:
    return {name: p.detach().numpy().tobytes() for name, p in model.named_parameters()}


def start_child(out: Path, how: str) -> subprocess.Popen:
    here = Path(__file__).parent
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(here), str(here.parents[1])])}
    command = [sys.executable, "-c", CHILD_SCRIPT, str(here.parent), str(out), how]
    return subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


@pytest.fixture(scope="module")
def uninterrupted_trainer() -> Trainer:
    """The trainer of the uninterrupted run."""
    trainer = Trainer(make_scene(), RUN_CONFIG)
    trainer.run()
    return trainer


# -- a finished run --------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    out = tmp_path_factory.mktemp("runs") / "deep" / "balls"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("hyrfpack.train.results.draw_training_curve", draw_training_curve)  # in place of a pixel
        return out, train_model(split_scene(), out, QUICK_CONFIG, context=QUIET_CONTEXT)


def test_a_run_leaves_model_metrics_curve_and_views(finished):
    out, result = finished
    assert result.complete and result.step == 24 and result.model == out / "model.hyrf"
    assert {"model.hyrf", "metrics.json", "curve.png", "views"} == {entry.name for entry in out.iterdir()}
    assert list((out / "views").rglob("*.png"))
    with Image.open(out / "curve.png") as curve:
        assert min(curve.size) > 100 and len(curve.convert("RGB").getcolors(1 << 20)) > 10


@pytest.mark.acceptance
def test_the_saved_model_is_the_trained_one(finished):
    """The bytes equal those of a trainer that has no held-out views."""
    _, result = finished
    trainer = Trainer(split_scene(), QUICK_CONFIG)
    trainer.run()
    loaded = hyrf_format.load_model(result.model)
    assert parameter_bytes(loaded) == parameter_bytes(trainer.model)


def test_metrics_are_the_results_and_the_settings(finished):
    out, result = finished
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics == json.loads(json.dumps(result.metrics))
    assert metrics["bytes"] == result.model.stat().st_size
    assert metrics["settings"]["steps"] == 24 and metrics["scene"]["train"] == 6 and metrics["scene"]["test"] == 2
    assert metrics["gaussians"] == len(hyrf_format.load_model(result.model)) <= 120
    assert [record["step"] for record in metrics["curve"]] == list(range(1, 25))


def test_the_evaluation_is_of_the_file_on_the_held_out_views(finished):
    out, result = finished
    model = hyrf_format.load_model(result.model)
    expected = {}
    for view in split_scene().test:
        with torch.no_grad():
            rgb = render_view(model, view.camera).rgb.double().numpy().clip(0, 1)
        expected[view.name] = -10 * np.log10(np.mean((rgb - view.load().composite()) ** 2))
    found = {view["name"]: view["psnr"] for view in result.metrics["evaluation"]["views"]}
    assert found == pytest.approx(expected, abs=0.05)  # renders may be rounded to 8 bits
    assert result.metrics["evaluation"]["psnr"] == pytest.approx(np.mean(list(found.values())))


def test_a_folder_with_a_run_is_rejected_without_overwrite(finished):
    out, _ = finished
    before = (out / "model.hyrf").read_bytes()
    with pytest.raises(HyrfError, match="holds an earlier run.*`overwrite=True`"):
        train_model(split_scene(), out, QUICK_CONFIG, context=QUIET_CONTEXT)
    assert (out / "model.hyrf").read_bytes() == before


def test_overwriting_replaces_the_run(tmp_path):
    config = dataclasses.replace(QUICK_CONFIG, steps=3)
    train_model(make_scene(), tmp_path, config, context=QUIET_CONTEXT)
    train_model(make_scene(), tmp_path, dataclasses.replace(config, seed=9), overwrite=True, context=QUIET_CONTEXT)
    assert json.loads((tmp_path / "metrics.json").read_text())["settings"]["seed"] == 9


def test_an_overwriting_run_that_ends_before_its_first_checkpoint_does_not_leave_that_of_the_earlier_run(
    tmp_path, monkeypatch
):
    context = RunContext(progress=QUIET_CONTEXT.progress, stop=lambda: True)
    train_model(make_scene(), tmp_path, QUICK_CONFIG, context=context)
    assert (tmp_path / "checkpoint.pt").is_file()

    def fail(*arguments: object, **options: object) -> Trainer:
        raise HyrfError("the photos are gone", fix="look for them")

    monkeypatch.setattr("hyrfpack.train.run.Trainer", fail)
    with pytest.raises(HyrfError, match="the photos are gone"):
        train_model(make_scene(), tmp_path, QUICK_CONFIG, overwrite=True, context=QUIET_CONTEXT)
    with pytest.raises(HyrfError, match="there is no checkpoint to resume"):
        train_model(make_scene(), tmp_path, QUICK_CONFIG, resume=True, context=QUIET_CONTEXT)


@pytest.mark.parametrize("name", ["training.json", "blocks/blocks.json", "checkpoint.pt"])
def test_a_file_of_an_earlier_run_that_cannot_be_removed_is_a_clear_error(tmp_path, monkeypatch, name):
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).write_text("")
    remove = Path.unlink

    def unlink(path: Path, missing_ok: bool = False) -> None:
        if path == tmp_path / name:
            raise PermissionError(errno.EACCES, "Permission denied")
        remove(path, missing_ok)

    monkeypatch.setattr(Path, "unlink", unlink)
    with pytest.raises(HyrfError, match=rf"{name}: .*earlier run cannot be removed \(Permission denied\); remove it"):
        train_model(make_scene(), tmp_path, QUICK_CONFIG, overwrite=True, context=QUIET_CONTEXT)


def test_a_file_at_the_name_of_the_folder_of_blocks_does_not_stop_an_overwriting_run(tmp_path):
    (tmp_path / "blocks").write_text("notes")
    config = dataclasses.replace(QUICK_CONFIG, steps=1)
    assert train_model(make_scene(), tmp_path, config, overwrite=True, context=QUIET_CONTEXT).complete
    assert (tmp_path / "blocks").read_text() == "notes"


def test_a_folder_that_cannot_be_made_is_a_clear_error(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(HyrfError, match="file is a file, not a folder"):
        train_model(make_scene(), tmp_path / "file" / "run", QUICK_CONFIG, context=QUIET_CONTEXT)


def test_resuming_without_a_checkpoint_is_a_clear_error(tmp_path):
    with pytest.raises(HyrfError, match="no checkpoint to resume; leave out `resume=True`"):
        train_model(make_scene(), tmp_path / "run", QUICK_CONFIG, resume=True, context=QUIET_CONTEXT)
    assert not (tmp_path / "run").exists()


def test_resuming_a_finished_run_says_that_its_model_is_there(tmp_path):
    (tmp_path / "model.hyrf").write_bytes(b"finished")
    with pytest.raises(HyrfError, match=r"only a finished model \(model.hyrf\); use this model"):
        train_model(make_scene(), tmp_path, QUICK_CONFIG, resume=True, context=QUIET_CONTEXT)
    assert (tmp_path / "model.hyrf").read_bytes() == b"finished"


def test_the_trainer_is_freed_before_the_curve_is_drawn(tmp_path, monkeypatch):
    """matplotlib keeps the frames of its callers in reference cycles, with all that they still hold."""
    trainers: set[weakref.ref] = set()
    freed: list[bool] = []

    def draw(records, path: Path, *, overwrite: bool = True) -> Path:
        freed.extend(trainer() is None for trainer in trainers)
        return path

    monkeypatch.setattr("hyrfpack.train.results.draw_training_curve", draw)
    config = dataclasses.replace(QUICK_CONFIG, steps=2)
    train_model(
        make_scene(),
        tmp_path,
        config,
        context=QUIET_CONTEXT,
        observer=lambda trainer: trainers.add(weakref.ref(trainer)),
    )
    assert freed == [True]


@pytest.mark.parametrize("opacity", [0.9, 0.98, 0.9999])
def test_a_background_that_no_view_sees_is_dropped(tmp_path, opacity):
    """A wall of large Gaussians surrounds everything. Balls under a sky keep their background sphere."""
    wall = np.random.default_rng(0).normal(size=(500, 3))
    wall *= 4 / np.linalg.norm(wall, axis=1, keepdims=True)
    scene = dataclasses.replace(make_scene(), points=wall, point_colors=np.full((500, 3), 0.5, np.float32))
    one_step = dataclasses.replace(QUICK_CONFIG, steps=1, max_gaussians=500)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("hyrfpack.train.setup.INITIAL_OPACITY", opacity)
        patch.setattr("hyrfpack.train.setup.MIN_INITIAL_SIZE", 0.45)
        closed = train_model(scene, tmp_path / "closed", one_step, context=QUIET_CONTEXT)
    open_air = train_model(make_scene(), tmp_path / "open", one_step, context=QUIET_CONTEXT)

    assert hyrf_format.load_model(closed.model).config.background is False
    assert closed.metrics["choices"]["background"].startswith("none: no training view")
    assert hyrf_format.load_model(open_air.model).config.background is True
    assert "of a view's light" in open_air.metrics["choices"]["background"]


def test_the_speed_of_a_resumed_run_covers_all_its_parts(finished, tmp_path):
    _, result = finished
    assert 0 < sum(result.metrics["stage_seconds"].values()) <= 1.02 * result.metrics["seconds"] + 0.02
    assert result.metrics["steps_per_second"] == pytest.approx(24 / result.metrics["seconds"])

    stopped = Trainer(make_scene(), QUICK_CONFIG)
    stopped.run(stop=lambda: stopped.step == 20)
    stopped.elapsed = 1e6
    stopped.save(tmp_path / "checkpoint.pt")
    metrics = train_model(make_scene(), tmp_path, QUICK_CONFIG, resume=True, context=QUIET_CONTEXT).metrics

    assert 1e6 < metrics["seconds"] < 1e6 + 600
    assert metrics["steps_per_second"] == pytest.approx(24 / metrics["seconds"])


def test_a_long_run_logs_once_how_to_shorten_it(tmp_path, caplog, monkeypatch):
    for name in ("MIN_ADVICE_STEPS", "MIN_ADVICE_SECONDS", "MIN_ADVICE_SECONDS_LEFT"):
        monkeypatch.setattr(advice, name, 0)
    train_model(make_scene(), tmp_path, dataclasses.replace(QUICK_CONFIG, steps=8))
    (message,) = [message for message in caplog.messages if "hours remain" in message]
    assert all(way in message for way in ("fewer steps", "smaller photos", "fewer Gaussians", "a GPU"))


def test_a_silent_run_logs_no_advice(tmp_path, caplog, monkeypatch):
    for name in ("MIN_ADVICE_STEPS", "MIN_ADVICE_SECONDS", "MIN_ADVICE_SECONDS_LEFT"):
        monkeypatch.setattr(advice, name, 0)
    train_model(make_scene(), tmp_path, dataclasses.replace(QUICK_CONFIG, steps=8), context=QUIET_CONTEXT)
    assert not [message for message in caplog.messages if "hours remain" in message]


# -- stopping and resuming -------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("signals")
def test_the_first_interrupt_requests_a_stop_and_the_second_interrupts():
    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt), catch_stop_signals() as stop:
        assert not stop()
        signal.raise_signal(signal.SIGINT)
        assert stop()
        signal.raise_signal(signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is before


@pytest.mark.usefixtures("signals")
@pytest.mark.parametrize("is_within", [True, False])
def test_a_signal_in_an_inner_block_is_a_request_in_the_outer_one_and_the_second_interrupts(is_within):
    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt), catch_stop_signals() as outer:
        with catch_stop_signals() as inner:
            assert not inner() and not outer()
            signal.raise_signal(signal.SIGINT)
            assert inner() and outer()
            if is_within:
                signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is before


@pytest.mark.usefixtures("signals")
@pytest.mark.parametrize("name", ["SIGTERM", "SIGHUP"])
def test_sigterm_and_sighup_request_a_stop_too(name):
    number = getattr(signal, name, None) or pytest.skip(f"there is no {name} here")
    before = signal.getsignal(number)
    with catch_stop_signals() as stop:
        signal.raise_signal(number)
        assert stop()
    assert signal.getsignal(number) is before


@pytest.mark.usefixtures("signals")
@pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="there is no SIGHUP here")
def test_a_second_sighup_has_no_effect():
    with catch_stop_signals() as stop:
        signal.raise_signal(signal.SIGHUP)
        signal.raise_signal(signal.SIGHUP)
        assert stop()


@pytest.mark.usefixtures("signals")
@pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="there is no SIGHUP here")
def test_a_signal_at_any_line_of_the_handler_of_another_does_not_block():
    def fail(*_: object) -> None:
        raise TimeoutError("a handler waits for the one that it interrupted")

    def raise_another(*_: object) -> Callable:
        signal.raise_signal(signal.SIGHUP)
        return raise_another

    before, traced = signal.signal(signal.SIGALRM, fail), sys.gettrace()
    signal.alarm(10)
    try:
        with catch_stop_signals() as stop:
            sys.settrace(raise_another)
            signal.raise_signal(signal.SIGHUP)
            sys.settrace(traced)
            assert stop()
    finally:
        sys.settrace(traced)
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def test_a_stop_asked_by_the_context_saves_a_checkpoint_after_the_step(tmp_path):
    uninterrupted = Trainer(make_scene(), QUICK_CONFIG)
    uninterrupted.run()
    steps: list[int] = []
    context = RunContext(
        progress=lambda event: steps.extend([event.step] if isinstance(event, StepEvent) else []),
        stop=lambda: len(steps) >= 8,
    )
    stopped = train_model(make_scene(), tmp_path, QUICK_CONFIG, context=context)
    assert (stopped.complete, stopped.step) == (False, 8) and (tmp_path / "checkpoint.pt").is_file()
    resumed = train_model(make_scene(), tmp_path, QUICK_CONFIG, resume=True, context=QUIET_CONTEXT)
    loaded = hyrf_format.load_model(resumed.model)
    assert parameter_bytes(loaded) == parameter_bytes(uninterrupted.model)


@pytest.mark.usefixtures("signals")
@pytest.mark.parametrize("number", STOP_SIGNALS)
def test_a_signal_that_is_ignored_stays_ignored(number):
    """SIGHUP is ignored under nohup, Ctrl-C in background jobs of a script."""
    signal.signal(number, signal.SIG_IGN)
    with catch_stop_signals() as stop:
        signal.raise_signal(number)
        assert not stop()
    assert signal.getsignal(number) is signal.SIG_IGN


@pytest.mark.acceptance
@pytest.mark.usefixtures("signals")
@pytest.mark.parametrize("number", STOP_SIGNALS)
def test_an_interrupt_saves_exits_cleanly_and_resumes_to_the_same_model(number, uninterrupted_trainer, tmp_path):
    child = start_child(tmp_path, "train")
    checkpoint = tmp_path / "checkpoint.pt"
    while child.poll() is None and not checkpoint.exists():
        time.sleep(0.002)
    child.send_signal(number)
    out, errors = child.communicate(timeout=120)

    assert child.returncode == 0, errors
    said = json.loads(out)
    assert said["complete"] is False and said["model"] is None and 1 <= said["step"] < 60
    assert not (tmp_path / "model.hyrf").exists()
    result = train_model(make_scene(), tmp_path, RUN_CONFIG, resume=True, context=QUIET_CONTEXT)
    assert result.complete and parameter_bytes(hyrf_format.load_model(result.model)) == parameter_bytes(
        uninterrupted_trainer.model
    )
    assert not checkpoint.exists()


@pytest.mark.acceptance
def test_kills_at_random_moments_leave_a_checkpoint_that_resumes_to_the_same_model(uninterrupted_trainer, tmp_path):
    """SIGKILL often arrives while a checkpoint is being written, because every step writes one."""
    generator = random.Random(time.time_ns())
    checkpoint = tmp_path / "checkpoint.pt"
    for target in (1, generator.randrange(10, 30), generator.randrange(35, 50)):
        child = start_child(tmp_path, "loop")
        for line in child.stdout:
            if int(line) >= target:
                break
        time.sleep(generator.random() * 0.03)
        child.kill()
        _, errors = child.communicate(timeout=60)
        assert child.returncode == -signal.SIGKILL, errors
        if target > 1:
            assert checkpoint.exists()

    resumed = Trainer(make_scene(), RUN_CONFIG)
    resumed.load(checkpoint)
    assert 10 <= resumed.step < 60
    resumed.run()

    assert parameter_bytes(resumed.model) == parameter_bytes(uninterrupted_trainer.model)
    curves = [[(r["step"], r["loss"], r["gaussians"]) for r in run.records] for run in (resumed, uninterrupted_trainer)]
    assert curves[0] == curves[1]
