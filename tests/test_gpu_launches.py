"""What a step of training asks of a GPU, counted on a pretended one (see `pretend_gpu`).

Small scenes take as long as a GPU needs to be told what to do: every launch is a few microseconds, and after every wait
it stands idle until more arrives.
"""

from __future__ import annotations

import dataclasses
import sys
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from ops.device import INTERPRETED, needs_triton
from pretend_gpu import listening, pretended_gpu
from scenes import ball_scene
from torch import Tensor

import hyrfpack
from hyrfpack.model import HashGridConfig
from hyrfpack.train import DensityConfig, TrainConfig, Trainer

pytestmark = [
    needs_triton,
    pytest.mark.skipif(not INTERPRETED, reason="kernels are built for the GPU that is there"),
]

PACKAGE = Path(hyrfpack.__file__).parent
LAUNCHES, WAITS = 110, 4
SECOND = 2  # the step that is counted: in the first, tables are made that last

Asked = Counter[tuple[str, str, str]]  # kind, name, and the line of the package


def line() -> str:
    """The innermost line of the package that runs now."""
    frame = sys._getframe(1)
    while frame is not None:
        path = Path(frame.f_code.co_filename)
        if path.is_relative_to(PACKAGE):
            return f"{path.relative_to(PACKAGE)}:{frame.f_lineno}"
        frame = frame.f_back
    return "elsewhere"


def asked_in_a_step(points: int, side: int) -> Asked:
    """What the second step asks, of so many Gaussians and photos of so many pixels a side."""
    scene = ball_scene(views=3, points=points, side=side)
    scene = dataclasses.replace(scene, test=scene.train[:1])
    # The round of density control comes after the last step, so that gradients are collected for it.
    density = DensityConfig(start=1.0, stop=1.0, rounds=1)
    config = TrainConfig(
        steps=3, max_gaussians=points, density=density, log2_table_size=5, background=True, exposure=False
    )
    asked: Asked = Counter()

    def listen(kind: str, name: str) -> None:
        if trainer.step == SECOND:
            asked[kind, name, line()] += 1

    with pytest.MonkeyPatch.context() as patch, pretended_gpu() as gpu:
        # Few levels, for the interpreter is slow; the coarser with fewer rows than there are points, as in real scenes.
        patch.setattr(
            "hyrfpack.train.setup.HashGridConfig",
            lambda log2_table_size, **sizes: HashGridConfig(log2_table_size, **(sizes | {"levels": 2, "base": 2})),
        )
        trainer = Trainer(scene, config, device=gpu)
        with listening(listen):
            trainer.run(stop=lambda: trainer.step == SECOND)
    assert trainer.step == SECOND and len(trainer.model) == points
    return asked


def of_kind(asked: Asked, kind: str) -> int:
    return sum(count for (its, *_), count in asked.items() if its == kind)


def listed(asked: Asked) -> str:
    return "\n".join(f"{count:4} {kind:7} {name:24} {place}" for (kind, name, place), count in sorted(asked.items()))


@pytest.fixture(scope="module")
def asked() -> Asked:
    return asked_in_a_step(points=20, side=8)


def test_a_step_is_few_launches(asked: Asked) -> None:
    assert of_kind(asked, "launch") <= LAUNCHES, f"{of_kind(asked, 'launch')} launches:\n{listed(asked)}"


def test_a_step_waits_four_times(asked: Asked) -> None:
    """For what is in view, how many pairs it makes, the nodes of the background, and the loss."""
    assert of_kind(asked, "wait") == WAITS, f"{of_kind(asked, 'wait')} waits:\n{listed(asked)}"


def test_all_parts_of_a_step_are_counted(asked: Asked) -> None:
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
    assert {name for kind, name, _ in asked if kind == "wait"} == {"tolist", "nonzero"}
    assert of_kind(asked, "copy") > 0  # the photo, at least


def test_a_step_of_a_bigger_scene_asks_for_no_more(asked: Asked) -> None:
    """Beyond a block of every kernel, and beyond a tile of the picture."""
    bigger = asked_in_a_step(points=130, side=17)
    assert bigger == asked, f"more:\n{listed(bigger - asked)}\nfewer:\n{listed(asked - bigger)}"


# -- the count itself ------------------------------------------------------------------------------------------------


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
        (lambda x: torch.tensor([1.0], device=x.device), ["copy", "wait"]),
        (lambda x: x.new_tensor([1.0]), ["copy", "wait"]),
        (set_first, ["copy", "wait"]),
    ],
)
def test_what_is_a_launch_a_wait_or_a_copy(act: Callable[[Tensor], object], expected: list[str]) -> None:
    heard = []
    with pretended_gpu() as gpu:
        x = torch.ones(3).to(gpu)
        with listening(lambda kind, name: heard.append(kind)):
            act(x)
        act(x)
    assert heard == expected
