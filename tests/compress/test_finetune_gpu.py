"""Fine-tuning on a GPU: what a step copies and waits for, reserves that are too small, and numbers that are not finite.

They run on the fake GPU, where a number that is read before the host has waited for it is not there yet.
"""

from __future__ import annotations

import copy
import dataclasses
from collections import Counter
from collections.abc import Callable, Iterator, Sequence

import pytest
import torch
from fake_gpu import listen_to_gpu, listen_to_transfers, use_fake_gpu
from ops.device import IS_INTERPRETED, needs_triton
from scenes import ball_points, ball_scene, small_model
from torch import Tensor

from hyrfpack.compress.finetune import finetune
from hyrfpack.compress.plan import make_plan
from hyrfpack.compress.sensitivity import Sensitivity, measure_sensitivity
from hyrfpack.errors import HyrfTrainingError
from hyrfpack.format.compact.plan import Plan
from hyrfpack.model import HybridModel
from hyrfpack.progress import Progress, ignore_progress
from hyrfpack.render.reserve import Reserve
from hyrfpack.scene import Scene, View
from hyrfpack.train.trainer import shuffled

pytestmark = [
    needs_triton,
    pytest.mark.skipif(not IS_INTERPRETED, reason="the work of a fake GPU is counted"),
]

SIDE_PIXELS, GAUSSIAN_COUNT = 10, 260
DRAWN_GAUSSIANS = 20  # The interpreter takes long for each. The others are too faint to be drawn.
PHOTO_ELEMENTS = 3 * SIDE_PIXELS**2
# Cameras, learning rates, addresses of parameters and the numbers of a step are fewer than this. All explicit
# parameters and tables have at least GAUSSIAN_COUNT elements.
MAX_SMALL_ELEMENTS = 250
COUNTED_STEP = 2  # The first step also fills caches, and the last one waits for itself.
LARGE_RESERVE = Reserve(GAUSSIAN_COUNT, 10_000)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return ball_scene(views=3, points=10, side=SIDE_PIXELS)


@pytest.fixture(scope="module")
def model() -> HybridModel:
    points, colors = ball_points(GAUSSIAN_COUNT)
    colors = torch.from_numpy(colors) * 4 - 2
    opacity_logits = torch.full((GAUSSIAN_COUNT, 1), -20.0)
    opacity_logits[:: GAUSSIAN_COUNT // DRAWN_GAUSSIANS] = 2.0
    model = small_model(
        points, color_logits=colors, scale_logits=-2.0, opacity_logits=opacity_logits, fields=1.0, background=True
    )
    model.precision = "float32"
    return model


@pytest.fixture(scope="module")
def sensitivity(model: HybridModel, scene: Scene) -> Sensitivity:
    return measure_sensitivity(model, [view.camera for view in scene.train])


@pytest.fixture(scope="module")
def plan(model: HybridModel, sensitivity: Sensitivity) -> Plan:
    plan = make_plan(model, sensitivity, 1e-5, prune=False)
    assert len(plan.kept) == GAUSSIAN_COUNT
    return plan


@pytest.fixture
def gpu() -> Iterator[torch.device]:
    with use_fake_gpu() as device:
        yield device


@dataclasses.dataclass(frozen=True)
class Tuning:
    """Fine-tunes the model of a test on a device."""

    model: HybridModel
    plan: Plan
    sensitivity: Sensitivity
    views: Sequence[View]
    gains: dict[str, tuple[float, float, float]]

    def run(self, device: torch.device, steps: int, progress: Progress = ignore_progress) -> dict[str, Tensor]:
        model = copy.deepcopy(self.model).to(device)
        gains = {name: torch.tensor(gain).to(device) for name, gain in self.gains.items()}
        tuned, _ = finetune(model, self.plan, self.sensitivity, self.views, steps, gains=gains, progress=progress)
        assert tuned.gaussians.positions.device == device
        return {name: value.detach().cpu() for name, value in tuned.named_parameters()}


@pytest.fixture
def tuning(model: HybridModel, plan: Plan, sensitivity: Sensitivity, scene: Scene) -> Tuning:
    gains = {view.name: (1.1, 0.9, 1.0) for view in scene.train}
    return Tuning(model, plan, sensitivity, scene.train, gains)


def use_reserves(patch: pytest.MonkeyPatch, reserve_of: Callable[[int], Reserve]) -> list[int]:
    """Render into given reserves, by the number of the rendering from 0; return a list that grows with renderings."""
    renderings: list[int] = []

    def estimate(self: object, view: View, gaussians: int) -> Reserve:
        renderings.append(gaussians)
        return reserve_of(len(renderings) - 1)

    patch.setattr("hyrfpack.train.reserves.ReserveEstimator.estimate", estimate)
    return renderings


@pytest.mark.acceptance
def test_a_step_waits_once_and_copies_only_its_photo_and_few_numbers(gpu: torch.device, tuning: Tuning) -> None:
    events: list[object] = []
    work, elements = Counter[tuple[str, str]](), {"to host": [0], "to device": [0]}

    def count_work(kind: str, name: str) -> None:
        work[kind, name] += len(events) == COUNTED_STEP - 1

    def count_elements(direction: str, count: int) -> None:
        if len(events) == COUNTED_STEP - 1:
            elements[direction].append(count)

    with listen_to_gpu(count_work), listen_to_transfers(count_elements):
        tuning.run(gpu, COUNTED_STEP + 1, events.append)

    assert {name: count for (kind, name), count in work.items() if kind == "wait" and count} == {"synchronize": 1}
    assert max(elements["to host"]) <= MAX_SMALL_ELEMENTS
    assert sorted(elements["to device"])[-1] == PHOTO_ELEMENTS
    assert sorted(elements["to device"])[-2] <= MAX_SMALL_ELEMENTS
    assert work["launch", "blend_backward"] == work["launch", "adam_step_kernel"] == 1


@pytest.mark.acceptance
def test_finetuning_agrees_with_the_cpu(gpu: torch.device, tuning: Tuning) -> None:
    expected = tuning.run(torch.device("cpu"), 3)
    found = tuning.run(gpu, 3)
    planned = tuning.plan.apply(tuning.model).state_dict()
    for name, value in found.items():
        # Adam's first steps are as long for a rounded gradient as for a large one, and few cells change.
        assert (value - expected[name]).abs().median() < 1e-5, name
    changed = {name for name, value in found.items() if not torch.equal(value, planned[name])}
    assert found.keys() - changed <= {"gaussians.positions"}  # Few steps may leave all Gaussians in their cells.


@pytest.mark.acceptance
def test_a_reserve_that_is_too_small_does_not_change_the_result(
    gpu: torch.device, tuning: Tuning, monkeypatch: pytest.MonkeyPatch
) -> None:
    results, counts = [], []
    small_reserves = {}, {0: Reserve(3, 5000)}, {1: Reserve(GAUSSIAN_COUNT, 7), 2: Reserve(GAUSSIAN_COUNT, 0)}
    for reserves in small_reserves:
        renderings = use_reserves(monkeypatch, lambda number, small=reserves: small.get(number, LARGE_RESERVE))
        results.append(tuning.run(gpu, 2))
        counts.append(len(renderings))
    # Both steps again, as step 2 was launched before step 1 was read; then step 2 twice.
    assert counts == [2, 4, 4]
    expected, *found = results
    for result in found:
        assert [name for name, value in result.items() if not torch.equal(value, expected[name])] == []


@pytest.mark.acceptance
@pytest.mark.parametrize("step", [1, 3])
def test_a_loss_that_is_not_finite_names_its_step_and_view(gpu: torch.device, tuning: Tuning, step: int) -> None:
    name = [view.name for view in shuffled(tuning.views, 0, range(3))][step - 1]
    broken = dataclasses.replace(tuning, gains={**tuning.gains, name: (1.0, float("nan"), 1.0)})
    with pytest.raises(HyrfTrainingError, match=f"stopped at step {step} on view '{name}'.*not finite"):
        broken.run(gpu, 3)
