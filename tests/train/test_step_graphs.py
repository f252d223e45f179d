"""Steps replayed as graphs: the same results as steps launched as usual, whatever differs between them.

A replay on the fake GPU repeats what was launched, with all that the host knew when it was captured. So a number that
reaches a launch in another way than through the inputs of the step is that of an earlier step, and changes the result.
"""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Callable, Iterator

import numpy as np
import pytest
import torch
from fake_gpu import FakeGraphCapturer, use_fake_gpu
from ops.device import IS_INTERPRETED, needs_triton
from scenes import ball_scene
from torch import Tensor

from hyrfpack.errors import HyrfError
from hyrfpack.model import HashGridConfig
from hyrfpack.render import RenderSettings
from hyrfpack.render.reserve import Reserve
from hyrfpack.scene import Picture, Scene
from hyrfpack.train import DensityConfig, TrainConfig, Trainer, step_graphs
from hyrfpack.train.gradients import StepInputs, StepShape, ViewGradients

pytestmark = [
    needs_triton,
    pytest.mark.skipif(not IS_INTERPRETED, reason="a GPU adds to hash tables in any order, so that bits differ"),
]

SHORT_RUN_CONFIG = TrainConfig(
    steps=7,
    max_gaussians=10,
    density=DensityConfig(start=1.0, stop=1.0, rounds=1),
    precision="float32",
    log2_table_size=5,
    exposure=False,
)
WITH_ROUNDS = DensityConfig(start=0.4, stop=1.0, rounds=1, gradient=1e-6, resets=0)


@pytest.fixture(autouse=True)
def quick_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make models of 1 level, and sum no runs of points in its gradient, because the interpreter is slow."""
    monkeypatch.setattr("hyrfpack.ops.hash_encode.gpu._POINTS_PER_THREAD", 1)
    monkeypatch.setattr(
        "hyrfpack.train.setup.HashGridConfig",
        lambda log2_table_size, **sizes: HashGridConfig(log2_table_size, levels=1, **sizes),
    )


@pytest.fixture
def gpu() -> Iterator[torch.device]:
    with use_fake_gpu() as device:
        yield device


@pytest.fixture
def replays(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Count the steps that are captured and replayed; the list has the number of each replay's graph."""
    counted: list[int] = []
    capture = FakeGraphCapturer.capture

    def count(self: FakeGraphCapturer, launch: Callable[[], ViewGradients]) -> tuple:
        found, replay = capture(self, launch)
        number = len(set(counted))
        return found, lambda: (counted.append(number), replay())

    monkeypatch.setattr(FakeGraphCapturer, "capture", count)
    return counted


def scene_of(change: str) -> Scene:
    scene = ball_scene(views=2, points=10, side=8)
    views = list(scene.train)
    if "masks" in change:
        views = [dataclasses.replace(view, load=_masked(view.load(), seed)) for seed, view in enumerate(views)]
    if change == "photos of two sizes":
        views += ball_scene(views=2, points=10, side=10).train
        views = [dataclasses.replace(view, name=f"{number}.png") for number, view in enumerate(views)]
    return dataclasses.replace(scene, train=views, test=views[:1])


def _masked(picture: Picture, seed: int) -> Callable[[], Picture]:
    mask = np.random.default_rng(seed).random(picture.rgb.shape[:2]) < 0.7
    return lambda: Picture(picture.rgb, picture.alpha, mask)


def config_of(change: str) -> TrainConfig:
    changes = {
        "exposure compensation": {"exposure": True},
        "masks, exposure compensation and a round of density control": {
            "exposure": True,
            "density": WITH_ROUNDS,
            "max_gaussians": 15,
            "steps": 5,
        },
        "random background colours": {"background": False, "background_color": "random"},
        "rounds of density control": {"density": WITH_ROUNDS, "max_gaussians": 15},
        "antialiasing": {"antialiased": True},
    }
    return dataclasses.replace(SHORT_RUN_CONFIG, **changes.get(change, {}))


def final_state(scene: Scene, config: TrainConfig, device: torch.device, *, graphs: bool) -> dict[str, Tensor]:
    """Return the state after a run, and what was reported of its steps."""
    trainer, reports = Trainer(scene, config, device=device), []
    if not graphs:
        trainer.renderer.replays_steps = False
    trainer.run(progress=lambda event: reports.append((event.loss, event.mse, event.gaussians)))
    observed = {f"density.{name}": value.cpu() for name, value in trainer.strategy.state_dict().items()}
    return trainer._collect_tensors() | observed | {"reports": torch.tensor(reports)}


@pytest.mark.acceptance
@pytest.mark.parametrize(
    "change",
    [
        "masks, exposure compensation and a round of density control",
        "nothing",
        "masks",
        "photos of two sizes",
        "exposure compensation",
        "random background colours",
        "rounds of density control",
        "antialiasing",
    ],
)
def test_replayed_steps_have_the_bits_of_launched_ones(gpu: torch.device, replays: list[int], change: str) -> None:
    scene, config = scene_of(change), config_of(change)
    found = final_state(scene, config, gpu, graphs=True)
    assert len(replays) >= 3
    replays.clear()
    expected = final_state(scene, config, gpu, graphs=False)
    assert not replays and found.keys() == expected.keys()
    assert [name for name, value in found.items() if not torch.equal(value, expected[name])] == []


@pytest.mark.acceptance
def test_rounds_of_density_control_end_graphs(gpu: torch.device, replays: list[int]) -> None:
    config = dataclasses.replace(config_of("rounds of density control"), steps=14)
    final_state(scene_of("nothing"), config, gpu, graphs=True)
    assert len(set(replays)) >= 2


@pytest.mark.acceptance
def test_a_graph_with_other_gradients_is_not_used(
    gpu: torch.device, replays: list[int], monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    capture = FakeGraphCapturer.capture

    def capture_wrongly(self: FakeGraphCapturer, launch: Callable[[], ViewGradients]) -> tuple:
        found, replay = capture(self, launch)

        def replay_wrongly() -> None:
            replay()
            next(gradient for gradient in found.gradients if gradient is not None).mul_(1.01)

        return found, replay_wrongly

    scene, config = scene_of("nothing"), dataclasses.replace(SHORT_RUN_CONFIG, steps=4)
    expected = final_state(scene, config, gpu, graphs=False)
    monkeypatch.setattr(FakeGraphCapturer, "capture", capture_wrongly)
    with caplog.at_level(logging.WARNING):
        found = final_state(scene, config, gpu, graphs=True)
    assert len(replays) == 1
    assert [record.message for record in caplog.records if "has other gradients than without one" in record.message]
    assert all(torch.equal(value, expected[name]) for name, value in found.items())


@pytest.mark.acceptance
def test_a_gpu_without_much_free_memory_captures_nothing(
    gpu: torch.device, replays: list[int], monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(FakeGraphCapturer, "has_room", lambda self: False)
    with caplog.at_level(logging.WARNING):
        final_state(scene_of("nothing"), dataclasses.replace(SHORT_RUN_CONFIG, steps=3), gpu, graphs=True)
    assert not replays and not caplog.records


@pytest.mark.parametrize(("free", "has_room", "is_short"), [(14, False, True), (60, False, False), (90, True, False)])
def test_a_graph_needs_free_memory_for_one_more_step_and_gives_way_where_little_is_free(
    free: int, has_room: bool, is_short: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda: (free, 500))
    monkeypatch.setattr(torch.cuda, "max_memory_allocated", lambda: 60)
    capturer = step_graphs.GraphCapturer.__new__(step_graphs.GraphCapturer)
    assert (capturer.has_room(), capturer.is_memory_short()) == (has_room, is_short)


@pytest.mark.acceptance
@pytest.mark.parametrize("place", ["capture", "__init__"])
def test_a_gpu_that_cannot_capture_launches_steps_as_usual(
    gpu: torch.device, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, place: str
) -> None:
    def fail(*_: object) -> None:
        raise RuntimeError("operation not permitted when stream is capturing")

    config = dataclasses.replace(SHORT_RUN_CONFIG, steps=4)
    expected = final_state(scene_of("nothing"), config, gpu, graphs=False)
    monkeypatch.setattr(FakeGraphCapturer, place, fail)
    with caplog.at_level(logging.WARNING):
        found = final_state(scene_of("nothing"), config, gpu, graphs=True)
    warnings = [record.message for record in caplog.records if "cannot be captured" in record.message]
    assert len(warnings) == 1 and "operation not permitted" in warnings[0]
    assert all(torch.equal(value, expected[name]) for name, value in found.items())


# -- which steps are captured ----------------------------------------------------------------------------------------


class IdleCapturer:
    """A capturer whose graphs compute nothing."""

    is_short = False

    def has_room(self) -> bool:
        return True

    def is_memory_short(self) -> bool:
        return self.is_short

    def capture(self, launch: object) -> tuple[ViewGradients, Callable[[], None]]:
        return ViewGradients([], *[None] * 4, {}), lambda: None  # type: ignore[arg-type]


class LaunchLog:
    """Runs steps by `StepGraphs`, and keeps the shapes of those that were launched."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, error: Exception | None = None) -> None:
        monkeypatch.setattr(step_graphs, "GraphCapturer", IdleCapturer)
        self.graphs, self.launched, self.error = step_graphs.StepGraphs(), [], error
        self.graphs._is_compared = True

    def run(self, *shapes: StepShape) -> None:
        for shape in shapes:
            self.graphs.run(self.compute, shape, StepInputs(torch.zeros(1)))

    def compute(self, shape: StepShape, inputs: StepInputs) -> None:
        if self.error is not None and len(self.launched) == 3:
            error, self.error = self.error, None
            raise error
        self.launched.append(shape)


def shape_of(size: int, pairs: int = 100) -> StepShape:
    camera = ball_scene(views=1, points=1, side=4).train[0].camera
    return StepShape((size, size), RenderSettings(), False, False, Reserve(10, pairs), camera)


def test_steps_of_many_sizes_have_at_most_four_graphs(monkeypatch: pytest.MonkeyPatch) -> None:
    log = LaunchLog(monkeypatch)
    log.run(*(shape_of(size) for size in range(6) for _ in range(3)))
    assert [shape.size[0] for shape in log.launched] == [0, 1, 2, 3, 4, 4, 4, 5, 5, 5]


def test_a_graph_with_another_reserve_gives_way(monkeypatch: pytest.MonkeyPatch) -> None:
    log = LaunchLog(monkeypatch)
    log.run(*(shape_of(1, pairs) for pairs in range(6) for _ in range(3)))
    assert [shape.reserve.pairs for shape in log.launched if shape.reserve] == list(range(6))
    assert len(log.graphs._graphs) == 1


def test_other_work_gets_the_memory_of_graphs_when_it_is_short(monkeypatch: pytest.MonkeyPatch) -> None:
    log = LaunchLog(monkeypatch)
    log.run(shape_of(1), shape_of(1))
    log.graphs.clear()
    assert log.graphs._capturer is not None
    IdleCapturer.is_short = True
    log.graphs.clear()
    IdleCapturer.is_short = False
    assert log.graphs._capturer is None


@pytest.mark.parametrize("error", [torch.OutOfMemoryError("CUDA out of memory"), HyrfError("the GPU", fix="less")])
def test_a_launched_step_that_runs_out_of_memory_takes_that_of_graphs(
    error: Exception, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    if isinstance(error, HyrfError):
        error.__cause__ = torch.OutOfMemoryError("CUDA out of memory")
    log, shapes = LaunchLog(monkeypatch, error), [shape_of(size) for size in range(4)]
    log.run(shapes[0], shapes[0], shapes[1], shapes[2], shapes[3], shapes[0], shapes[0])
    assert [shape.size[0] for shape in log.launched] == [0, 1, 2, 3, 0, 0]
    assert log.graphs._capturer is None and not caplog.records


def test_memory_that_runs_out_without_graphs_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    log = LaunchLog(monkeypatch, torch.OutOfMemoryError("CUDA out of memory"))
    with pytest.raises(torch.OutOfMemoryError):
        log.run(*(shape_of(size) for size in range(4)))
