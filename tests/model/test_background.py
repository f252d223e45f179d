from __future__ import annotations

import numpy as np
import pytest
import torch
from scenes import look_at

from hyrfpack.model.background import RADIUS, pixel_directions, sphere_points


def random_directions(count: int) -> torch.Tensor:
    vectors = torch.randn(count, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    return torch.nn.functional.normalize(vectors, dim=1)


@pytest.mark.parametrize("origin", [(0, 0, 0), (3, -1, 2), (60, 60, 40), (0, 0, -99.999)])
def test_sphere_points_lie_on_the_sphere_ahead_of_the_camera(origin):
    origin, directions = torch.tensor(origin, dtype=torch.float64), random_directions(500)

    points = sphere_points(origin, directions)

    torch.testing.assert_close(torch.linalg.vector_norm(points, dim=1), torch.full((500,), RADIUS).double())
    steps = points - origin
    lengths = torch.linalg.vector_norm(steps, dim=1, keepdim=True)
    torch.testing.assert_close(steps, lengths * directions, rtol=1e-9, atol=1e-9)


def test_sphere_points_of_float32_cameras_are_on_the_sphere():
    points = sphere_points(torch.tensor([1.0, 2.0, -0.5]), random_directions(500).float())
    torch.testing.assert_close(torch.linalg.vector_norm(points, dim=1), torch.full((500,), RADIUS), rtol=1e-6, atol=0)


def test_sphere_points_from_outside_are_where_the_ray_leaves():
    points = sphere_points(torch.tensor([0.0, 0.0, -250.0]), torch.tensor([[0.0, 0.0, 1.0]]))
    torch.testing.assert_close(points, torch.tensor([[0.0, 0.0, RADIUS]]))


def test_sphere_points_of_a_ray_that_misses_are_nearest_to_the_centre():
    origin = torch.tensor([0.0, 150.0, -300.0], dtype=torch.float64)
    points = sphere_points(origin, torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64))
    torch.testing.assert_close(points, torch.tensor([[0.0, 150.0, 0.0]], dtype=torch.float64))


@pytest.mark.parametrize("distance", [1e3, 1e6, 1e12])
def test_sphere_points_are_finite_however_far_outside(distance):
    points = sphere_points(torch.tensor([distance, -distance, 0.0]), random_directions(500).float())
    assert torch.isfinite(points).all()


def test_pixel_directions_project_back_to_their_points():
    width, height, intrinsics = 7, 5, (11.0, 9.0, 3.2, 2.9)
    pose = torch.from_numpy(look_at((1.0, 2.0, 0.5), (0.3, -1.0, 0.2)))
    fx, fy, cx, cy = intrinsics

    generator = torch.Generator().manual_seed(0)
    points = torch.rand(50, 2, dtype=torch.float64, generator=generator) * torch.tensor([width, height])

    directions = pixel_directions(points, intrinsics, pose)

    x, y, z = (directions @ pose[:3, :3].T).unbind(1)
    np.testing.assert_allclose((fx * x / z + cx).numpy(), points[:, 0].numpy(), atol=1e-12)
    np.testing.assert_allclose((fy * y / z + cy).numpy(), points[:, 1].numpy(), atol=1e-12)
    assert (z > 0).all()
    np.testing.assert_allclose(torch.linalg.vector_norm(directions, dim=1).numpy(), 1, atol=1e-12)
