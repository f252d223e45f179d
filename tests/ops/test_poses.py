"""Poses, rays and culling are exact in float32, whatever precision a user gives torch's matrix products."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from hyrfpack.ops.background.reference import pixel_directions, sphere_points
from hyrfpack.ops.poses import camera_center, rotate
from hyrfpack.ops.rasterize.cull import frustum_cull

PRODUCTS = {"mm", "mv", "bmm", "addmm", "addmv", "baddbmm", "dot", "vdot", "_scaled_mm", "linear"}
LENS = (50.0, 60.0, 32.0, 24.0)


class Rounded(TorchDispatchMode):
    """Matrix products as TF32 makes them: their factors keep 11 bits."""

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        if func.overloadpacket.__name__ in PRODUCTS:
            args = [_rounded(arg) if isinstance(arg, torch.Tensor) else arg for arg in args]
        return func(*args, **(kwargs or {}))


def _rounded(tensor: torch.Tensor) -> torch.Tensor:
    fractions, exponents = torch.frexp(tensor)
    return torch.ldexp(torch.round(fractions * 2048) / 2048, exponents)


def a_pose() -> torch.Tensor:
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(0)).double())[0]
    pose[:3, 3] = torch.tensor([0.3, -1.7, 5.1])
    return pose


def points(count: int, size: float = 1.0) -> torch.Tensor:
    return size * torch.randn(count, 3, generator=torch.Generator().manual_seed(1)).double()


WAYS: dict[str, Callable[[torch.dtype], torch.Tensor]] = {
    "viewpoint": lambda kind: camera_center(a_pose().to(kind)),
    "rotation": lambda kind: rotate(points(50).to(kind), a_pose()[:3, :3].to(kind)),
    "rays": lambda kind: pixel_directions(30 * points(50)[:, :2].to(kind), LENS, a_pose().to(kind)),
    "places on the sphere": lambda kind: sphere_points(
        camera_center(a_pose().to(kind)), torch.nn.functional.normalize(points(50).to(kind), dim=-1)
    ),
}


@pytest.mark.parametrize("name", WAYS)
def test_rounded_matrix_products_move_nothing(name):
    wanted = WAYS[name](torch.float64)
    with Rounded():
        found = WAYS[name](torch.float32)
    torch.testing.assert_close(found.double(), wanted, rtol=2e-6, atol=2e-6)


def test_rounded_matrix_products_cull_nothing_else():
    view = a_pose().float(), LENS, 64, 48, 0.01, 0.3
    wanted = frustum_cull(points(20_000, 3.0).float(), *view)
    with Rounded():
        assert torch.equal(frustum_cull(points(20_000, 3.0).float(), *view), wanted)
    assert 0 < len(wanted) < 20_000


def test_rounding_would_be_seen():
    turn = a_pose().float()[:3, :3]
    with Rounded():
        rounded = points(50).float() @ turn.T
    assert (rounded - rotate(points(50).float(), turn)).abs().max() > 1e-4


def test_a_rotation_and_a_centre_are_those_of_numpy():
    pose = a_pose().numpy()
    np.testing.assert_allclose(rotate(points(9), a_pose()[:3, :3]), points(9).numpy() @ pose[:3, :3].T, atol=1e-14)
    np.testing.assert_allclose(camera_center(a_pose()), np.linalg.inv(pose)[:3, 3], atol=1e-14)
