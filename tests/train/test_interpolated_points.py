"""hyrfpack.train.interpolated_points: depths on planes and across jumps, colours, hard cases, and the first model."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from property_tests import examples
from scenes import BALL_CENTERS, BALL_RADII, ball_scene, camera_at, view_of, visible_points_by_photo

from hyrfpack.config.train import TrainConfig
from hyrfpack.data.cache import PictureCache
from hyrfpack.scene import Camera, Picture, Scene
from hyrfpack.train import interpolated_points
from hyrfpack.train.interpolated_points import MAX_DEPTH_RATIO, MAX_PHOTOS, draw_surface_pixels, interpolate_points
from hyrfpack.train.setup import build_model, initial_points, scene_frame

SMALL_CAMERA = Camera(40, 30, 50.0, 45.0, 19.0, 16.0, np.eye(4))


def points_at(pixels, depths, camera: Camera = SMALL_CAMERA) -> np.ndarray:
    """Return the world points (N, 3) that a camera sees at pixels (N, 2) and depths (N,)."""
    return camera.unproject(*np.asarray(pixels, np.float64).T, np.asarray(depths, np.float64))


def flat_photo(rgb=(100, 150, 200), camera: Camera = SMALL_CAMERA, **layers) -> Picture:
    return Picture(np.full((camera.height, camera.width, 3), rgb, np.uint8), **layers)


def scene_of(pictures, points, camera: Camera = SMALL_CAMERA) -> Scene:
    """Return a scene whose photos, all from one camera, each show all points."""
    views = [view_of(f"{number:04d}.png", camera, picture) for number, picture in enumerate(pictures)]
    tracks = {view.name: np.arange(len(points)) for view in views}
    return Scene(
        "s", "colmap", views, [], np.asarray(points), np.full((len(points), 3), 0.5, np.float32), tracks=tracks
    )


def corner_points(depth: float = 2.0) -> np.ndarray:
    """Return the four points of a wall that a photo shows in its corners."""
    return points_at([(0, 0), (39.9, 0), (0, 29.9), (39.9, 29.9)], [depth] * 4)


@examples(100)
@given(
    slopes=st.tuples(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5)),
    distance=st.floats(0.01, 1e4),
    seed=st.integers(0, 2**32 - 1),
)
def test_pixels_of_a_plane_have_its_depths(slopes, distance, seed):
    """Inverse depth is linear in the pixels of a plane: 1 / z = (1 + a x' + b y') / d."""
    generator = np.random.default_rng(seed)
    camera = camera_at((3.0, -2.0, 1.0), (0.0, 0.5, 0.0), width=64, height=48)

    def depths_at(pixels):
        return distance / (1 + (pixels - (camera.cx, camera.cy)) / (camera.fx, camera.fy) @ np.array(slopes))

    seen = generator.uniform(size=(30, 2)) * (64, 48)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(interpolated_points, "MAX_DEPTH_RATIO", 100.0)
        pixels, depths = draw_surface_pixels(camera, points_at(seen, depths_at(seen), camera), 200, generator)
    assert len(pixels) == 200
    assert (pixels >= seen.min(0)).all() and (pixels <= seen.max(0)).all()
    np.testing.assert_allclose(depths, depths_at(pixels), rtol=1e-9)


@pytest.mark.parametrize("ratio", [1.0, MAX_DEPTH_RATIO - 0.01, MAX_DEPTH_RATIO + 0.01, 50.0])
def test_triangles_across_a_jump_of_depth_are_left_out(ratio):
    points = points_at([(0, 0), (39.9, 0), (0, 29.9)], [2.0, 2.0, 2.0 * ratio])
    pixels, depths = draw_surface_pixels(SMALL_CAMERA, points, 50, np.random.default_rng(0))
    assert len(pixels) == (50 if ratio < MAX_DEPTH_RATIO else 0)
    assert ((depths > 2 - 1e-9) & (depths < 2 * ratio + 1e-9)).all()


def test_pixels_are_spread_evenly_over_the_triangles():
    """A quarter of a wall is a triangle fan of many points, the rest two large triangles."""
    fine = [(x, y) for x in np.linspace(0, 20, 9) for y in np.linspace(0, 15, 9)]
    points = points_at([*fine, (39.9, 0), (0, 29.9), (39.9, 29.9)], [2.0] * (len(fine) + 3))
    pixels, _ = draw_surface_pixels(SMALL_CAMERA, points, 20_000, np.random.default_rng(0))
    counts, _, _ = np.histogram2d(*pixels.T, bins=4, range=[(0, 39.9), (0, 29.9)])
    np.testing.assert_allclose(counts, 20_000 / 16, rtol=0.15)


@pytest.mark.parametrize(
    "points",
    [
        np.zeros((0, 3)),
        points_at([(5, 5), (30, 20)], [1.0, 1.0]),
        points_at([(5, 5), (10, 10), (20, 20)], [1.0, 1.0, 1.0]),
        points_at([(5, 5)] * 6, [1.0] * 6),
        points_at([(5, 5), (30, 5), (5, 20)], [-1.0, -1.0, -1.0]),
        points_at([(-5, 5), (90, 5), (5, 70)], [1.0, 1.0, 1.0]),
        np.array([(0.0, 0.0, 0.0)] * 4),
    ],
    ids=["none", "two", "in a line", "one place", "behind", "outside", "in the camera"],
)
def test_photos_without_a_triangle_give_no_points(points):
    pixels, depths = draw_surface_pixels(SMALL_CAMERA, points, 50, np.random.default_rng(0))
    assert pixels.shape == (0, 2) and depths.shape == (0,)
    found, colors = interpolate_points(scene_of([flat_photo()], points), PictureCache(), 20, np.random.default_rng(0))
    assert found.shape == colors.shape == (0, 3)


def test_points_repeated_in_one_pixel_are_no_obstacle():
    points = np.repeat(corner_points(), 3, axis=0)
    _, depths = draw_surface_pixels(SMALL_CAMERA, points, 500, np.random.default_rng(0))
    assert len(depths) == 500
    np.testing.assert_allclose(depths, 2.0, rtol=1e-9)


def test_points_have_the_colours_of_their_pixels():
    rgb = np.zeros((30, 40, 3), np.uint8)
    rgb[..., 0], rgb[..., 1] = 6 * np.arange(40), 8 * np.arange(30)[:, None]
    scene = scene_of([Picture(rgb)], corner_points())
    points, colors = interpolate_points(scene, PictureCache(), 300, np.random.default_rng(1))
    x, y, z = SMALL_CAMERA.project(points)
    np.testing.assert_allclose(z, 2.0, rtol=1e-9)
    np.testing.assert_allclose(255 * colors[:, 0], 6 * np.floor(x + 1e-9), atol=1e-6)
    np.testing.assert_allclose(255 * colors[:, 1], 8 * np.floor(y + 1e-9), atol=1e-6)


@pytest.mark.parametrize("layer", ["alpha", "mask"])
def test_masked_and_transparent_pixels_give_no_points(layer):
    left = np.zeros((30, 40), bool)
    left[:, :20] = True
    layers = {"mask": left} if layer == "mask" else {"alpha": np.where(left, 255, 254).astype(np.uint8)}
    scene = scene_of([flat_photo(**layers)], corner_points())
    points, _ = interpolate_points(scene, PictureCache(), 100, np.random.default_rng(2))
    x, _, _ = SMALL_CAMERA.project(points)
    assert len(points) > 80 and (x < 20).all()


def test_each_photo_gives_its_share_and_the_same_seed_the_same_points():
    scene = scene_of([flat_photo((0, 0, 40 * number)) for number in range(6)], corner_points())
    points, colors = interpolate_points(scene, PictureCache(), 100, np.random.default_rng(3))
    again, _ = interpolate_points(scene, PictureCache(0), 100, np.random.default_rng(3))
    other, _ = interpolate_points(scene, PictureCache(), 100, np.random.default_rng(4))
    assert len(points) == 100 and np.array_equal(points, again) and not np.array_equal(points, other)
    _, counts = np.unique(colors[:, 2], return_counts=True)
    assert len(counts) == 6 and counts.min() >= 14 and counts.max() <= 17


def test_at_most_a_hundred_photos_are_read_and_none_without_tracks():
    pictures = [flat_photo()] * (2 * MAX_PHOTOS + 1)
    scene, read = scene_of(pictures, corner_points()), []

    def counted(view):
        return dataclasses.replace(view, load=lambda: read.append(view.name) or view.load())

    scene = dataclasses.replace(scene, train=[counted(view) for view in scene.train])
    points, _ = interpolate_points(scene, PictureCache(), 1000, np.random.default_rng(0))
    assert len(points) == 1000 and len(set(read)) == len(read) == MAX_PHOTOS
    read.clear()
    points, _ = interpolate_points(dataclasses.replace(scene, tracks={}), PictureCache(), 9, np.random.default_rng(0))
    assert len(points) == len(read) == 0


def tracked_balls(points: int = 300) -> Scene:
    scene = ball_scene(points=points, side=64)
    return dataclasses.replace(scene, tracks=visible_points_by_photo(scene))


def test_points_between_those_of_balls_lie_near_their_surfaces():
    scene = tracked_balls()
    points, _ = interpolate_points(scene, PictureCache(), 1000, np.random.default_rng(0))
    distances = np.abs(np.linalg.norm(points[:, None] - BALL_CENTERS, axis=2) - BALL_RADII).min(1)
    assert len(points) == 1000
    assert np.median(distances) < 0.02 and np.quantile(distances, 0.9) < 0.2  # the smallest radius is 0.3


def test_a_model_starts_from_all_points_of_the_scene_and_others_up_to_the_budget():
    scene = tracked_balls()
    frame = scene_frame(scene, "standard")
    positions, colors = initial_points(scene, frame, 500, 0, PictureCache())
    assert positions.shape == colors.shape == (500, 3)
    np.testing.assert_allclose(frame.to_world(positions)[:300], scene.points, atol=1e-9)
    np.testing.assert_allclose(colors[:300], scene.point_colors)
    for budget in (200, 300):
        assert len(initial_points(scene, frame, budget, 0, PictureCache())[0]) == budget
    model, _, choices = build_model(scene, TrainConfig(max_gaussians=500))
    assert len(model) == 500
    assert choices["initial_gaussians"] == "500: 300 points of the scene and others interpolated between them"
    model, _, choices = build_model(scene, TrainConfig(max_gaussians=500, interpolate_points=False))
    assert len(model) == 300 and choices["initial_gaussians"] == "300: points of the scene"
