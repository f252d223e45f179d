"""Initial points on surfaces: depths on planes and across jumps, colours, hard cases, and the first model."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from property_tests import examples
from scenes import BALL_CENTERS, BALL_RADII, ball_scene, camera_at, view_of, visible_points_by_photo
from textured_planes import camera_at as plane_camera_at
from textured_planes import depths_of_planes

from hyrfpack.config.train import TrainConfig
from hyrfpack.data.cache import PictureCache
from hyrfpack.model import Frame
from hyrfpack.scene import Camera, Picture, Scene
from hyrfpack.train import surface_depths
from hyrfpack.train.setup import build_model, initial_points, scene_frame
from hyrfpack.train.surface_depths import MAX_DEPTH_RATIO, MAX_PHOTOS, interpolate_inverse_depths
from hyrfpack.train.surface_points import draw_surface_points

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

    def inverse_at(pixels):
        return (1 + (pixels - (camera.cx, camera.cy)) / (camera.fx, camera.fy) @ np.array(slopes)) / distance

    seen, pixels = generator.uniform(size=(2, 200, 2)) * (64, 48)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(surface_depths, "MAX_DEPTH_RATIO", 100.0)
        inverse = interpolate_inverse_depths(camera, points_at(seen, 1 / inverse_at(seen), camera), pixels)
    known = inverse > 0
    assert known.mean() > 0.8
    assert (pixels[known] >= seen.min(0)).all() and (pixels[known] <= seen.max(0)).all()
    np.testing.assert_allclose(inverse[known], inverse_at(pixels[known]), rtol=1e-8)


@pytest.mark.parametrize("ratio", [1.0, MAX_DEPTH_RATIO - 0.01, MAX_DEPTH_RATIO + 0.01, 50.0])
def test_triangles_across_a_jump_of_depth_are_left_out(ratio):
    points = points_at([(0, 0), (39.9, 0), (0, 29.9)], [2.0, 2.0, 2.0 * ratio])
    inverse = interpolate_inverse_depths(SMALL_CAMERA, points, np.array([(5.0, 5.0), (20.0, 3.0), (35.0, 25.0)]))
    assert inverse[2] == 0 and (inverse[:2] > 0).all() == (ratio < MAX_DEPTH_RATIO)
    assert ((inverse == 0) | ((inverse > 0.5 / ratio - 1e-9) & (inverse < 0.5 + 1e-9))).all()


def test_points_are_spread_evenly_over_the_triangles():
    """A quarter of a wall is a triangle fan of many points, the rest two large triangles."""
    fine = [(x, y) for x in np.linspace(0, 20, 9) for y in np.linspace(0, 15, 9)]
    points = points_at([*fine, (39.9, 0), (0, 29.9), (39.9, 29.9)], [2.0] * (len(fine) + 3))
    drawn, _ = draw_surface_points(
        scene_of([flat_photo()] * 8, points), PictureCache(), 20_000, np.random.default_rng(0)
    )
    x, y, _ = SMALL_CAMERA.project(drawn)
    counts, _, _ = np.histogram2d(x, y, bins=4, range=[(0, 39.9), (0, 29.9)])
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
def test_photos_without_a_triangle_or_neighbours_give_no_points(points):
    assert not interpolate_inverse_depths(SMALL_CAMERA, points, np.random.default_rng(0).uniform(0, 30, (50, 2))).any()
    drawn, colors = draw_surface_points(
        scene_of([flat_photo()] * 3, points), PictureCache(), 20, np.random.default_rng(0)
    )
    assert drawn.shape == colors.shape == (0, 3)


def test_points_repeated_in_one_pixel_are_no_obstacle():
    pixels = np.random.default_rng(0).uniform(size=(500, 2)) * (39.8, 29.8)
    inverse = interpolate_inverse_depths(SMALL_CAMERA, np.repeat(corner_points(), 3, axis=0), pixels)
    np.testing.assert_allclose(inverse, 0.5, rtol=1e-9)


def test_points_have_the_colours_of_their_pixels():
    rgb = np.zeros((30, 40, 3), np.uint8)
    rgb[..., 0], rgb[..., 1] = 6 * np.arange(40), 8 * np.arange(30)[:, None]
    scene = scene_of([Picture(rgb)], corner_points())
    points, colors = draw_surface_points(scene, PictureCache(), 300, np.random.default_rng(1))
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
    points, _ = draw_surface_points(scene, PictureCache(), 100, np.random.default_rng(2))
    x, _, _ = SMALL_CAMERA.project(points)
    assert len(points) > 80 and (x < 20).all()


def test_all_photos_give_points_and_the_same_seed_the_same_ones():
    scene = scene_of([flat_photo((0, 0, 40 * number)) for number in range(6)], corner_points())
    points, colors = draw_surface_points(scene, PictureCache(), 100, np.random.default_rng(3))
    again, _ = draw_surface_points(scene, PictureCache(0), 100, np.random.default_rng(3))
    other, _ = draw_surface_points(scene, PictureCache(), 100, np.random.default_rng(4))
    assert len(points) == 100 and np.array_equal(points, again) and not np.array_equal(points, other)
    _, counts = np.unique(colors[:, 2], return_counts=True)
    assert len(counts) == 6 and counts.min() >= 8 and counts.max() <= 26


def test_at_most_a_hundred_photos_are_read_once():
    pictures = [flat_photo()] * (2 * MAX_PHOTOS + 1)
    scene, read = scene_of(pictures, corner_points()), []

    def counted(view):
        return dataclasses.replace(view, load=lambda: read.append(view.name) or view.load())

    scene = dataclasses.replace(scene, train=[counted(view) for view in scene.train])
    points, _ = draw_surface_points(scene, PictureCache(), 1000, np.random.default_rng(0))
    assert len(points) == 1000 and len(set(read)) == len(read) == MAX_PHOTOS


def test_depths_are_found_once_for_runs_of_one_scene(monkeypatch):
    scene, cache, calls = plane_scene(), PictureCache(), []
    estimate = surface_depths.estimate_depth_maps
    monkeypatch.setattr(surface_depths, "estimate_depth_maps", lambda *given: calls.append(1) or estimate(*given))
    first, again = (draw_surface_points(scene, cache, 300, np.random.default_rng(5))[0] for _ in range(2))
    fresh, _ = draw_surface_points(scene, PictureCache(), 300, np.random.default_rng(5))
    assert np.array_equal(first, again) and np.array_equal(first, fresh) and len(calls) == 2
    fewer = dataclasses.replace(scene, train=scene.train[:3])
    assert not np.array_equal(draw_surface_points(fewer, cache, 300, np.random.default_rng(5))[0], first)


def plane_scene(unit: float = 1.0, *, enlarged: int = 1, cut: int = 0, **layers) -> Scene:
    """Return photos of a wall with a board before it from five places, without tracks; points on the wall alone.

    The photos of the first, third and fifth place lack `cut` columns and rows, after each pixel has become `enlarged` x
    `enlarged` pixels.
    """
    planes = [(4.0, 0.0, -np.inf, np.inf), (2.5, 0.0, -0.4, 0.4)]
    views, points = [], np.zeros((0, 3))
    for number, place in enumerate([(0.0, 0.0), (0.35, 0.05), (-0.35, 0.0), (0.1, 0.35), (0.0, -0.35)]):
        camera = plane_camera_at(*place)
        _, grey = depths_of_planes(camera, planes)
        pixels = np.repeat((255 * grey).astype(np.uint8)[..., None], 3, 2)
        pixels = pixels.repeat(enlarged, 0).repeat(enlarged, 1)
        less = cut * (number % 2 == 0)
        pixels = pixels[: len(pixels) - less, : pixels.shape[1] - less]
        pose = camera.camera_from_world.copy()
        pose[:3, 3] *= unit
        height, width = pixels.shape[:2]
        lens = (enlarged * value for value in camera.intrinsics)
        views.append(view_of(f"{number}.png", Camera(width, height, *lens, pose), Picture(pixels, **layers)))
        if not number:
            places = np.random.default_rng(0).uniform(size=(40, 2)) * (camera.width, camera.height)
            points = unit * points_at(places, [4.0] * 40, camera)
    return Scene("planes", "nerfstudio", views, [], points, np.full((len(points), 3), 0.5, np.float32))


@pytest.mark.parametrize(
    ("unit", "layout"),
    [(1.0, {}), (1e-3, {}), (1e4, {}), (1.0, {"enlarged": 3}), (1.0, {"enlarged": 4, "cut": 3})],
    ids=["usual", "small unit", "large unit", "large photos", "two sizes, not multiples of the factor"],
)
def test_points_lie_on_surfaces_that_have_no_points_of_the_scene(unit, layout):
    points, colors = draw_surface_points(plane_scene(unit, **layout), PictureCache(), 2000, np.random.default_rng(0))
    x, _, z = (points / unit).T
    on_board, on_wall = np.abs(z - 2.5) < 0.15, np.abs(z - 4) < 0.3
    assert len(points) == 2000 and (on_board | on_wall).mean() > 0.9
    assert on_board.mean() > 0.1 and (np.abs(x[on_board]) < 0.5).all()
    assert 0 <= colors.min() < 0.3 and 0.7 < colors.max() <= 1


@pytest.mark.parametrize("layer", ["alpha", "mask"])
def test_unusable_pixels_of_large_photos_give_no_points(layer):
    """One transparent pixel in each block of four makes the block unusable, though its mean alpha rounds to 255."""
    shown = np.zeros((96, 128), bool)
    shown[:, :64] = True
    shown[::2, 32::2] = False
    layers = {"mask": shown} if layer == "mask" else {"alpha": np.where(shown, 255, 254).astype(np.uint8)}
    scene = plane_scene(enlarged=2, **layers)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(surface_depths, "MAX_DEPTH_MAP_SIDE_PIXELS", 64)
        points, _ = draw_surface_points(scene, PictureCache(), 500, np.random.default_rng(0))
    assert len(points) == 500
    columns = [view.camera.project(points)[0] for view in scene.train]
    assert (np.min(columns, axis=0) < 32).all()  # each point is drawn from one of the photos, left of its column 32


def test_many_points_without_tracks_are_a_guide_as_good_as_few():
    scene = plane_scene()
    many = np.repeat(scene.points, 300, axis=0)
    assert len(many) > surface_depths.MAX_GUIDING_POINTS
    scene = dataclasses.replace(scene, points=many, point_colors=np.full((len(many), 3), 0.5, np.float32))
    points, _ = draw_surface_points(scene, PictureCache(), 300, np.random.default_rng(0))
    z = points[:, 2]
    assert ((np.abs(z - 2.5) < 0.15) | (np.abs(z - 4) < 0.3)).mean() > 0.9


def test_without_points_random_ones_guide_the_depth_maps():
    """Random points in the box take the place of the scene's points."""
    scene = dataclasses.replace(plane_scene(), points=np.zeros((0, 3)), point_colors=np.zeros((0, 3), np.float32))
    frame = Frame.from_box(np.array([-3.0, -2.0, 1.0]), np.array([3.0, 2.0, 5.0]))
    positions, colors, source = initial_points(scene, frame, 500, 0, PictureCache())
    z = frame.to_world(positions)[:, 2]
    assert source == "on surfaces that photos show" and positions.shape == colors.shape == (500, 3)
    assert ((np.abs(z - 2.5) < 0.2) | (np.abs(z - 4) < 0.4)).mean() > 0.8


@pytest.mark.parametrize("points", [[[50.0, 60.0, 70.0]] * 20, [[0.0, 0.0, 2.5]]], ids=["of another frame", "one"])
def test_points_that_cannot_guide_the_depth_maps_do_no_harm(points):
    """They are kept, and random points take their place as guides."""
    scene = dataclasses.replace(
        plane_scene(), points=np.array(points), point_colors=np.full((len(points), 3), 0.5, np.float32), tracks={}
    )
    frame = Frame.from_box(np.array([-3.0, -2.0, 1.0]), np.array([3.0, 2.0, 5.0]))
    positions, colors, source = initial_points(scene, frame, 500, 0, PictureCache())
    assert source == f"{len(points)} points of the scene, the others on surfaces that photos show"
    assert positions.shape == colors.shape == (500, 3)
    z = frame.to_world(positions[len(points) :])[:, 2]
    assert ((np.abs(z - 2.5) < 0.2) | (np.abs(z - 4) < 0.4)).mean() > 0.8


def test_random_points_make_up_the_rest_where_few_depths_are_known():
    """Else a few pixels, whose depths may be wrong, would get all points."""
    mask = np.zeros((48, 64), bool)
    mask[20:23] = True
    scene = plane_scene(mask=mask)
    drawn, _ = draw_surface_points(scene, PictureCache(), 5000, np.random.default_rng(0))
    assert 0 < len(drawn) <= 4 * mask.sum() * len(scene.train)
    scene = dataclasses.replace(scene, points=np.zeros((0, 3)), point_colors=np.zeros((0, 3), np.float32))
    frame = Frame.from_box(np.array([-3.0, -2.0, 1.0]), np.array([3.0, 2.0, 5.0]))
    positions, colors, source = initial_points(scene, frame, 20_000, 0, PictureCache())
    assert positions.shape == colors.shape == (10_000, 3)
    assert source.endswith(" on surfaces that photos show, the others random, in the box")


def tracked_balls(points: int = 300) -> Scene:
    scene = ball_scene(points=points, side=64)
    return dataclasses.replace(scene, tracks=visible_points_by_photo(scene))


def test_points_between_those_of_balls_lie_near_their_surfaces():
    scene = tracked_balls()
    points, _ = draw_surface_points(scene, PictureCache(), 1000, np.random.default_rng(0))
    distances = np.abs(np.linalg.norm(points[:, None] - BALL_CENTERS, axis=2) - BALL_RADII).min(1)
    assert len(points) == 1000
    assert np.median(distances) < 0.02 and np.quantile(distances, 0.9) < 0.2  # the smallest radius is 0.3


def test_a_model_starts_from_all_points_of_the_scene_and_others_up_to_the_budget():
    scene = tracked_balls()
    frame = scene_frame(scene, "standard")
    positions, colors, source = initial_points(scene, frame, 500, 0, PictureCache())
    assert positions.shape == colors.shape == (500, 3)
    np.testing.assert_allclose(frame.to_world(positions)[:300], scene.points, atol=1e-9)
    np.testing.assert_allclose(colors[:300], scene.point_colors)
    for budget in (200, 300):
        assert len(initial_points(scene, frame, budget, 0, PictureCache())[0]) == budget
    model, _, choices = build_model(scene, TrainConfig(max_gaussians=500))
    assert len(model) == 500
    assert choices["initial_gaussians"] == "500: 300 points of the scene, the others on surfaces that photos show"
    model, _, choices = build_model(scene, TrainConfig(max_gaussians=500, surface_points=False))
    assert len(model) == 300 and choices["initial_gaussians"] == "300: points of the scene"
