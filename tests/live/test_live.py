"""The live page of a training run: its content, its cost, and that it does not change the model."""

from __future__ import annotations

import dataclasses
import json
import socket
import urllib.error
import urllib.request
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from commands import hyrfpack, refused, succeeded
from explicit_balls import ball_splats
from scenes import QUIET_CONTEXT, ball_scene

from hyrfpack.format import decode_model, describe_file
from hyrfpack.live import LiveView, live_view
from hyrfpack.live.view import MIN_INTERVAL_RATIO, MIN_INTERVAL_SECONDS
from hyrfpack.splats.formats import ply
from hyrfpack.train import DensityConfig, TrainConfig, Trainer, train_model

TRAIN_CONFIG = TrainConfig(
    steps=40,
    seed=1,
    max_gaussians=120,
    background_color="random",
    density=DensityConfig(start=0.05, stop=0.7, rounds=8, gradient=1e-5, resets=1),
)


def make_scene():
    scene = ball_scene(views=8, points=60, side=24)
    return dataclasses.replace(scene, train=scene.train[2:], test=scene.train[:2])


def read_content(file) -> bytes:
    with file.open()[0] as opened:
        return opened.read()


def read_progress(view: LiveView) -> dict:
    return json.loads(read_content(view.updates))


class Clock:
    """A clock that tests advance; each reading advances it by `look` seconds."""

    def __init__(self, look: float = 0.0) -> None:
        self.now, self.look = 1000.0, look

    def __call__(self) -> float:
        self.now += self.look
        return self.now


@pytest.mark.parametrize(("exposure", "background"), [(False, True), (True, False)])
def test_training_with_a_live_view_gives_the_same_model_bit_by_bit(exposure, background, tmp_path):
    config = dataclasses.replace(TRAIN_CONFIG, steps=20, exposure=exposure, background=background)
    plain = train_model(make_scene(), tmp_path / "plain", config, context=QUIET_CONTEXT)
    clock = Clock(look=MIN_INTERVAL_SECONDS * MIN_INTERVAL_RATIO)
    view = LiveView(clock)

    def observe(trainer: Trainer) -> None:
        clock.now += 1e9  # makes a snapshot due after each step
        view.observe(trainer)

    viewed = train_model(make_scene(), tmp_path / "viewed", config, context=QUIET_CONTEXT, observer=observe)
    assert read_progress(view)["snapshot"] == config.steps
    assert plain.model.read_bytes() == viewed.model.read_bytes()
    curves = [[{**record, "seconds": 0} for record in run.metrics["curve"]] for run in (plain, viewed)]
    assert curves[0] == curves[1]


def test_pilot_runs_are_shown_before_the_first_step_of_the_training(monkeypatch, tmp_path):
    monkeypatch.setattr("hyrfpack.train.decisions.MIN_BUDGET_STEPS", 4)
    monkeypatch.setattr("hyrfpack.train.budget_pilots.BUDGET_PILOT_STEPS", 1)
    clock, shown = Clock(), []
    view = LiveView(clock)

    def observe(trainer: Trainer) -> None:
        clock.now += 1e9  # makes a snapshot due after each step
        view.observe(trainer)
        shown.append(read_progress(view))

    config = TrainConfig(steps=4, exposure=False)
    scene = ball_scene(views=12, points=60, side=24)
    train_model(scene, tmp_path / "run", config, context=QUIET_CONTEXT, observer=observe)
    assert [progress["kind"] for progress in shown] == ["pilot run"] * (len(shown) - 4) + [""] * 4 and len(shown) > 4
    assert [(progress["step"], progress["steps"]) for progress in shown[-4:]] == [(step, 4) for step in range(1, 5)]


def test_a_snapshot_holds_the_model_of_its_step_and_the_cameras_of_the_photos():
    trainer, view = Trainer(make_scene(), TRAIN_CONFIG), LiveView(Clock())
    for wanted in (1, 40):
        trainer.run(progress=lambda _: view.observe(trainer), stop=lambda wanted=wanted: trainer.step == wanted)
        assert read_progress(view) == {"snapshot": 1 if wanted == 1 else 2, "step": wanted, "steps": 40, "kind": ""}
        shown = dict(decode_model(read_content(view.scene)).named_parameters())
        assert shown.keys() == dict(trainer.model.named_parameters()).keys()
        for name, parameter in trainer.model.named_parameters():
            np.testing.assert_array_equal(shown[name].detach(), parameter.detach(), err_msg=name)


def test_a_snapshot_keeps_the_cameras_for_the_page_to_start_from(tmp_path):
    trainer, view = Trainer(make_scene(), dataclasses.replace(TRAIN_CONFIG, steps=1)), LiveView()
    trainer.run(progress=lambda _: view.observe(trainer))
    file = tmp_path / "snapshot.hyrf"
    file.write_bytes(read_content(view.scene))
    kept = describe_file(file)["provenance"]
    assert len(kept["cameras"]) == 6 and kept["viewpoint"] and kept["steps"] == 1


def fake_trainer(step: int, steps: int = 10_000, kind: str = "") -> SimpleNamespace:
    return SimpleNamespace(step=step, steps=steps, kind=kind, model=None, scene=None)


@pytest.mark.parametrize(
    ("seconds", "interval"),
    [(0.01, MIN_INTERVAL_SECONDS), (2.0, 80.0), (30.0, 1200.0)],
    ids=["a small model", "a large one", "a very large one"],
)
def test_snapshots_take_less_than_3_percent_of_the_time_however_large_the_model_is(seconds, interval, monkeypatch):
    clock, taken = Clock(), []

    def encode(*_) -> bytes:
        taken.append(clock.now)
        clock.now += seconds
        return b"snapshot"

    monkeypatch.setattr("hyrfpack.live.view.encode_model", encode)
    monkeypatch.setattr("hyrfpack.live.view.training_provenance", lambda *_, **__: {})
    view, began = LiveView(clock), clock.now
    for step in range(1, 10_000):
        clock.now += 0.5
        view.observe(fake_trainer(step))
    assert np.diff(taken).min() >= interval and len(taken) > 2
    assert (len(taken) - 1) * seconds <= 0.03 * (clock.now - began)


@pytest.mark.parametrize(
    ("kind", "expected"),
    [
        ("", [1, 1, 1, 1, 5]),
        ("first look", [1, 1, 1, 1, 5]),
        ("pilot run", [1, 1, 1, 1, 1]),
        ("teacher run", [1, 1, 1, 1, 1]),
    ],
)
def test_the_first_step_and_the_last_one_of_all_but_pilot_and_teacher_runs_are_always_shown(
    kind, expected, monkeypatch
):
    monkeypatch.setattr("hyrfpack.live.view.encode_model", lambda *_: b"snapshot")
    monkeypatch.setattr("hyrfpack.live.view.training_provenance", lambda *_, **__: {})
    view, shown = LiveView(Clock()), []
    for step in range(1, 6):
        view.observe(fake_trainer(step, steps=5, kind=kind))
        shown.append(read_progress(view)["step"])
    assert shown == expected and read_progress(view)["kind"] == kind


def test_a_model_that_is_not_finite_keeps_the_previous_snapshot():
    trainer, view = Trainer(make_scene(), TRAIN_CONFIG), LiveView(lambda: 0.0)
    trainer.run(progress=lambda _: view.observe(trainer), stop=lambda: trainer.step == 1)
    before = read_content(view.scene)
    with torch.no_grad():
        trainer.model.gaussians.positions[0] = float("nan")
    trainer.step = trainer.steps
    view.observe(trainer)
    assert read_content(view.scene) == before and read_progress(view)["step"] == 1


def test_the_page_and_its_files_are_served_while_the_block_runs_and_not_after(caplog):
    with live_view("a <scene>") as view:
        (address,) = [word for word in caplog.messages[0].split() if word.startswith("http://127.0.0.1:")]

        def fetched(name: str) -> bytes:
            with urllib.request.urlopen(address + name, timeout=20) as answer:
                return answer.read()

        assert b"<title>a &lt;scene&gt;</title>" in fetched("")
        assert json.loads(fetched("training.json")) == {"snapshot": 0, "step": 0, "steps": 0, "kind": ""}
        trainer = Trainer(make_scene(), dataclasses.replace(TRAIN_CONFIG, steps=2))
        trainer.run(progress=lambda _: view.observe(trainer))
        assert json.loads(fetched("training.json")) == {"snapshot": 2, "step": 2, "steps": 2, "kind": ""}
        assert len(decode_model(fetched("scene.hyrf"))) == len(trainer.model)
    with pytest.raises(urllib.error.URLError):
        fetched("")


# -- commands --------------------------------------------------------------------------------------------------------


@pytest.fixture
def observed_steps(monkeypatch) -> list[int]:
    """The steps after which a live view was updated."""
    steps: list[int] = []
    monkeypatch.setattr(LiveView, "observe", lambda self, trainer: steps.append(trainer.step))
    return steps


def test_train_updates_the_live_view_with_the_option(data, observed_steps, tmp_path):
    command = ("train", data, "-o", tmp_path / "run", "--steps", 3, "--max-gaussians", 100)
    result = succeeded(*command, "--view")
    assert observed_steps == [1, 2, 3]
    assert "watch the training at http://127.0.0.1:" in result.stderr and "http" not in result.stdout
    assert f"'hyrfpack view {tmp_path / 'run' / 'model.hyrf'}'" in result.stderr
    observed_steps.clear()
    result = succeeded(*command, "--overwrite")
    assert observed_steps == [] and "http" not in result.stderr


@pytest.mark.acceptance
def test_make_updates_the_live_view_with_the_option(data, observed_steps, monkeypatch, tmp_path):
    from hyrfpack.make import plan

    quality = dataclasses.replace(plan.QUALITIES["draft"], steps=3, finetune_steps=0)
    monkeypatch.setitem(plan.QUALITIES, "draft", quality)
    result = succeeded("make", data, "-o", tmp_path / "scene.hyrf", "--quality", "draft", "--view")
    assert observed_steps == [1, 2, 3] and "watch the training at http://127.0.0.1:" in result.stderr


def test_make_announces_no_view_before_it_refuses_its_arguments(tmp_path):
    (tmp_path / "ball.ply").write_bytes(ply.encode(ball_splats(9)))
    result = hyrfpack("make", tmp_path / "ball.ply", "-o", tmp_path / "scene.html", "--view")
    assert result.exit_code == 2
    assert "leave out --view" in result.stderr and "http" not in result.stderr


def test_a_port_that_is_taken_is_a_clear_error_before_any_work(data, tmp_path):
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        sentence = refused("train", data, "-o", tmp_path / "run", "--view", "--view-port", port)
    assert f"port {port} of 127.0.0.1 is taken by another program" in sentence
    assert not (tmp_path / "run").exists()


def test_a_port_without_a_view_is_rejected(data, tmp_path):
    for command in (("train", tmp_path, "-o", tmp_path / "run"), ("make", data, "-o", tmp_path / "scene.hyrf")):
        assert "give both of them" in refused(*command, "--view-port", 8000)
