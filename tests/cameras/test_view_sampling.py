from __future__ import annotations

import numpy as np
import pytest
import torch
from scenes import ball_points, camera_at, ring, small_model

from hyrfpack.cameras.view_sampling import (
    INTERPOLATED_VIEW_SIZE_RATIO,
    MAX_SMALL_VIEW_SIDE_PIXELS,
    divide_view,
    interpolate_views,
    resize_camera,
    sample_views,
    sample_windows,
    shrink_camera,
)
from hyrfpack.render import RenderSettings, render_view
from hyrfpack.scene import Camera

RING_CAMERAS = ring(48, elevation=1.2, width=16, height=16)


def test_intermediate_views_lie_between_neighbours_with_similar_directions():
    """On this ring a neighbour is at most two places away, so a view lies within that chord and looks inwards."""
    chord = 3 * 2 * np.sin(np.pi * 2 / 48)  # to the second next camera, on a ring of radius 3

    for camera, view in zip(RING_CAMERAS, interpolate_views(RING_CAMERAS), strict=True):
        moved = np.linalg.norm(view.position - camera.position)
        assert 0.2 * chord / 2 < moved < chord
        assert view.rotation[2] @ camera.rotation[2] > np.cos(2 * np.pi * 2 / 48)
        np.testing.assert_allclose(view.rotation @ view.rotation.T, np.eye(3), atol=1e-12)
        assert (view.width, view.height) == (
            round(INTERPOLATED_VIEW_SIZE_RATIO * camera.width),
            round(INTERPOLATED_VIEW_SIZE_RATIO * camera.height),
        )
        assert (view.fx, view.fy) == (camera.fx, camera.fy)
        assert view.cx - view.width / 2 == pytest.approx(camera.cx - camera.width / 2)


@pytest.mark.parametrize(
    ("count", "places"), [(1, [24]), (2, [12, 36]), (3, [8, 24, 40]), (48, range(48)), (99, range(48))]
)
def test_few_views_are_spread_evenly_and_lie_between_neighbours(count, places):
    at, between = sample_views(RING_CAMERAS, count, seed=3)

    assert at == [RING_CAMERAS[place] for place in places]
    chord = 3 * 2 * np.sin(np.pi * 2 / 48)
    for camera, view in zip(at, between, strict=True):
        assert 0.2 * chord / 2 < np.linalg.norm(view.position - camera.position) < chord


def test_views_of_no_camera_are_none_and_of_one_camera_that_camera():
    assert sample_views([], 3) == ([], [])
    assert sample_views(RING_CAMERAS[:1], 3) == (RING_CAMERAS[:1], RING_CAMERAS[:1])


def test_a_single_camera_without_neighbours_is_unchanged():
    assert interpolate_views(RING_CAMERAS[:1]) == RING_CAMERAS[:1]
    assert interpolate_views([]) == []


def test_intermediate_views_exist_for_cameras_at_one_place():
    views = interpolate_views([RING_CAMERAS[0]] * 3)

    assert all(np.allclose(view.position, RING_CAMERAS[0].position) for view in views)
    assert all(np.isfinite(view.camera_from_world).all() for view in views)


def test_large_cameras_are_reduced_with_the_same_field_of_view():
    large = Camera(4000, 3000, 3500.0, 3400.0, 2100.0, 1400.0, np.eye(4))
    small = shrink_camera(large)
    assert (small.width, small.height) == (MAX_SMALL_VIEW_SIDE_PIXELS, MAX_SMALL_VIEW_SIDE_PIXELS * 3 // 4)
    assert np.allclose(np.array(small.intrinsics) * 4000 / MAX_SMALL_VIEW_SIDE_PIXELS, large.intrinsics)
    assert shrink_camera(small) == small


def test_a_resized_camera_sees_the_same_view():
    camera = camera_at((0.0, -3.0, 1.0), width=64, height=32, focal=50.0)

    half = resize_camera(camera, 0.5)

    assert (half.width, half.height, half.fx, half.cx) == (32, 16, 25.0, 16.0)
    np.testing.assert_array_equal(half.camera_from_world, camera.camera_from_world)


@pytest.mark.parametrize(("columns", "rows"), [(3, 2), (1, 1), (1, 5)])
def test_windows_of_a_view_show_its_picture(columns, rows):
    camera = ring(8, width=41, height=30)[0]
    model = small_model(ball_points(300)[0], fields=0.3, scale_logits=-5.0)
    settings = RenderSettings(
        cull_tolerance=float("inf"), background_stride=1, background_threshold=0, transmittance_min=0
    )

    windows = [render_view(model, window, settings).rgb for window in divide_view(camera, columns, rows)]

    bands = [torch.cat(windows[row * columns : (row + 1) * columns], 1) for row in range(rows)]
    torch.testing.assert_close(torch.cat(bands), render_view(model, camera, settings).rgb, rtol=0, atol=1e-5)


def test_a_picture_of_few_pixels_has_no_empty_windows():
    windows = divide_view(ring(8, width=2, height=1)[0], 3, 4)

    assert [(window.width, window.height) for window in windows] == [(1, 1), (1, 1)]


def test_sampled_windows_show_all_parts_of_a_picture_equally_often():
    cameras = ring(24, width=60, height=40)

    windows = sample_windows(cameras, 24, 6, seed=1)

    assert (windows.columns, windows.rows, windows.pictures) == (2, 3, 4.0)
    at, between = windows.views[::2], windows.views[1::2]
    assert all(any(view.position == pytest.approx(camera.position) for camera in cameras) for view in at)
    assert {(view.width, view.height) for view in at} == {(30, 13), (30, 14)}
    assert {round(view.width / 1.4) for view in between} == {30}
    for views in (at, between):
        places = [(round(view.cx / view.width, 1), round(view.cy / view.height, 1)) for view in views]
        assert sorted(places.count(place) for place in set(places)) == [2] * 6


@pytest.mark.parametrize(("count", "cells"), [(6, 1), (2, 1), (6, 100)])
def test_windows_are_whole_pictures_or_at_most_as_many_as_views(count, cells):
    windows = sample_windows(RING_CAMERAS, count, cells)

    assert len(windows.views) == count
    assert windows.columns * windows.rows <= count
