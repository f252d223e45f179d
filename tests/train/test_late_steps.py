"""Steps on a GPU whose numbers are read a step later: reserves that are too small, NaN, and the order of reports.

They run on the fake GPU, where a number that is read before the host has waited for it is not there yet.
"""

from __future__ import annotations

import dataclasses
import operator
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from fake_gpu import use_fake_gpu
from ops.device import IS_INTERPRETED, needs_triton
from scenes import ball_scene
from torch import Tensor

from hyrfpack.errors import HyrfTrainingError
from hyrfpack.model import HashGridConfig
from hyrfpack.ops.transfer import HostCopy
from hyrfpack.progress import StepEvent
from hyrfpack.render.reserve import Reserve
from hyrfpack.scene import Camera, View
from hyrfpack.train import DensityConfig, TrainConfig, Trainer
from hyrfpack.train.reserves import MIN_RESERVED_PAIRS, ReserveEstimator

pytestmark = [
    needs_triton,
    pytest.mark.skipif(not IS_INTERPRETED, reason="a GPU adds to hash tables in any order, so that bits differ"),
]

POINT_COUNT, SIDE_PIXELS = 20, 10
LARGE_RESERVE = Reserve(1000, 5000)
SMALL_RESERVES = {
    "Gaussians in view": Reserve(3, 5000),
    "pairs": Reserve(1000, 7),
    "pairs of no Gaussian": Reserve(1000, 0),
}
# Density control acts after steps 2 and 7.
SHORT_RUN_CONFIG = TrainConfig(
    steps=7,
    max_gaussians=30,
    density=DensityConfig(start=0.3, stop=1.0, rounds=1, gradient=1e-6, resets=0),
    precision="float32",
    log2_table_size=5,
    exposure=True,
)


def reduce_levels(patch: pytest.MonkeyPatch) -> None:
    """Make models of 2 levels, because the interpreter is slow."""
    patch.setattr(
        "hyrfpack.train.setup.HashGridConfig",
        lambda log2_table_size, **sizes: HashGridConfig(log2_table_size, levels=2, **sizes),
    )


@pytest.fixture(autouse=True)
def few_levels(monkeypatch: pytest.MonkeyPatch) -> None:
    reduce_levels(monkeypatch)


@pytest.fixture
def gpu() -> Iterator[torch.device]:
    with use_fake_gpu() as device:
        yield device


def make_trainer(device: torch.device, config: TrainConfig = SHORT_RUN_CONFIG) -> Trainer:
    scene = ball_scene(views=3, points=POINT_COUNT, side=SIDE_PIXELS)
    return Trainer(dataclasses.replace(scene, test=scene.train[:1]), config, device=device)


def use_reserves(trainer: Trainer, reserve_of: Callable[[int], Reserve]) -> list[int]:
    """Make a trainer render into given reserves; return a list that gets the number of Gaussians at each rendering.

    Args:
        reserve_of: function of the number of the rendering, from 0.
    """
    sizes: list[int] = []

    def estimate(views: object, view: object, gaussians: int) -> Reserve:
        sizes.append(gaussians)
        return reserve_of(len(sizes) - 1)

    trainer.renderer.reserves.estimate_shared = estimate  # type: ignore[method-assign]
    return sizes


def state_of(trainer: Trainer) -> dict[str, Tensor]:
    """Return all that a later step depends on, on the CPU."""
    tensors = trainer._collect_tensors() | {
        f"density.{name}": value.cpu() for name, value in trainer.strategy.state_dict().items()
    }
    return {name: value.clone() for name, value in tensors.items()}


def run_with_reserves(
    device: torch.device, config: TrainConfig, reserve_of: Callable[[int], Reserve]
) -> tuple[int, list[tuple], dict[str, Tensor]]:
    """Return the number of renderings, what was reported of each step, and the state at the end."""
    trainer, reports = make_trainer(device, config), []
    sizes = use_reserves(trainer, reserve_of)
    trainer.run(progress=lambda event: reports.append((event.step, event.loss, event.mse, event.gaussians)))
    return len(sizes), reports, state_of(trainer)


def assert_same_run(found: tuple[int, list[tuple], dict[str, Tensor]], expected: tuple) -> None:
    assert found[1] == expected[1]
    assert found[2].keys() == expected[2].keys()
    assert [name for name, value in found[2].items() if not torch.equal(value, expected[2][name])] == []


@pytest.mark.acceptance
def test_a_run_with_too_small_a_reserve_equals_one_with_a_large_reserve(gpu: torch.device) -> None:
    density = dataclasses.replace(SHORT_RUN_CONFIG.density, start=1.0)
    config = dataclasses.replace(SHORT_RUN_CONFIG, steps=2, density=density, background=False, exposure=False)
    expected = run_with_reserves(gpu, config, lambda number: LARGE_RESERVE)
    found = run_with_reserves(gpu, config, lambda number: SMALL_RESERVES["pairs"] if number == 0 else LARGE_RESERVE)
    assert (expected[0], found[0]) == (2, 4)  # step 1, step 2, both again
    assert_same_run(found, expected)


@pytest.fixture(scope="module")
def expected() -> tuple[int, list[tuple], dict[str, Tensor]]:
    """A run whose reserves are always large enough."""
    with pytest.MonkeyPatch.context() as patch:
        reduce_levels(patch)
        with use_fake_gpu() as device:
            return run_with_reserves(device, SHORT_RUN_CONFIG, lambda number: LARGE_RESERVE)


@pytest.mark.acceptance
@pytest.mark.parametrize("small", SMALL_RESERVES.values(), ids=SMALL_RESERVES)
@pytest.mark.parametrize("numbers", [{1}, {0, 3, 4}], ids=["before density control", "read late, twice in a row"])
def test_density_control_and_gains_do_not_depend_on_reserves(
    small: Reserve, numbers: set[int], expected: tuple, gpu: torch.device
) -> None:
    found = run_with_reserves(gpu, SHORT_RUN_CONFIG, lambda number: small if number in numbers else LARGE_RESERVE)
    assert found[0] > expected[0] == SHORT_RUN_CONFIG.steps
    assert_same_run(found, expected)


@pytest.mark.acceptance
def test_a_resumed_run_gives_the_parameters_of_the_uninterrupted_one(
    expected: tuple, gpu: torch.device, tmp_path: Path
) -> None:
    first, second = make_trainer(gpu), make_trainer(gpu)
    use_reserves(first, lambda number: LARGE_RESERVE)
    assert not first.run(checkpoint=tmp_path / "c.pt", stop=lambda: first.step == 5)
    second.load(tmp_path / "c.pt")
    use_reserves(second, lambda number: LARGE_RESERVE)
    second.run()
    state = state_of(second)
    assert [name for name, value in state.items() if not torch.equal(value, expected[2][name])] == []


@pytest.mark.acceptance
def test_each_step_is_reported_once_and_a_step_later_unless_the_host_must_wait(gpu: torch.device) -> None:
    trainer, reports = make_trainer(gpu), []
    trainer.run(progress=lambda event: reports.append((event.step, trainer.step)))
    assert [step for step, _ in reports] == list(range(1, SHORT_RUN_CONFIG.steps + 1))
    waits = {2, 7}  # density control; the last one also ends the run
    assert [now for _, now in reports] == [step if step in waits else step + 1 for step, _ in reports]


@pytest.mark.acceptance
@pytest.mark.parametrize("name", ["gaussians.positions", "gaussians.opacity_logits", "radiance.biases.2"])
def test_a_parameter_that_is_not_finite_changes_nothing_and_is_reported_at_most_a_step_late(
    name: str, gpu: torch.device
) -> None:
    trainer, poisoned = make_trainer(gpu), {}

    def poison(event: StepEvent) -> None:
        if event.step == 3:  # Step 4 has been launched, too.
            dict(trainer.model.named_parameters())[name].data.flatten()[0].fill_(torch.nan)
            poisoned.update(state_of(trainer))

    message = rf"stopped at step 5 .*a number to be rendered is not finite .*groups: {name}\b"
    with pytest.raises(HyrfTrainingError, match=message):
        trainer.run(progress=poison)

    assert trainer.step == 6
    after = state_of(trainer)
    values = [key for key in after if not key.endswith((".step", ".steps"))]  # The last step is counted.
    assert all(torch.equal(after[key].nan_to_num(7.5), poisoned[key].nan_to_num(7.5)) for key in values)


@pytest.mark.acceptance
def test_a_loss_that_is_not_finite_changes_nothing(gpu: torch.device, monkeypatch: pytest.MonkeyPatch) -> None:
    trainer = make_trainer(gpu)
    before = state_of(trainer)
    monkeypatch.setattr("hyrfpack.train.gradients.photometric_loss", lambda image, *_, **__: image.mean() * torch.inf)
    with pytest.raises(HyrfTrainingError, match=r"stopped at step 1 .*the loss is not finite"):
        trainer.run()
    after = state_of(trainer)
    assert all(torch.equal(value, before[key]) for key, value in after.items() if key in before and "step" not in key)


@pytest.mark.acceptance
@pytest.mark.parametrize("value", [torch.nan, torch.inf, 1e30])
def test_a_gradient_that_is_not_finite_changes_nothing(gpu: torch.device, value: float) -> None:
    """Adam squares gradients, so that 1e30 is as bad as infinity."""
    trainer = make_trainer(gpu)
    before = state_of(trainer)
    trainer.model.gaussians.scale_logits.register_hook(lambda grad: grad + value * (grad == grad.max()))
    with pytest.raises(HyrfTrainingError, match=r"step 1 .*a gradient is not finite .*groups: scale_logits\)"):
        trainer.run()
    assert trainer.step == 2
    after = state_of(trainer)
    assert all(torch.equal(after[key], old) for key, old in before.items() if key.startswith(("model", "density")))


def test_a_copy_to_the_host_keeps_the_values_of_its_beginning(gpu: torch.device) -> None:
    values = torch.tensor([1.0, 2.0]).to(gpu)
    copy = HostCopy(values)
    values.fill_(7)
    assert copy.tolist() == [1, 2]


# -- estimates -------------------------------------------------------------------------------------------------------


def make_view(name: str, width: int = 64, height: int = 64) -> View:
    return View(name, Camera(width, height, 50.0, 50.0, 32.0, 32.0, np.eye(4)), lambda: None)  # type: ignore[arg-type]


def test_a_view_gets_one_and_a_half_times_its_last_counts() -> None:
    estimator = ReserveEstimator()
    estimator.record(make_view("a"), 10_000, in_view=3001, pairs=20_001)
    assert estimator.estimate(make_view("a"), 10_000) == Reserve(4502, 30_002)
    estimator.record(make_view("a"), 10_000, in_view=4000, pairs=10_000)
    assert estimator.estimate(make_view("a"), 10_000) == Reserve(6000, 15_000)


def test_a_reserve_grows_with_the_gaussians_and_the_side_of_the_picture() -> None:
    estimator = ReserveEstimator()
    estimator.record(make_view("a"), 10_000, in_view=3000, pairs=20_000)
    assert estimator.estimate(make_view("a"), 20_000) == Reserve(9000, 60_000)
    assert estimator.estimate(make_view("a", 128, 128), 10_000) == Reserve(4500, 60_000)
    assert estimator.estimate(make_view("a", 32, 32), 5000) == Reserve(4500, 30_000)


def test_a_reserve_never_exceeds_the_number_of_gaussians() -> None:
    estimator = ReserveEstimator()
    estimator.record(make_view("a"), 100, in_view=90, pairs=1)
    assert estimator.estimate(make_view("a"), 100) == Reserve(100, MIN_RESERVED_PAIRS)


def test_a_view_that_was_not_rendered_yet_gets_all_gaussians_and_the_most_pairs_of_others() -> None:
    estimator = ReserveEstimator()
    assert estimator.estimate(make_view("a"), 10_000) == Reserve(10_000, 80_000)
    estimator.record(make_view("a"), 10_000, in_view=10, pairs=6000)
    estimator.record(make_view("b"), 10_000, in_view=20, pairs=8000)
    assert estimator.estimate(make_view("c"), 10_000) == Reserve(10_000, 12_000)


def test_the_shared_reserve_suffices_for_each_view_and_is_rounded_up_by_a_quarter_at_most() -> None:
    estimator, views = ReserveEstimator(), [make_view(name) for name in "abc"]
    for view, (in_view, pairs) in zip(views, ((2000, 30_001), (3001, 20_000), (10, 5)), strict=True):
        estimator.record(view, 10_000, in_view=in_view, pairs=pairs)
    shared = estimator.estimate_shared(views, views[2], 10_000)
    assert shared == Reserve(5120, 49_152)
    for view in views:
        assert all(map(operator.le, estimator.estimate(view, 10_000).limits, shared.limits))
    assert shared.gaussians <= 1.25 * 4502 and shared.pairs <= 1.25 * 45_002
    assert estimator.estimate_shared([make_view("new")], views[0], 10_000).gaussians == 5120  # as long as none is near


def test_the_shared_reserve_changes_with_the_gaussians_the_size_and_a_view_that_nearly_fills_it() -> None:
    estimator, views = ReserveEstimator(), [make_view("a"), make_view("b")]
    for view in views:
        estimator.record(view, 10_000, in_view=3000, pairs=20_000)
    first = estimator.estimate_shared(views, views[0], 10_000)
    estimator.record(views[1], 10_000, in_view=4000, pairs=28_000)
    assert estimator.estimate_shared(views, views[0], 10_000) == first == Reserve(5120, 32_768)
    estimator.record(views[1], 10_000, in_view=4500, pairs=20_000)
    assert estimator.estimate_shared(views, views[0], 10_000) == Reserve(7168, 32_768)
    estimator.record(views[0], 10_000, in_view=3000, pairs=29_000)
    assert estimator.estimate_shared(views, views[0], 10_000) == Reserve(7168, 49_152)
    assert estimator.estimate_shared(views, views[0], 20_000) == Reserve(14_336, 98_304)
    assert estimator.estimate_shared(views, make_view("a", 128, 128), 20_000) == Reserve(14_336, 196_608)


def test_a_shared_reserve_of_all_gaussians_stays_though_a_view_shows_all() -> None:
    estimator, view = ReserveEstimator(), make_view("a")
    shared = estimator.estimate_shared([view], view, 100)
    estimator.record(view, 100, in_view=100, pairs=10)
    assert estimator.estimate_shared([view], view, 100) is shared
