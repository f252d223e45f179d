"""Fusion of analytic depth maps: the surface lies within a fraction of a voxel of the true one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scenes import look_at

from hyrfpack.errors import HyrfError
from hyrfpack.mesh import fusion
from hyrfpack.mesh.bounds import Grid, choose_grid
from hyrfpack.mesh.clean import reduce_faces, remove_small_components
from hyrfpack.mesh.depth_maps import DepthMap, make_depth_map
from hyrfpack.mesh.fusion import choose_truncation, extract_surface, find_blocks
from hyrfpack.mesh.kernels import MapArrays
from hyrfpack.scene import Camera

VOXEL_SIDE = 0.05


def camera_at(position: tuple[float, float, float]) -> Camera:
    return Camera(160, 120, 150.0, 150.0, 80.0, 60.0, look_at(np.array(position), np.zeros(3)))


def rays_of(camera: Camera) -> np.ndarray:
    """Return rays (H, W, 3) in world axes whose length along the view axis is 1."""
    x, y = np.meshgrid(np.arange(camera.width) + 0.5 - camera.cx, np.arange(camera.height) + 0.5 - camera.cy)
    return np.stack((x / camera.fx, y / camera.fy, np.ones(x.shape)), axis=-1) @ camera.rotation


def sphere_map(position: tuple[float, float, float], noise: float = 0.0) -> DepthMap:
    """Return the depth map of a unit sphere about the origin, before nothing."""
    camera = camera_at(position)
    rays = rays_of(camera)
    a, b, c = (rays**2).sum(-1), rays @ camera.position, camera.position @ camera.position - 1
    root = b * b - a * c
    depth = np.where(root > 0, (-b - np.sqrt(np.maximum(root, 0))) / a, 0)
    generator = np.random.default_rng(int(1000 + 7 * position[0] + 31 * position[1] + 113 * position[2]))
    clean = make_depth_map(camera, depth, (depth > 0).astype(np.float32), np.full((*depth.shape, 3), 99, np.uint8))
    return replace(clean, depth=(clean.depth + noise * generator.normal(size=depth.shape)).astype(np.float32))


def plane_map(position: tuple[float, float, float]) -> DepthMap:
    """Return the depth map of the plane z = 0."""
    camera = camera_at(position)
    depth = np.maximum(-camera.position[2] / rays_of(camera)[..., 2], 0)
    return make_depth_map(camera, depth, np.ones_like(depth, np.float32), np.zeros((*depth.shape, 3), np.uint8))


CAMERA_POSITIONS_ON_AXES = [(4, 0, 0), (-4, 0, 0.1), (0, 4, 0), (0.1, -4, 0), (0, 0.1, 4), (0.1, 0, -4)]
CAMERA_POSITIONS_AT_CORNERS = [tuple(2.3 * (2 * bit - 1) for bit in bits) for bits in np.ndindex(2, 2, 2)]


def fuse(maps: list[DepthMap], grid: Grid, truncation: float = 4 * VOXEL_SIDE) -> tuple[np.ndarray, np.ndarray]:
    return extract_surface(MapArrays.pack(maps), grid, find_blocks(maps, grid), truncation, min_weight=100)


def normals_of(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    corners = vertices[faces]
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def test_a_sphere_is_closed_and_lies_within_a_fifth_of_a_voxel():
    maps = [sphere_map(position) for position in (*CAMERA_POSITIONS_ON_AXES, *CAMERA_POSITIONS_AT_CORNERS)]
    vertices, faces = fuse(maps, Grid(np.full(3, -1.33), VOXEL_SIDE, (54, 54, 54)))
    away = np.abs(np.linalg.norm(vertices, axis=1) - 1)
    assert away.mean() < 0.05 * VOXEL_SIDE and away.max() < 0.2 * VOXEL_SIDE
    assert (normals_of(vertices, faces) * vertices[faces].mean(axis=1)).sum(axis=1).min() > -1e-6
    edges = np.sort(np.concatenate((faces[:, :2], faces[:, 1:], faces[:, [2, 0]])), axis=1)
    _, counts = np.unique(edges, axis=0, return_counts=True)
    assert (counts == 2).all()  # the seams between blocks are closed


def test_a_plane_seen_at_a_slant_lies_within_a_twentieth_of_a_voxel():
    maps = [plane_map(position) for position in ((2, 0, 3), (-2, 1, 3), (0, -3, 2))]
    vertices, faces = fuse(maps, Grid(np.array([-0.7, -0.7, -0.41]), VOXEL_SIDE, (28, 28, 16)))
    assert len(faces) > 1000
    assert np.abs(vertices[:, 2]).max() < 0.05 * VOXEL_SIDE
    assert normals_of(vertices, faces)[:, 2].min() > 0


def test_noise_of_depth_is_estimated_and_averaged_out():
    maps = [sphere_map(position, noise=0.03) for position in (*CAMERA_POSITIONS_ON_AXES, *CAMERA_POSITIONS_AT_CORNERS)]
    grid = Grid(np.full(3, -1.33), VOXEL_SIDE, (54, 54, 54))
    # The noise lies along the view axes, which are oblique to the surface.
    assert 0.5 * 0.03 < fusion.estimate_depth_noise(maps, grid, 8 * VOXEL_SIDE) < 0.03
    truncation = choose_truncation(maps, grid)
    assert 3 * VOXEL_SIDE <= truncation <= 8 * VOXEL_SIDE
    vertices, faces = remove_small_components(*fuse(maps, grid, truncation))
    assert np.abs(np.linalg.norm(vertices, axis=1) - 1).mean() < 0.03 / 2


def test_space_that_a_camera_sees_to_be_empty_is_carved():
    clean = [sphere_map(position) for position in (*CAMERA_POSITIONS_ON_AXES, *CAMERA_POSITIONS_AT_CORNERS)]
    floating = sphere_map((4, 0, 0))
    floating.depth[:20, :20], floating.weight[:20, :20] = 2.5, 255  # one camera sees something in front of itself
    grid = Grid(np.array([-1.33, -1.33, -1.33]), VOXEL_SIDE, (80, 80, 80))
    vertices, _ = fuse([*clean, floating], grid)
    assert np.abs(np.linalg.norm(vertices, axis=1) - 1).max() < 0.5 * VOXEL_SIDE


def test_jumps_of_single_pixels_are_filtered_out():
    clean, camera = sphere_map((4, 0, 0)), camera_at((4, 0, 0))
    depth = np.where(np.isfinite(clean.depth), clean.depth, 0)
    jumping = depth.copy()
    jumping[60, 80] += 0.5
    opaque = (depth > 0).astype(np.float32)
    filtered = make_depth_map(camera, jumping, opaque, clean.colors)
    assert filtered.depth[60, 80] == pytest.approx(depth[60, 80], abs=0.01) and filtered.weight[60, 80] > 250


def test_pixels_at_depth_edges_and_grazing_pixels_have_no_weight():
    sphere = sphere_map((4, 0, 0))
    hit = (sphere.depth > 0) & np.isfinite(sphere.depth)
    rim = hit & ~(np.roll(hit, 1, 0) & np.roll(hit, -1, 0) & np.roll(hit, 1, 1) & np.roll(hit, -1, 1))
    assert rim.any() and not sphere.weight[rim].any()
    assert sphere.weight[60, 80] > 250


@pytest.mark.parametrize("voxel", [1e308, 1e30, 1.5])
def test_a_voxel_that_holds_the_whole_surface_is_a_clear_error(voxel):
    maps = [sphere_map(position) for position in ((4, 0, 0), (-4, 0, 0), (0, 4, 0))]
    with pytest.raises(
        HyrfError, match=r"a voxel of \S+ is too large for a surface of .* units.*use a smaller `voxel`"
    ):
        choose_grid(maps, np.zeros(3), None, voxel)


def test_voxels_that_are_too_small_are_refused_with_the_memory_that_they_would_need(monkeypatch):
    maps = [sphere_map(position) for position in CAMERA_POSITIONS_ON_AXES]
    monkeypatch.setattr(fusion, "memory_bytes", lambda: 10_000_000)
    with pytest.raises(HyrfError, match=r"would take more than 0\.\d GB, and this machine has 0\.0 GB"):
        find_blocks(maps, Grid(np.full(3, -1.33), 0.01, (266, 266, 266)))
    with pytest.raises(HyrfError, match=r"voxels along a side, which would take about [\d,]+ GB"):
        choose_grid(maps, np.zeros(3), None, 1e-5)


def test_the_default_box_holds_what_cameras_see_near_the_centre():
    grid = choose_grid(
        [sphere_map(position) for position in (*CAMERA_POSITIONS_ON_AXES, *CAMERA_POSITIONS_AT_CORNERS)],
        np.zeros(3),
        None,
        None,
    )
    high = grid.low + grid.voxel * np.array(grid.shape)
    assert np.abs(grid.low + 1).max() < 0.1 and np.abs(high - 1).max() < 0.1
    assert grid.voxel == pytest.approx(1.5 * 3.2 / 150, rel=0.1)  # 1.5 pixels on the sphere, seen from 4 units


def test_a_box_without_a_surface_is_refused():
    with pytest.raises(HyrfError, match=r"no camera sees a surface in the box; .* move or widen `crop`"):
        choose_grid([sphere_map((4, 0, 0))], np.zeros(3), (5, 5, 5, 6, 6, 6), None)


def test_small_components_are_removed_and_reduction_keeps_the_shape():
    maps = [sphere_map(position) for position in (*CAMERA_POSITIONS_ON_AXES, *CAMERA_POSITIONS_AT_CORNERS)]
    vertices, faces = fuse(maps, Grid(np.full(3, -1.33), VOXEL_SIDE, (54, 54, 54)))
    speck = np.array([[3, 3, 3], [3.01, 3, 3], [3, 3.01, 3]])
    joined = np.concatenate((vertices, speck)), np.concatenate((faces, [[len(vertices) + i for i in range(3)]]))
    kept = remove_small_components(*joined)
    assert len(kept[0]) == len(vertices) and len(kept[1]) == len(faces)
    reduced_vertices, reduced_faces = reduce_faces(vertices, faces, 1000)
    assert 900 <= len(reduced_faces) <= 1000
    assert np.abs(np.linalg.norm(reduced_vertices, axis=1) - 1).max() < VOXEL_SIDE


@pytest.mark.parametrize("seed", range(3))
def test_blocks_are_those_within_the_margin_of_a_point(seed):
    generator = np.random.default_rng(seed)
    shape = np.array([4, 3, 5])
    # Also points on the borders of blocks and of margins, outside of the grid, and far away.
    places = np.concatenate((generator.uniform(-1.2, 6, (300, 3)), generator.integers(-1, 6, (60, 3)), [[1e9] * 3]))
    places[:40] += fusion.BLOCK_MARGIN_VOXELS / fusion.BLOCK_VOXELS - places[:40] % 1

    found = fusion.find_blocks_near(places, shape)

    margin = fusion.BLOCK_MARGIN_VOXELS / fusion.BLOCK_VOXELS
    expected = set()
    for signs in np.ndindex(2, 2, 2):
        for block in np.floor(places + margin * (2 * np.array(signs) - 1)).astype(int).tolist():
            if all(0 <= number < most for number, most in zip(block, shape, strict=True)):
                expected.add(tuple(block))
    assert sorted(map(tuple, found.tolist())) == sorted(expected) and len(expected) > 20
