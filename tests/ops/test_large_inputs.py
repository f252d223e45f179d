"""Kernels compute the last of five million Gaussians as they compute a few: no offset or program number overflows."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from ops.device import IS_INTERPRETED, needs_triton
from torch import Tensor

from hyrfpack.ops.dispatch import has_triton

if has_triton():
    from last_programs import lazy_zeros, run_last_programs

from hyrfpack.ops.activate import activate_geometry
from hyrfpack.ops.contraction import contract
from hyrfpack.ops.hash_encode import hash_encode, level_offsets, level_resolutions
from hyrfpack.ops.rasterize import Gaussians3D, RasterSettings
from hyrfpack.ops.rows import place_rows, take_rows
from hyrfpack.ops.shade import encode_views
from hyrfpack.ops.viewport import Viewport

pytestmark = [
    needs_triton,
    pytest.mark.acceptance,
    pytest.mark.skipif(not IS_INTERPRETED, reason="only the interpreter can leave out programs"),
]

GAUSSIANS = 5_000_000
LAST_ROWS = 50  # fewer than one program computes
RESOLUTIONS = level_resolutions(16, 16, 2048)
LOG2_TABLE_SIZE = 19


def normal(seed: int, *shape: int) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


TABLE = 0.1 * normal(0, level_offsets(RESOLUTIONS, LOG2_TABLE_SIZE)[-1], 2)


def activate(*rows: Tensor) -> tuple[Tensor, ...]:
    return activate_geometry(*rows, half_extent=(1.0, 0.5, 0.25), rule="sum", implementation="gpu")


def project(means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, colors: Tensor) -> tuple[Tensor, ...]:
    from hyrfpack.ops.rasterize import gpu, gpu_project

    pose = torch.eye(4, dtype=torch.float64)
    pose[2, 3] = 3.0
    viewport, settings = Viewport(pose, (40.0, 40.0, 20.0, 20.0), 40, 40), RasterSettings()
    camera = gpu_project.pack_camera(viewport, settings.near, means.device)
    view = gpu._View(camera, viewport, settings, None)
    projected = gpu._project(Gaussians3D(means, quats, scales, opacities[:, 0]), colors, view)
    assert projected.visible[-LAST_ROWS:].any()
    return projected.records, projected.visible, projected.counts


# The operation of (N, columns) tensors, and their numbers of columns.
CASES: dict[str, tuple[Callable[..., Tensor | tuple[Tensor, ...]], tuple[int, ...]]] = {
    "contract": (lambda x: contract(x, (1.0, 0.5, 0.25), implementation="gpu"), (3,)),
    "encode_views": (lambda x: encode_views(x, torch.ones(3), "frequency", implementation="gpu"), (3,)),
    "activate_geometry": (activate, (8, 3, 1, 1)),
    "hash_encode": (lambda x: hash_encode(x, TABLE, RESOLUTIONS, LOG2_TABLE_SIZE, implementation="gpu"), (3,)),
    "project": (project, (3, 4, 3, 1, 3)),
    "take_rows": (lambda x: take_rows(x, torch.arange(len(x)), torch.tensor([len(x)])), (3,)),
    "place_rows": (lambda x: place_rows(x, torch.arange(len(x)), torch.tensor([len(x)]), len(x)), (3,)),
}


@torch.no_grad()
@pytest.mark.parametrize("name", CASES)
def test_the_last_of_five_million_gaussians_have_the_values_of_a_small_call(name: str) -> None:
    operation, columns = CASES[name]
    few = [normal(seed, LAST_ROWS, width).sigmoid() for seed, width in enumerate(columns)]
    many = [lazy_zeros(GAUSSIANS, width) for width in columns]
    for all_rows, last_rows in zip(many, few, strict=True):
        all_rows[-LAST_ROWS:] = last_rows
    with run_last_programs():
        found = operation(*many)
    expected = operation(*few)
    pairs = zip(found, expected, strict=True) if isinstance(found, tuple) else [(found, expected)]
    for values, reference in pairs:
        assert len(values) == GAUSSIANS
        torch.testing.assert_close(values[-LAST_ROWS:], reference, rtol=1e-5, atol=1e-6)
