"""Kernels compute the last elements of large inputs as they compute a few: no offset or program number overflows."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from ops.device import IS_INTERPRETED, needs_triton
from torch import Tensor

from hyrfpack.ops.dispatch import has_triton

if has_triton():
    from last_programs import LAST_PROGRAMS, lazy_zeros, run_last_programs

from hyrfpack.ops.activate import activate_geometry
from hyrfpack.ops.adam import adam_step
from hyrfpack.ops.contraction import contract
from hyrfpack.ops.hash_encode import hash_encode, level_offsets, level_resolutions
from hyrfpack.ops.mlp import mlp
from hyrfpack.ops.rasterize import Gaussians3D, RasterSettings
from hyrfpack.ops.rasterize.cull import frustum_cull
from hyrfpack.ops.rows import place_rows, take_rows
from hyrfpack.ops.shade import encode_views
from hyrfpack.ops.ssim import photometric_loss
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


def adam(values: Tensor, gradients: Tensor, exp_avg: Tensor, exp_avg_sq: Tensor) -> tuple[Tensor, ...]:
    adam_step([values], [gradients], [exp_avg], [exp_avg_sq], step=3, rate=0.1, implementation="gpu")
    return values, exp_avg, exp_avg_sq


def make_viewport() -> Viewport:
    pose = torch.eye(4, dtype=torch.float64)
    pose[2, 3] = 3.0
    return Viewport(pose, (40.0, 40.0, 20.0, 20.0), 40, 40)


def project(means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, colors: Tensor) -> tuple[Tensor, ...]:
    from hyrfpack.ops.rasterize import gpu, gpu_project

    viewport, settings = make_viewport(), RasterSettings()
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
    "adam_step": (adam, (3, 3, 3, 3)),
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


@torch.no_grad()
def test_the_last_of_five_million_gaussians_are_culled_as_in_a_small_call() -> None:
    few = 6 * normal(0, LAST_ROWS, 3)
    many = lazy_zeros(GAUSSIANS, 3)
    many[-LAST_ROWS:] = few
    expected = frustum_cull(few, make_viewport(), 0.01, 0.0, implementation="gpu")
    with run_last_programs():
        found = frustum_cull(many, make_viewport(), 0.01, 0.0, implementation="gpu")
    assert 5 < len(expected) < LAST_ROWS
    assert (found[-len(expected) :] - (GAUSSIANS - LAST_ROWS)).tolist() == expected.tolist()
    assert found[-len(expected) - 1] < GAUSSIANS - LAST_ROWS


def test_pairs_up_to_the_largest_number_are_blended_and_their_gradients_summed_as_few_pairs_are() -> None:
    from hyrfpack.ops.rasterize import gpu, gpu_bin, gpu_blend, gpu_project

    viewport, settings = make_viewport(), RasterSettings()
    means, quats, scales, opacities, colors = (normal(seed, LAST_ROWS, n) for seed, n in enumerate((3, 4, 3, 1, 3)))
    gaussians = Gaussians3D(0.5 * means, quats, 0.1 * scales.exp(), opacities[:, 0].sigmoid())
    camera = gpu_project.pack_camera(viewport, settings.near, means.device)
    projection = gpu._project(gaussians, colors.sigmoid(), gpu._View(camera, viewport, settings, None))
    few = gpu_bin.bin_pairs(projection, viewport.width, viewport.height, None)
    count, first = len(few.owners), gpu_bin.MAX_PAIRS - len(few.owners)

    owners = lazy_zeros(gpu_bin.MAX_PAIRS, dtype=torch.int32)
    slots = lazy_zeros(gpu_bin.MAX_PAIRS, dtype=torch.int64)
    owners[first:], slots[first:] = few.owners, few.slots + first
    many = gpu_bin.Pairs(few.tile_starts + first, owners, slots, few.slot_starts + first, (), None)

    def blend_and_sum(pairs: gpu_bin.Pairs, rows: Tensor) -> tuple[Tensor, ...]:
        tiles = len(pairs.tile_starts) - 1
        rgb, transmittance = torch.zeros(viewport.height, viewport.width, 3), torch.zeros(40, 40)
        blended = torch.zeros(tiles, dtype=torch.int32)
        gpu_blend.blend[(tiles,)](
            pairs.tile_starts, pairs.owners, projection.records, 40, 40, settings.transmittance_min,
            rgb, transmittance, None, blended, DEPTH=False,
        )  # fmt: skip
        image = gpu.BlendedImage(rgb, transmittance, None, pairs, blended)
        upstream = normal(7, 40, 40, 3), normal(8, 40, 40)
        gpu._blend_backward(projection, image, viewport, settings, *upstream, rows, False)
        sums = rows.view(torch.float32)
        gpu_blend.sum_rows[(-(-LAST_ROWS // 8),)](
            sums, pairs.slot_starts, projection.counts, LAST_ROWS, ABSGRAD=False, BLOCK=8, SLOTS=16
        )
        used = gpu_project.SUM_BLUE.value + 1
        return rgb, transmittance, blended, sums[-count:, :used].clone()

    expected = blend_and_sum(few, torch.zeros(count, 6, dtype=torch.int64))
    found = blend_and_sum(many, lazy_zeros(gpu_bin.MAX_PAIRS, 6, dtype=torch.int64))
    assert count > 2 * LAST_ROWS and expected[0].max() > 0.1 and expected[3].abs().max() > 0.1
    for values, reference in zip(found, expected, strict=True):
        assert torch.equal(values, reference)


def test_features_that_lie_far_apart_are_decoded_with_gradients_as_in_a_small_call() -> None:
    feature_stride = 70_000_000  # The last of 32 features lies beyond 2^31 numbers.
    few = normal(0, 32, LAST_ROWS)
    many = lazy_zeros(32, feature_stride)
    many[:, :LAST_ROWS] = few
    weights = [0.2 * normal(1, 64, 32), 0.2 * normal(2, 64, 64), normal(3, 8, 64)]
    biases = [normal(4 + layer, len(weight)) for layer, weight in enumerate(weights)]
    results = []
    for rows in (many[:, :LAST_ROWS].T, few.T):
        leaves = [tensor.detach().requires_grad_() for tensor in (rows, *weights, *biases)]
        outputs = mlp(leaves[0], leaves[1:4], leaves[4:], implementation="gpu")
        results.append([outputs, *torch.autograd.grad(outputs.square().sum(), leaves)])
    for values, reference in zip(*results, strict=True):
        assert torch.equal(values, reference)


def test_the_last_pixels_of_a_picture_of_two_billion_numbers_have_the_loss_and_gradient_of_a_small_one() -> None:
    """Outside of the last programs both pictures are black, which is what lies outside of a small picture, too."""
    from hyrfpack.ops.ssim import gpu

    strips, blocks = 1120, 631
    height, width = strips * gpu._ROWS_PER_STRIP, (blocks * gpu._COLUMNS_PER_PROGRAM - 2) // 3
    assert 3 * width == blocks * gpu._COLUMNS_PER_PROGRAM - 2 and 3 * height * width > 2**31
    rows, columns = LAST_PROGRAMS * gpu._ROWS_PER_STRIP, (LAST_PROGRAMS * gpu._COLUMNS_PER_PROGRAM - 2) // 3
    image, target = normal(0, rows, columns, 3).sigmoid().requires_grad_(), normal(1, rows, columns, 3).sigmoid()
    expected = photometric_loss(image, target, implementation="gpu")
    expected.backward()
    many, many_target = lazy_zeros(height, width, 3), lazy_zeros(height, width, 3)
    many[-rows:, -columns:], many_target[-rows:, -columns:] = image.detach(), target
    many.requires_grad_()
    with run_last_programs():
        found = photometric_loss(many, many_target, implementation="gpu")
        (gradient,) = torch.autograd.grad(found, many)
    torch.testing.assert_close(found, expected, rtol=1e-5, atol=0)
    torch.testing.assert_close(gradient[-rows:, -columns:], image.grad, rtol=1e-5, atol=1e-9)
