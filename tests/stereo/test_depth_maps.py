"""hyrfpack.stereo: depths of known planes, sources, agreement, and photos for which there is no depth."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from textured_planes import camera_at, depths_of_planes, photograph

from hyrfpack.stereo import StereoPhoto, count_agreeing_sources, estimate_depth_maps
from hyrfpack.stereo.depth_maps import PLANE_COUNT
from hyrfpack.stereo.sources import MAX_SOURCES, choose_sources
from hyrfpack.train.surface_depths import MIN_AGREEING_PHOTOS

WALL_PLANE = (4.0, 0.0, -np.inf, np.inf)
SLANTED_PLANE = (4.0, 0.4, -np.inf, np.inf)
BOARD_PLANE = (2.5, 0.0, -0.4, 0.4)
CAMERA_PLACES = [(0.0, 0.0), (0.35, 0.05), (-0.35, 0.0), (0.1, 0.35), (0.0, -0.35)]
PLANE_CAMERAS = [camera_at(*place) for place in CAMERA_PLACES]


def points_on(planes, camera=PLANE_CAMERAS[0], count: int = 60) -> np.ndarray:
    """Return points (N, 3) on the planes at random pixels of a camera."""
    depth, _ = depths_of_planes(camera, planes)
    generator = np.random.default_rng(0)
    row, column = generator.integers(0, camera.height, count), generator.integers(0, camera.width, count)
    return camera.unproject(column + 0.5, row + 0.5, depth[row, column])


def photos_of(planes) -> tuple[list[StereoPhoto], np.ndarray]:
    points = points_on(planes)
    return [photograph(camera, planes, points) for camera in PLANE_CAMERAS], points


@pytest.mark.parametrize(
    "planes", [[WALL_PLANE], [SLANTED_PLANE], [WALL_PLANE, BOARD_PLANE]], ids=["wall", "slanted", "board"]
)
@pytest.mark.parametrize("agreeing", [MIN_AGREEING_PHOTOS, 2])
@pytest.mark.parametrize("unit", [1.0, 1e-4, 1e5])
def test_depths_are_those_of_the_planes_in_any_unit(planes, unit, agreeing):
    photos, points = photos_of(planes)
    truth, _ = depths_of_planes(PLANE_CAMERAS[0], planes)
    scaled = []
    for photo in photos:
        pose = photo.camera.camera_from_world.copy()
        pose[:3, 3] *= unit
        scaled.append(dataclasses.replace(photo, camera=dataclasses.replace(photo.camera, camera_from_world=pose)))
    maps = estimate_depth_maps(scaled, unit * points)
    agreed = count_agreeing_sources(maps, 0) >= agreeing
    errors = np.abs(maps[0].inverse_depths - 1 / (unit * truth)) / maps[0].spacing
    assert agreed.mean() > 0.75
    assert np.quantile(errors[agreed], 0.9) < 1 and np.median(errors[agreed]) < 0.4


def test_exposure_does_not_change_depths():
    photos, points = photos_of([WALL_PLANE, BOARD_PLANE])
    darker = [dataclasses.replace(photo, grey=photo.grey * np.float32(0.4 + 0.1 * i)) for i, photo in enumerate(photos)]
    usual, changed = (estimate_depth_maps(some, points)[0] for some in (photos, darker))
    assert (np.abs(usual.inverse_depths - changed.inverse_depths) < usual.spacing).mean() > 0.95


def test_fewer_photos_agree_about_an_object_that_moves():
    """The board stands elsewhere in each photo."""
    planes = [[WALL_PLANE, (2.5, 0.0, -0.4 + shift, 0.4 + shift)] for shift in (0.0, 0.9, -0.9, 0.9, -0.9)]
    points = points_on([WALL_PLANE])
    photos = [photograph(camera, shown, points) for camera, shown in zip(PLANE_CAMERAS, planes, strict=True)]
    agreed = count_agreeing_sources(estimate_depth_maps(photos, points), 0) >= 2
    depth, _ = depths_of_planes(PLANE_CAMERAS[0], planes[0])
    board = np.zeros_like(agreed)
    board[4:-4, 4:-4] = (depth < 3)[4:-4, 4:-4]
    assert agreed[board].mean() < 0.5 * agreed[~board].mean()


def test_photos_of_one_place_give_no_depth():
    camera = PLANE_CAMERAS[0]
    points = points_on([WALL_PLANE])
    photos = [photograph(camera, [WALL_PLANE], points)] * 3
    assert estimate_depth_maps(photos, points) == [None] * 3


def test_photos_that_share_no_points_have_no_depth_map():
    photos, points = photos_of([WALL_PLANE])
    photos[0] = dataclasses.replace(photos[0], points=np.zeros(0, np.int64))
    maps = estimate_depth_maps(photos, points)
    assert maps[0] is None and all(found is not None for found in maps[1:])
    assert count_agreeing_sources(maps, 1).max() <= MAX_SOURCES - 1
    assert estimate_depth_maps(photos[:1], points) == [None]
    assert estimate_depth_maps([], points) == []


def test_depth_maps_are_finite_and_within_their_planes():
    generator = np.random.default_rng(0)
    _, points = photos_of([WALL_PLANE])
    usable, everything = np.ones((48, 64), bool), np.arange(len(points))
    photos = [
        StereoPhoto(camera, generator.random((48, 64), np.float32), usable, everything) for camera in PLANE_CAMERAS
    ]
    for depth_map in estimate_depth_maps(photos, points):
        assert depth_map.inverse_depths.dtype == np.float64 and np.isfinite(depth_map.inverse_depths).all()
        assert depth_map.inverse_depths.min() >= 0 and depth_map.inverse_depths.max() <= PLANE_COUNT * depth_map.spacing


def test_sources_share_points_and_see_them_from_about_five_degrees():
    points = points_on([WALL_PLANE])
    cameras = [camera_at(x) for x in (0.0, 0.01, 0.35, 0.5, -0.35, 2.0, -3.0)]
    everything = np.arange(len(points))
    seen = [everything] * 6 + [everything[:4]]
    sources = choose_sources(cameras, points, seen)
    assert set(sources[0][:3]) == {2, 3, 4} and 1 not in sources[0] and 6 not in sources[0]
    assert sources[6] == []
    assert all(len(found) <= MAX_SOURCES for found in sources)


def test_unusable_pixels_confirm_no_depth():
    photos, points = photos_of([WALL_PLANE])
    masked = [dataclasses.replace(photo, usable=np.zeros_like(photo.usable)) for photo in photos[1:]]
    assert count_agreeing_sources(estimate_depth_maps(photos, points), 0).max() > 0
    assert count_agreeing_sources(estimate_depth_maps([photos[0], *masked], points), 0).max() == 0


@pytest.mark.parametrize("depth", [1e-300, 1e-30])
def test_points_in_a_camera_do_no_harm(depth):
    """Then all planes are far too near, and products overflow."""
    photos, points = photos_of([WALL_PLANE])
    points[:, 2] = depth
    maps = estimate_depth_maps(photos, points)
    assert any(maps)
    for index, depth_map in enumerate(maps):
        if depth_map is not None:
            assert np.isfinite(depth_map.inverse_depths).all() and count_agreeing_sources(maps, index).shape == (48, 64)


@pytest.mark.parametrize("depth", [1e30, 1e100])
def test_points_that_are_very_far_away_have_no_parallax(depth):
    photos, points = photos_of([WALL_PLANE])
    points[:, 2] = depth
    assert not any(estimate_depth_maps(photos, points))
