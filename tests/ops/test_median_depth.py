"""Median depth: closed forms of planes, and the compiled kernel against the float64 reference."""

from __future__ import annotations

import pytest
import torch
from ops.test_blend_weights import SCENE_KINDS, VIEWPORT, make_scene

from hyrfpack.ops.rasterize import Gaussians3D, RasterSettings, rasterize
from hyrfpack.ops.rasterize.median_depth import median_depth

IMPLEMENTATION_NAMES = ["reference", "cpu"]


def in_float64(gaussians: Gaussians3D) -> Gaussians3D:
    return Gaussians3D(*(part.double() for part in gaussians))


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("kind", SCENE_KINDS)
def test_the_kernel_agrees_with_the_float64_reference(kind: str, antialiased: bool) -> None:
    gaussians, settings = make_scene(kind), RasterSettings(antialiased=antialiased)
    expected = median_depth(in_float64(gaussians), VIEWPORT, settings, implementation="reference")
    found = median_depth(gaussians, VIEWPORT, settings, implementation="cpu")
    assert (expected > 0).any()
    # Where the transmittance stops within rounding of 1/2, float32 may take the next Gaussian.
    agrees = torch.isclose(found.double(), expected, atol=1e-4, rtol=1e-4)
    assert agrees.float().mean() > 0.998


@pytest.mark.parametrize("implementation", IMPLEMENTATION_NAMES)
def test_a_tilted_disc_has_the_depth_of_its_plane(implementation: str) -> None:
    half_turn = torch.tensor(0.5)  # tilt of 1 radian about x
    disc = Gaussians3D(
        torch.tensor([[0.1, -0.2, 4.0]]),
        torch.tensor([[half_turn.cos(), half_turn.sin(), 0.0, 0.0]]),
        torch.tensor([[0.5, 0.5, 1e-4]]),
        torch.tensor([0.99]),
    )
    depth = median_depth(disc, VIEWPORT, implementation=implementation)
    # The plane through the centre with normal (0, -sin 1, cos 1); the affine projection is exact near the centre only.
    normal = torch.tensor([0.0, -(2 * half_turn).sin(), (2 * half_turn).cos()])
    rays = torch.stack(
        [
            (torch.arange(48) + 0.5 - 24).expand(40, 48) / 50,
            ((torch.arange(40) + 0.5 - 20) / 50)[:, None].expand(40, 48),
            torch.ones(40, 48),
        ],
        -1,
    )
    exact = (normal @ disc.means[0]) / (rays @ normal)
    near = (rays[..., :2] * 4 - disc.means[0, :2]).norm(dim=-1) < 0.16
    assert near.sum() > 8 and bool((depth[near] > 0).all())
    assert (depth - exact)[near].abs().max() < 0.03  # the centre's own depth would be wrong by up to 0.25


@pytest.mark.parametrize("implementation", IMPLEMENTATION_NAMES)
def test_a_faint_layer_in_front_does_not_move_the_depth(implementation: str) -> None:
    wide = torch.tensor([[1.0, 0.0, 0.0, 0.0]]).expand(2, 4), torch.full((2, 3), 1.0) * torch.tensor([1.0, 1.0, 1e-3])
    layers = Gaussians3D(torch.tensor([[0.0, 0.0, 2.0], [0.0, 0.0, 5.0]]), wide[0], wide[1], torch.tensor([0.3, 0.99]))
    depth = median_depth(layers, VIEWPORT, implementation=implementation)
    expected_depth = rasterize(layers, torch.zeros(2, 3), VIEWPORT, RasterSettings(depth=True)).depth
    assert depth[20, 24].item() == pytest.approx(5.0, abs=1e-3)
    assert expected_depth is not None and expected_depth[20, 24] < 4.2


@pytest.mark.parametrize("implementation", IMPLEMENTATION_NAMES)
def test_pixels_that_pass_more_than_half_of_the_light_have_no_depth(implementation: str) -> None:
    gaussians = make_scene("a cloud")
    faint = gaussians._replace(opacities=gaussians.opacities * 1e-3)
    assert not median_depth(faint, VIEWPORT, implementation=implementation).any()
    empty = gaussians.select(torch.zeros(0, dtype=torch.int64))
    assert not median_depth(empty, VIEWPORT, implementation=implementation).any()


def test_bytes_do_not_depend_on_the_number_of_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    gaussians, found = make_scene("a cloud", 3000), set()
    for threads in (1, 2, 5):
        monkeypatch.setenv("HYRFPACK_THREADS", str(threads))
        found.add(median_depth(gaussians, VIEWPORT).numpy().tobytes())
    assert len(found) == 1
