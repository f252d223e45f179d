"""Counts the work that a training step gives a GPU, on a fake one (see `fake_gpu`).

For small scenes this work decides the time: each launch costs a few microseconds, and after each wait the GPU is idle
until it receives more.
"""

from __future__ import annotations

import dataclasses
import sys
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from fake_gpu import listen_to_gpu, use_fake_gpu
from ops.device import IS_INTERPRETED, needs_triton
from scenes import ball_scene
from torch import Tensor

import hyrfpack
from hyrfpack.model import HashGridConfig
from hyrfpack.train import DensityConfig, TrainConfig, Trainer

pytestmark = [
    needs_triton,
    pytest.mark.skipif(not IS_INTERPRETED, reason="kernels are built for the GPU that is there"),
]

PACKAGE_FOLDER = Path(hyrfpack.__file__).parent
MAX_STEP_LAUNCHES, MAX_REPLAYED_STEP_LAUNCHES = 127, 21
STEP_WAITS = 1
# The second step is counted, because the first one also fills caches.
COUNTED_STEP = 2
# The first three steps see each photo for the first time. Step 4 is recorded and compared.
REPLAYED_STEP = 5

# Counts by kind, name and the line of the package.
WorkCounts = Counter[tuple[str, str, str]]


def current_package_line() -> str:
    """Return the innermost line of the package that runs now."""
    frame = sys._getframe(1)
    while frame is not None:
        path = Path(frame.f_code.co_filename)
        if path.is_relative_to(PACKAGE_FOLDER):
            return f"{path.relative_to(PACKAGE_FOLDER)}:{frame.f_lineno}"
        frame = frame.f_back
    return "elsewhere"


def count_step_work(points: int, side: int, *, replayed: bool = False) -> WorkCounts:
    """Count the work of one step, for a number of Gaussians and photos of `side` pixels a side.

    Args:
        replayed: whether the step is recorded as a graph; its launches count as one.
    """
    counted_step = REPLAYED_STEP if replayed else COUNTED_STEP
    scene = ball_scene(views=3, points=points, side=side)
    scene = dataclasses.replace(scene, test=scene.train[:1])
    # Density control acts after the last step, so that gradients are collected for it.
    density = DensityConfig(start=1.0, stop=1.0, rounds=1)
    config = TrainConfig(
        steps=6, max_gaussians=points, density=density, log2_table_size=5, background=True, exposure=False
    )
    asked: WorkCounts = Counter()

    def listen(kind: str, name: str) -> None:
        if trainer.step == counted_step:
            asked[kind, name, current_package_line()] += 1

    with pytest.MonkeyPatch.context() as patch, use_fake_gpu() as gpu:
        # Few levels, because the interpreter is slow. The coarser level has fewer rows than there are points, as in
        # real scenes.
        patch.setattr(
            "hyrfpack.train.setup.HashGridConfig",
            lambda log2_table_size, **sizes: HashGridConfig(log2_table_size, **(sizes | {"levels": 2, "base": 2})),
        )
        patch.setattr("hyrfpack.ops.hash_encode.gpu._POINTS_PER_THREAD", 1)
        trainer = Trainer(scene, config, device=gpu)
        if not replayed:
            trainer.renderer.replays_steps = False
        with listen_to_gpu(listen):
            trainer.run(stop=lambda: trainer.step > counted_step)
    assert trainer.step > counted_step and len(trainer.model) == points
    return asked


def count_kind(asked: WorkCounts, kind: str) -> int:
    return sum(count for (its, *_), count in asked.items() if its == kind)


def format_counts(asked: WorkCounts) -> str:
    return "\n".join(f"{count:4} {kind:7} {name:24} {place}" for (kind, name, place), count in sorted(asked.items()))


@pytest.fixture(scope="module")
def asked() -> WorkCounts:
    return count_step_work(points=20, side=8)


@pytest.mark.acceptance
def test_a_step_has_at_most_127_launches(asked: WorkCounts) -> None:
    assert count_kind(asked, "launch") <= MAX_STEP_LAUNCHES, (
        f"{count_kind(asked, 'launch')} launches:\n{format_counts(asked)}"
    )


@pytest.mark.acceptance
def test_a_step_that_is_replayed_has_few_launches_of_its_own() -> None:
    asked = count_step_work(points=20, side=8, replayed=True)
    assert sum(count for (_, name, _), count in asked.items() if name == "replay of a graph") == 1
    assert count_kind(asked, "launch") <= MAX_REPLAYED_STEP_LAUNCHES, (
        f"{count_kind(asked, 'launch')} launches:\n{format_counts(asked)}"
    )
    assert count_kind(asked, "wait") == STEP_WAITS


def test_a_step_waits_only_for_the_numbers_of_the_step_before(asked: WorkCounts) -> None:
    assert count_kind(asked, "wait") == STEP_WAITS, f"{count_kind(asked, 'wait')} waits:\n{format_counts(asked)}"


def test_all_parts_of_a_step_are_counted(asked: WorkCounts) -> None:
    names = {name for kind, name, _ in asked if kind == "launch"}
    kernels = {
        "frustum_kernel",
        "activate_backward",
        "encode_views_kernel",
        "project",
        "blend_backward",
        "encode_nodes_kernel",
    }
    kernels |= {"composite_kernel", "grad_grid_kernel", "adam_step_kernel"}
    assert names >= kernels | {"index_add_", "searchsorted", "zeros", "arange"}
    assert {name for kind, name, _ in asked if kind == "wait"} == {"synchronize"}
    assert count_kind(asked, "copy") > 0  # the photo, at least


@pytest.mark.acceptance
def test_a_step_of_a_larger_scene_gives_the_gpu_the_same_work(asked: WorkCounts) -> None:
    """The scene exceeds one block of every kernel, and one tile of the picture."""
    bigger = count_step_work(points=130, side=17)
    assert bigger == asked, f"more:\n{format_counts(bigger - asked)}\nfewer:\n{format_counts(asked - bigger)}"


# -- the counting itself ---------------------------------------------------------------------------------------------


def set_first(x: Tensor) -> None:
    x[0] = 1.0


@pytest.mark.parametrize(
    ("act", "expected"),
    [
        (lambda x: x[None, 1:].T.detach().expand(2, 2).unsqueeze(0), []),
        (lambda x: torch.empty_like(x, device=x.device), []),
        (lambda x: x.reshape(3, 1) + 1, ["launch"]),
        (lambda x: x.double(), ["launch"]),
        (lambda x: x.new_zeros(3), ["launch"]),
        (lambda x: torch.zeros(3, device=x.device), ["launch"]),
        (lambda x: torch.ones_like(x), ["launch"]),
        (lambda x: torch.eye(3, device=x.device) @ x, ["launch", "launch"]),
        (lambda x: x.tolist(), ["wait"]),
        (lambda x: x.cpu(), ["wait"]),
        (lambda x: torch.zeros(3).copy_(x), ["wait"]),
        (lambda x: float(x[0]), ["wait"]),
        (lambda x: bool((x > 0).any()), ["launch", "launch", "wait"]),
        (lambda x: torch.nonzero(x), ["wait", "launch"]),
        (lambda x: torch.equal(x, x), ["wait", "launch"]),
        (lambda x: x[x > 0], ["launch", "wait", "launch"]),
        (lambda x: x[(x > 0).long()], ["launch", "launch", "launch"]),
        (lambda x: x[[0, 1]], ["copy", "wait", "launch"]),
        (lambda x: torch.zeros(3).to(x.device), ["copy", "wait"]),
        (lambda x: torch.zeros(3).to(x.device, non_blocking=True), ["copy"]),
        (lambda x: x.copy_(torch.zeros(3), non_blocking=True), ["copy"]),
        (lambda x: torch.zeros(1 << 14).to(x.device, non_blocking=True), ["copy"]),
        (lambda x: torch.zeros(1 << 15).to(x.device, non_blocking=True), ["copy", "wait"]),
        (lambda x: torch.zeros(1 << 15).pin_memory().to(x.device, non_blocking=True), ["copy"]),
        (lambda x: torch.zeros(1 << 15, pin_memory=True).to(x.device, non_blocking=True), ["copy"]),
        (lambda x: x.new_empty(1 << 15).copy_(torch.zeros(1 << 15), non_blocking=True), ["copy", "wait"]),
        (lambda x: torch.tensor([1.0], device=x.device), ["copy", "wait"]),
        (lambda x: x.new_tensor([1.0]), ["copy", "wait"]),
        (set_first, ["copy", "wait"]),
    ],
)
def test_each_operation_counts_as_launch_wait_or_copy(act: Callable[[Tensor], object], expected: list[str]) -> None:
    heard = []
    with use_fake_gpu() as gpu:
        x = torch.ones(3).to(gpu)
        with listen_to_gpu(lambda kind, name: heard.append(kind)):
            act(x)
        act(x)
    assert heard == expected
