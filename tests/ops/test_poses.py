from __future__ import annotations

import pytest
import torch

from hyrfpack.ops.poses import camera_center

DEVICE_NAMES = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]


@pytest.fixture(params=["highest", "high"])
def precision(request):
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision(request.param)
    yield
    torch.set_float32_matmul_precision(before)


@pytest.mark.usefixtures("precision")
@pytest.mark.parametrize("device", DEVICE_NAMES)
def test_a_camera_position_is_exact_for_any_matmul_precision(device):
    generator = torch.Generator().manual_seed(0)
    for distance in (1e-3, 1.0, 1e4):
        rotation, _ = torch.linalg.qr(torch.randn(3, 3, generator=generator, dtype=torch.float64))
        there = distance * torch.randn(3, generator=generator, dtype=torch.float64)
        pose = torch.eye(4, dtype=torch.float64)
        pose[:3, :3], pose[:3, 3] = rotation, -rotation @ there
        found = camera_center(pose.float().to(device)).cpu().double()
        torch.testing.assert_close(found, there, rtol=0, atol=1e-6 * distance)
