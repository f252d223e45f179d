"""frustum_cull: every implementation against plain float64 arithmetic."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from ops.device import IS_INTERPRETED, gpu, needs_triton
from scenes import look_at

from hyrfpack.ops.rasterize.cull import frustum_cull
from hyrfpack.ops.viewport import Viewport

PICTURE_WIDTH = 64
PICTURE_HEIGHT = 40
CAMERA_INTRINSICS = (50.0, 60.0, 20.0, 25.0)
TESTED_IMPLEMENTATIONS = ["reference", "cpu", pytest.param("gpu", marks=needs_triton)]
CAMERA_POSE = look_at((0.0, -3.0, 0.0), (0.0, 0.0, 0.0))
# Relative widths of the band in which rounding decides. The kernels work in float64.
UNDECIDED_RATIO = {"reference": 1e-4, "cpu": 1e-12, "gpu": 1e-12}
# The warning is numpy's, in the interpreter.
IGNORE_INVALID_PRODUCT_WARNING = pytest.mark.filterwarnings("ignore:invalid value encountered in multiply")
POINT_AHEAD = (0.0, -2.0, 0.0)
POINT_BEHIND = (0.0, -4.0, 0.0)


def make_viewport(pose: torch.Tensor) -> Viewport:
    return Viewport(pose, CAMERA_INTRINSICS, PICTURE_WIDTH, PICTURE_HEIGHT)


def cull(points, pose=CAMERA_POSE, implementation="reference", *, near=0.01, tolerance=0.3) -> torch.Tensor:
    positions = torch.as_tensor(np.asarray(points), dtype=torch.float32).reshape(-1, 3)
    positions = gpu(positions) if implementation == "gpu" else positions
    viewport = make_viewport(torch.from_numpy(pose))
    index = frustum_cull(positions, viewport, near, tolerance, implementation=implementation)
    assert index.dtype == torch.int64 and index.ndim == 1 and index.device == positions.device
    return index.cpu()


def in_view(points, pose, near: float, tolerance: float, undecided: float) -> tuple[set[int], set[int]]:
    """Return the indices of points inside, and of points too close to an edge to decide, computed in float64."""
    fx, fy, cx, cy = CAMERA_INTRINSICS
    kept, unsure = set(), set()
    for i, point in enumerate(np.asarray(points, np.float32).astype(np.float64)):
        x, y, z = pose[:3, :3] @ point + pose[:3, 3]
        if abs(z - near) < undecided:
            unsure.add(i)
        elif z > near:
            # Distances from the middle of the picture in units of half its size: the picture is [-1, 1].
            across = (fx * x / z + cx - PICTURE_WIDTH / 2) / (PICTURE_WIDTH / 2)
            down = (fy * y / z + cy - PICTURE_HEIGHT / 2) / (PICTURE_HEIGHT / 2)
            excess = max(abs(across), abs(down)) - (1 + tolerance)
            if abs(excess) < undecided:
                unsure.add(i)
            elif excess < 0:
                kept.add(i)
    return kept, unsure


@pytest.mark.parametrize("implementation", TESTED_IMPLEMENTATIONS)
@pytest.mark.parametrize("tolerance", [0.0, 0.3, 2.0])
@pytest.mark.parametrize("near", [0.01, 1.0])
def test_cull_keeps_what_projects_into_the_widened_picture(near, tolerance, implementation):
    pose = look_at((1.0, -2.0, 0.5), (0.0, 0.0, 0.0))
    count = 900 if implementation == "gpu" and IS_INTERPRETED else 5000
    points = np.random.default_rng(0).normal(size=(count, 3)) * 3
    kept, unsure = in_view(points, pose, near, tolerance, UNDECIDED_RATIO[implementation])

    index = cull(points, pose, implementation, near=near, tolerance=tolerance)

    assert count // 50 < len(kept) < count and len(unsure) < 20
    assert set(index.tolist()) - unsure == kept - unsure
    assert (index.diff() > 0).all()


@pytest.mark.parametrize("implementation", TESTED_IMPLEMENTATIONS)
@pytest.mark.parametrize("count", [1, 2, 127, 128, 129])
def test_cull_of_any_number_of_points(count, implementation):
    points = np.random.default_rng(count).normal(size=(count, 3))
    kept, unsure = in_view(points, CAMERA_POSE, 0.01, 0.3, UNDECIDED_RATIO[implementation])
    assert not unsure
    assert cull(points, implementation=implementation).tolist() == sorted(kept)


@pytest.mark.parametrize("implementation", TESTED_IMPLEMENTATIONS)
@pytest.mark.parametrize("count", [1, 130])
def test_cull_keeps_all_or_none(count, implementation):
    assert cull([POINT_AHEAD] * count, implementation=implementation).tolist() == list(range(count))
    assert cull([POINT_BEHIND] * count, implementation=implementation).tolist() == []


@pytest.mark.parametrize("implementation", TESTED_IMPLEMENTATIONS)
@pytest.mark.parametrize("place", [0, 127, 128, 129])
def test_cull_finds_the_only_point_inside(place, implementation):
    points = np.array([POINT_BEHIND] * 130)
    points[place] = POINT_AHEAD
    assert cull(points, implementation=implementation).tolist() == [place]


@pytest.mark.parametrize("implementation", TESTED_IMPLEMENTATIONS)
def test_cull_of_no_points_is_empty(implementation):
    assert cull(np.zeros((0, 3)), np.eye(4), implementation).shape == (0,)


@pytest.mark.parametrize("implementation", TESTED_IMPLEMENTATIONS)
def test_cull_drops_points_at_the_camera_and_behind_it(implementation):
    points = [[0, -3, 0], [0, -4, 0], [0, -1e6, 0], [0, -2, 0]]
    assert cull(points, implementation=implementation).tolist() == [3]


@pytest.mark.parametrize("implementation", TESTED_IMPLEMENTATIONS)
def test_points_on_the_near_plane_are_culled(implementation):
    points = [[0, 0, 0.5], [0, 0, 0.50001], [0, 0, 0.49999]]
    assert cull(points, np.eye(4), implementation, near=0.5).tolist() == [1]


@pytest.mark.parametrize("implementation", [name for name in TESTED_IMPLEMENTATIONS if name != "reference"])
def test_kernels_use_a_float64_pose_at_full_precision(implementation):
    """A rotation by 1e-9, which float32 cannot represent, decides about a point just outside the picture."""
    width, angle = 64 / 2 * 1.3, 1e-9
    turned = np.eye(4)
    turned[:3, :3] = [[np.cos(angle), 0, -np.sin(angle)], [0, 1, 0], [np.sin(angle), 0, np.cos(angle)]]
    lens = (width, 60.0, 32.0, 25.0)  # the edge of the band is at x = z
    point = torch.tensor([[1.0, 0, 1]])
    point = gpu(point) if implementation == "gpu" else point
    kept = [
        frustum_cull(point, viewport, 0.01, 0.3, implementation=implementation).tolist()
        for viewport in (Viewport(torch.from_numpy(pose), lens, 64, 40) for pose in (turned, turned.T.copy()))
    ]
    assert kept == [[0], []]


@pytest.mark.parametrize("threads", ["1", "3"])
def test_many_points_are_listed_in_order_on_any_number_of_threads(threads, monkeypatch):
    monkeypatch.setenv("HYRFPACK_THREADS", threads)
    points = np.random.default_rng(5).normal(size=(200_000, 3)) * 3
    kept, unsure = in_view(points, CAMERA_POSE, 0.01, 0.3, UNDECIDED_RATIO["cpu"])
    assert not unsure
    assert cull(points, implementation="cpu").tolist() == sorted(kept)
    points[-1, 2] = np.nan
    with pytest.raises(FloatingPointError):
        cull(points, implementation="cpu")


@pytest.mark.parametrize("implementation", TESTED_IMPLEMENTATIONS)
def test_an_infinite_band_keeps_all_points_in_front_of_the_camera(implementation):
    points = [POINT_AHEAD, POINT_BEHIND, (1e6, -2.0, 0.0), (0.0, -2.9, -1e6)]
    assert cull(points, implementation=implementation, tolerance=np.inf).tolist() == [0, 2, 3]


@IGNORE_INVALID_PRODUCT_WARNING
@pytest.mark.parametrize("implementation", TESTED_IMPLEMENTATIONS)
@pytest.mark.parametrize("place", [0, 128, 129])
@pytest.mark.parametrize("number", [np.nan, np.inf, -np.inf])
def test_cull_rejects_points_that_are_not_finite(number, place, implementation):
    for axis in range(3):
        points = np.array([POINT_AHEAD] * 130)
        points[place, axis] = number
        with pytest.raises(FloatingPointError, match="positions hold NaN or infinity"):
            cull(points, implementation=implementation)
    points[:] = POINT_BEHIND
    points[place, 0] = number
    with pytest.raises(FloatingPointError):
        cull(points, implementation=implementation)


@IGNORE_INVALID_PRODUCT_WARNING
@pytest.mark.parametrize("implementation", TESTED_IMPLEMENTATIONS)
@pytest.mark.parametrize("number", [np.nan, np.inf])
def test_cull_rejects_the_only_point(number, implementation):
    with pytest.raises(FloatingPointError):
        cull([[0, 0, number]], implementation=implementation)


@pytest.mark.parametrize("implementation", TESTED_IMPLEMENTATIONS)
def test_the_largest_float32_values_are_supported(implementation):
    largest = np.finfo(np.float32).max
    points = [[largest, 0, 0], [0, -largest, 0], [0, 0, largest], [-largest, -largest, -largest], POINT_AHEAD]
    assert cull(points, implementation=implementation).tolist() == [4]


@pytest.mark.parametrize("implementation", TESTED_IMPLEMENTATIONS)
def test_layouts_and_gradients_of_positions_have_no_effect(implementation):
    points = torch.from_numpy(np.random.default_rng(1).normal(size=(60, 3))).float()
    points = gpu(points) if implementation == "gpu" else points
    rest = make_viewport(torch.from_numpy(CAMERA_POSE).float()), 0.01, 0.3
    expected = frustum_cull(points, *rest, implementation=implementation)
    assert 0 < len(expected) < 60
    for other in (points.T.contiguous().T, points.repeat_interleave(2, 0)[::2], points.clone().requires_grad_()):
        assert torch.equal(frustum_cull(other, *rest, implementation=implementation), expected)


def test_unknown_types_and_implementations_are_rejected():
    rest = make_viewport(torch.eye(4)), 0.01, 0.3
    with pytest.raises(ValueError, match="float32"):
        frustum_cull(torch.zeros(2, 3).double(), *rest, implementation="gpu")
    with pytest.raises(ValueError, match="float32"):
        frustum_cull(torch.zeros(2, 3).double(), *rest, implementation="cpu")
    with pytest.raises(ValueError, match="no implementation 'fast'"):
        frustum_cull(torch.zeros(2, 3), *rest, implementation="fast")
