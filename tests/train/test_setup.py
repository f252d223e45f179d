from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch
from scenes import ball_points, ball_scene, camera_at, photograph, ring, view_of

from hyrfpack.data.preset import detect_preset
from hyrfpack.errors import HyrfDataError, HyrfTrainingError
from hyrfpack.model import Frame
from hyrfpack.scene import Picture, Scene, evenly_spaced
from hyrfpack.train import TrainConfig, Trainer, train_model
from hyrfpack.train.setup import (
    MAX_TARGETED_BUDGET_RATIO,
    MIN_TARGETED_BUDGET,
    PACKED_BYTES_PER_GAUSSIAN,
    PACKED_HEADER_BYTES,
    PACKED_NARROW_HEADER_BYTES,
    budget_for,
    build_model,
    initial_points,
    scene_frame,
    table_size_for,
)


def make_rig_scene(cameras, points=None, **fields) -> Scene:
    """Return a scene whose photos show nothing."""
    points = np.zeros((0, 3)) if points is None else np.asarray(points, np.float64)
    grey = Picture(np.full((2, 2, 3), 128, np.uint8))
    views = [view_of(f"{i:03d}.png", camera, grey) for i, camera in enumerate(cameras)]
    return Scene("rig", fields.pop("layout", "colmap"), views, [], points, np.full((len(points), 3), 0.5), **fields)


def scatter_points(low, high, count: int = 200) -> np.ndarray:
    return np.random.default_rng(0).uniform(low, high, (count, 3))


def around_an_object() -> Scene:
    return make_rig_scene(ring(12), ball_points(200)[0])


def aerial_survey() -> Scene:
    """Return a scene of 5 x 5 cameras 50 units above the ground, looking down."""
    cameras = [camera_at((x, y, 50.0), (x, y, 0.0), (0, 1, 0)) for x in range(0, 100, 20) for y in range(0, 100, 20)]
    return make_rig_scene(cameras, scatter_points((-20, -20, 0), (100, 100, 5)))


def forward_drive() -> Scene:
    """Return a scene of a camera that moves 40 units in its viewing direction."""
    cameras = [camera_at((0.1 * np.sin(y), y, 1.5), (0.1 * np.sin(y), y + 5, 1.5)) for y in np.arange(0.0, 40.0)]
    return make_rig_scene(cameras, scatter_points((-8, 0, 0), (8, 60, 6)))


def forward_facing() -> Scene:
    """Return a scene of handheld photos from nearly one place."""
    cameras = [camera_at((x, 0.0, z), (x, 10.0, z)) for x in (-0.5, 0, 0.5) for z in (-0.3, 0, 0.3)]
    return make_rig_scene(cameras, scatter_points((-4, 5, -3), (4, 12, 3)))


def inside_a_room() -> Scene:
    """Return a scene of photos in all directions from one place."""
    turns = [camera_at((1.0, 2.0, 3.0), (1 + np.cos(a), 2 + np.sin(a), 3.0)) for a in np.arange(0, 6.2, 0.5)]
    return make_rig_scene(turns, scatter_points((-3, -2, 1), (5, 6, 5)))


def tilted_survey(degrees: float) -> Scene:
    """Return a survey of 4 x 6 cameras, half tilted one way and half the other.

    The length of the mean viewing direction is the cosine of the tilt.
    """
    slope = 50 * math.tan(math.radians(degrees))
    places = [(x, y, slope if (x // 20) % 2 else -slope) for x in range(0, 80, 20) for y in range(0, 120, 20)]
    cameras = [camera_at((x, y, 50.0), (x + shift, y, 0.0), (0, 1, 0)) for x, y, shift in places]
    return make_rig_scene(cameras, scatter_points((-20, -20, 0), (100, 120, 5)))


# -- regime and frame ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("make", "preset"),
    [
        (around_an_object, "standard"),
        (aerial_survey, "large"),
        (forward_drive, "street"),
        (forward_facing, "standard"),
        (inside_a_room, "standard"),
        (lambda: tilted_survey(25), "large"),  # cos 25 = 0.906
        (lambda: tilted_survey(27), "standard"),  # cos 27 = 0.891
        (lambda: make_rig_scene(ring(12), has_alpha=True), "synthetic"),
        (lambda: make_rig_scene(ring(12), layout="blender"), "synthetic"),
        (lambda: make_rig_scene([view.camera for view in aerial_survey().train]), "standard"),  # no points, no height
        (lambda: make_rig_scene([camera_at((3, 0, 0))]), "standard"),
    ],
)
def test_the_preset_follows_from_the_camera_positions(make, preset):
    found, reason = detect_preset(make())
    assert found == preset and len(reason) > 10


@pytest.mark.parametrize("make", [around_an_object, aerial_survey, forward_drive, forward_facing])
@pytest.mark.parametrize("scale", [1e-3, 1e3])
def test_the_preset_does_not_depend_on_the_unit(make, scale):
    scene = make()
    shift = np.array([1e4, -1e4, 3e3]) * scale
    cameras = [
        camera_at(c.position * scale + shift, (c.position + c.forward) * scale + shift, up=-c.rotation[1])
        for c in (view.camera for view in scene.train)
    ]
    assert detect_preset(make_rig_scene(cameras, scene.points * scale + shift))[0] == detect_preset(scene)[0]


def test_frames_of_the_synthetic_layout_are_the_known_box():
    scene = make_rig_scene(ring(12), ball_points(200)[0], layout="blender")
    assert scene_frame(scene, "synthetic") == Frame((0.0, 0.0, 0.0), 1.3, (1.0, 1.0, 1.0))


def test_frames_of_other_objects_are_the_points_without_their_outliers():
    """Their unit is not known, and the cameras are far away."""
    inner = np.random.default_rng(1).uniform((1, 2, -1), (5, 4, 1), (10_000, 3))
    scene = make_rig_scene(ring(12, radius=40.0), np.concatenate([inner, np.full((50, 3), 1e5)]), has_alpha=True)
    frame = scene_frame(scene, "synthetic")
    np.testing.assert_allclose(frame.center, (3, 3, 0), atol=0.05)
    np.testing.assert_allclose(np.array(frame.half_extent) * frame.scale, (2, 1, 1), atol=0.05)


def test_frames_of_objects_without_points_are_the_cameras_box():
    frame = scene_frame(make_rig_scene(ring(12, radius=40.0), has_alpha=True), "synthetic")
    np.testing.assert_allclose(frame.center, (0, 0, 1), atol=1e-9)
    np.testing.assert_allclose(np.array(frame.half_extent) * frame.scale, (40, 40, 10))  # the third axis is widened


@pytest.mark.parametrize("preset", ["standard", "street"])
def test_frames_of_captures_are_the_cameras_box(preset):
    cameras = [camera_at(p) for p in [(4.0, 0, 1), (-2.0, 3, 1), (0.0, -1, 2)]]
    frame = scene_frame(make_rig_scene(cameras, scatter_points(-100, 100)), preset)
    np.testing.assert_allclose(frame.center, (1, 1, 1.5))
    np.testing.assert_allclose(frame.scale, 3)
    np.testing.assert_allclose(frame.half_extent, (1, 2 / 3, 0.25))  # the third axis is widened


def test_frames_of_surveys_are_the_points_without_their_outliers():
    scene = aerial_survey()
    inner = np.random.default_rng(1).uniform((0, 10, -5), (100, 60, 5), (10_000, 3))
    scene = make_rig_scene([view.camera for view in scene.train], np.concatenate([inner, np.full((50, 3), 1e5)]))
    frame = scene_frame(scene, "large")
    half = np.array(frame.half_extent) * frame.scale
    np.testing.assert_allclose(frame.center, (50, 35, 0), atol=1.5)
    np.testing.assert_allclose(half[:2], (49, 24.5), atol=1.0)


def test_cameras_at_one_place_frame_the_points():
    frame = scene_frame(inside_a_room(), "standard")
    np.testing.assert_allclose(frame.center, (1, 2, 3), atol=0.2)
    np.testing.assert_allclose(np.array(frame.half_extent) * frame.scale, (4, 4, 2), rtol=0.05)


def test_one_camera_without_points_frames_what_is_in_front_of_it():
    camera = camera_at((5.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    frame = scene_frame(make_rig_scene([camera]), "standard")
    np.testing.assert_allclose(frame.center, (4, 0, 0))
    assert frame.scale == 1


def test_a_camera_without_a_finite_position_is_rejected():
    camera = camera_at((3.0, 0, 0))
    camera.camera_from_world[0, 3] = np.nan
    with pytest.raises(HyrfDataError, match="not finite"):
        scene_frame(make_rig_scene([camera, *ring(3)]), "standard")


# -- sizes -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("views", "side", "steps", "expected"),
    [
        (100, 800, 30_000, 0.85 * 800 * 800),
        (100, 800, 7_500, 0.85 * 800 * 800 / 2),
        (100, 800, 120_000, 0.85 * 800 * 800),  # a run of more than 30,000 steps gets the same budget
        (200, 800, 30_000, 0.85 * 800 * 800),  # up to 204 views of this size get the same budget
        (408, 800, 30_000, 408 * 800 * 800 / 240),  # beyond that, the budget grows with the number of pixels
        (408, 800, 10_000, 50 * 10_000),  # nor is it more than 50 Gaussians for each step
        (100, 1600, 3_000, 50 * 3_000),
        (100, 1600, 1_000, 50 * 1_000),
        (100, 1600, 30_000, 50 * 30_000),
        (100, 600, 3_000, 0.85 * 600 * 600 / 10**0.5),  # smaller photos do not reach that limit
        (4, 32, 30_000, 5000),
        (100, 800, 1, 5000),
    ],
)
def test_the_budget_follows_pixels_and_steps(views, side, steps, expected):
    budget, reason = budget_for(make_rig_scene(ring(views, width=side, height=side)), TrainConfig(steps=steps))
    assert budget == round(expected)
    assert f"{steps:,}" in reason


def test_the_budget_follows_the_mean_photo_where_they_differ():
    cameras = [*ring(4, width=200, height=100), *ring(4, width=400, height=300)]
    assert budget_for(make_rig_scene(cameras), TrainConfig(steps=30_000))[0] == 0.85 * (200 * 100 + 400 * 300) / 2


def test_an_explicit_budget_is_kept():
    assert budget_for(around_an_object(), TrainConfig(max_gaussians=77)) == (77, "asked for")


@pytest.mark.parametrize("factor", [0.25, 0.7, 1.0, 2.0])
def test_a_budget_factor_multiplies_the_budget_by_pixels_and_steps(factor):
    usual, why = budget_for(around_an_object(), TrainConfig())
    found = budget_for(around_an_object(), TrainConfig(budget_factor=factor))
    assert found == (round(factor * usual), why if factor == 1 else f"{factor:g} times what suits {why}")


@pytest.mark.parametrize(
    ("factor", "expected"), [(0.1, 0.1 * 0.85 * 1600**2 / 15**0.5), (0.7, 100_000), (1.0, 100_000), (1.5, 150_000)]
)
def test_a_small_factor_lowers_only_what_the_pixels_suggest_and_not_the_limit_by_steps(factor, expected):
    scene = make_rig_scene(ring(60, width=1600, height=1600))
    budget, why = budget_for(scene, TrainConfig(steps=2000, budget_factor=factor))
    assert budget == round(expected)
    assert why.startswith("the limit for 2,000 steps, below 0.7 times") == (factor == 0.7)


@pytest.mark.parametrize(
    "target, header",
    [
        (15_000, PACKED_NARROW_HEADER_BYTES),
        (25_000, PACKED_NARROW_HEADER_BYTES),
        (30_000, PACKED_HEADER_BYTES),
        (36_000, PACKED_HEADER_BYTES),
    ],
)
def test_a_budget_for_a_target_size_fills_the_bytes_that_decoders_leave(target, header):
    budget, reason = budget_for(around_an_object(), TrainConfig(target_bytes=target))
    assert (budget, reason) == ((target - header) / PACKED_BYTES_PER_GAUSSIAN, f"to be packed into {target:,} bytes")


@pytest.mark.parametrize("target, hidden", [(29_999, 32), (30_000, 64), (None, 64)])
def test_models_for_small_files_have_narrow_decoders(target, hidden):
    config = TrainConfig(target_bytes=target, surface_points=False)
    model, _, choices = build_model(ball_scene(views=3, points=30, side=12), config)
    assert model.config.hidden == hidden and ("hidden" in choices) == (hidden == 32)


def test_a_budget_for_a_target_size_is_limited_from_below_and_by_the_photos():
    scene = around_an_object()
    assert budget_for(scene, TrainConfig(target_bytes=1))[0] == MIN_TARGETED_BUDGET
    usual, why = budget_for(scene, TrainConfig())
    assert budget_for(scene, TrainConfig(target_bytes=10**9)) == (
        MAX_TARGETED_BUDGET_RATIO * usual,
        f"{MAX_TARGETED_BUDGET_RATIO} times what suits {why}",
    )


@pytest.mark.parametrize("budget", [1, 1000, 30_000, 500_000, 3_000_000, 10**9])
def test_the_table_holds_about_twenty_gaussians_a_row(budget):
    log2, _ = table_size_for(budget, TrainConfig())
    assert 8 <= log2 <= 21
    if 8 < log2 < 21:
        assert 20 / math.sqrt(2) <= budget / 2**log2 <= 20 * math.sqrt(2)


def test_an_explicit_table_size_is_kept():
    assert table_size_for(1000, TrainConfig(log2_table_size=15))[0] == 15


# -- the first Gaussians ---------------------------------------------------------------------------------------------


def test_points_start_the_gaussians_in_local_units():
    scene = ball_scene(points=50, scale=3.0, offset=(100, 0, -5))
    frame = scene_frame(scene, "standard")
    positions, colors, _ = initial_points(scene, frame, 1000, seed=0)
    np.testing.assert_allclose(positions * frame.scale + frame.center, scene.points, atol=1e-9)
    np.testing.assert_allclose(colors, scene.point_colors)


def test_too_many_points_are_thinned_to_the_budget():
    scene = ball_scene(points=500)
    frame = scene_frame(scene, "standard")

    positions, colors, _ = initial_points(scene, frame, 60, seed=3)

    known = {tuple(point): tuple(color) for point, color in zip(scene.points, scene.point_colors, strict=True)}
    world = frame.to_world(positions)
    nearest = np.array([min(known, key=lambda q, p=p: math.dist(p, q)) for p in world])
    np.testing.assert_allclose(world, nearest, atol=1e-12)
    assert len({tuple(point) for point in nearest}) == 60  # without repetition
    np.testing.assert_allclose(colors, [known[tuple(point)] for point in nearest])
    again, other = initial_points(scene, frame, 60, seed=3)[0], initial_points(scene, frame, 60, seed=4)[0]
    assert np.array_equal(positions, again) and not np.array_equal(positions, other)


def test_without_points_half_a_budget_fills_the_box_at_random():
    scene = make_rig_scene(ring(12))
    frame = Frame.from_box(np.array([-2.0, -1, 0]), np.array([2.0, 1, 3]))

    positions, colors, _ = initial_points(scene, frame, 2000, seed=0)

    assert positions.shape == colors.shape == (1000, 3)
    half = np.array(frame.half_extent)
    assert (np.abs(positions) <= half).all()
    np.testing.assert_allclose(positions.std(0), half / math.sqrt(3), rtol=0.1)  # uniform
    assert (colors == 0.5).all()


def alpha_scene(views: int = 10) -> Scene:
    scene = ball_scene(views=views, side=48, alpha=True)
    return Scene("balls", "blender", scene.train, [], np.zeros((0, 3)), np.zeros((0, 3)), has_alpha=True)


def test_with_coverage_points_start_inside_the_hull():
    scene, frame = alpha_scene(), Frame((0.0, 0.0, 0.0), 1.3, (1.0, 1.0, 1.0))

    positions, colors, _ = initial_points(scene, frame, 400, seed=0)

    assert len(positions) == 200
    for view in scene.train:
        seen = (positions * 1.3) @ view.camera.rotation.T + view.camera.camera_from_world[:3, 3]
        column = (view.camera.fx * seen[:, 0] / seen[:, 2] + view.camera.cx).astype(int)
        row = (view.camera.fy * seen[:, 1] / seen[:, 2] + view.camera.cy).astype(int)
        assert (view.load().alpha[row, column] == 255).all()
    assert colors.min() >= 0 and colors.max() <= 1
    # A hull point has the colour of the balls, not that of the white or black background.
    red_ball = np.linalg.norm(positions * 1.3 - (-0.5, 0, 0), axis=1) < 0.25
    assert red_ball.sum() > 3 and (colors[red_ball, 0] > 0.5).all() and (colors[red_ball, 1] < 0.45).all()


@pytest.mark.parametrize("budget", [1, 2, 10, 300])
def test_empty_silhouettes_still_start_some_gaussians(budget):
    nothing = Picture(np.zeros((32, 32, 3), np.uint8), np.zeros((32, 32), np.uint8))
    views = [view_of(f"{i}.png", camera, nothing) for i, camera in enumerate(ring(4))]
    scene = Scene("empty", "blender", views, [], np.zeros((0, 3)), np.zeros((0, 3)), has_alpha=True)
    model, _, _ = build_model(scene, TrainConfig(max_gaussians=budget))
    assert 1 <= len(model) <= budget


# -- the model -------------------------------------------------------------------------------------------------------


# The untrained radiance field adds logits of this standard deviation (tests/model/test_field.py).
@pytest.mark.parametrize(("encoding", "noise"), [("sh", 0.08), ("frequency", 0.31)])
def test_first_gaussians_look_like_the_points(encoding, noise):
    scene = ball_scene(points=80)
    model, _, _ = build_model(scene, TrainConfig(direction_encoding=encoding, surface_points=False))
    points = model.config.frame.to_local(scene.points)
    gaps = np.sort(np.linalg.norm(points[:, None] - points[None], axis=2), axis=1)[:, 1:4]

    with torch.no_grad():
        geometry, colors = model.decode_geometry(), model.decode_colors(torch.zeros(3))
        stored = torch.sigmoid(model.gaussians.color_logits + model.radiance.biases[-1])

    sizes = np.sqrt((gaps**2).mean(1))
    assert sizes.max() < 0.49  # otherwise the test would measure the cap
    np.testing.assert_allclose(geometry.scales.numpy(), np.repeat(sizes[:, None], 3, 1), rtol=0.02)
    np.testing.assert_allclose(geometry.opacities.numpy(), 0.1, rtol=0.02)
    np.testing.assert_allclose(stored.numpy(), np.clip(scene.point_colors, 0.02, 0.98), atol=1e-6)
    np.testing.assert_allclose(colors.numpy(), stored.numpy(), atol=3 * noise / 4)  # a sigmoid's slope is 1/4 at most


def test_initial_sizes_outside_the_box_follow_the_point_distances_too():
    """S(p) grows there, so the stored fraction has to be smaller."""
    scene = ball_scene(points=60)
    far = Scene("far", "colmap", scene.train, [], scene.points + (30, 0, 0), scene.point_colors)
    model, _, _ = build_model(far, TrainConfig(surface_points=False))
    points = model.config.frame.to_local(far.points)
    gaps = np.sort(np.linalg.norm(points[:, None] - points[None], axis=2), axis=1)[:, 1:4]
    with torch.no_grad():
        scales = model.decode_geometry().scales.numpy()
    np.testing.assert_allclose(scales, np.repeat(np.sqrt((gaps**2).mean(1))[:, None], 3, 1), rtol=0.02)


def test_the_geometry_table_is_half_the_radiance_table():
    model, _, _ = build_model(ball_scene(), TrainConfig(log2_table_size=11))
    assert model.config.radiance.log2_table_size == 11 and model.config.geometry.log2_table_size == 10


@pytest.mark.parametrize(
    ("preset", "background"), [("synthetic", False), ("standard", True), ("large", True), ("street", True)]
)
def test_the_background_follows_the_preset_by_default(preset, background):
    scene = dataclasses.replace(ball_scene(views=4), has_alpha=preset == "synthetic")
    assert build_model(scene, TrainConfig(preset=preset))[0].config.background is background
    asked = TrainConfig(preset=preset, background=not background)
    assert build_model(scene, asked)[0].config.background is not background


@pytest.mark.parametrize(("color", "solid"), [("black", (0, 0, 0)), ("white", (1, 1, 1)), ("random", (0, 0, 0))])
def test_the_colour_behind_follows_the_background_colour(color, solid):
    assert build_model(ball_scene(views=4), TrainConfig(background_color=color))[0].config.solid == solid


def test_choices_are_recorded_with_reasons():
    scene = ball_scene(points=50)
    _, budget, choices = build_model(scene, TrainConfig(steps=3000, max_gaussians=40))
    assert budget == 40
    assert set(choices) == {"preset", "max_gaussians", "log2_table_size", "background", "initial_gaussians"}
    assert choices["preset"].startswith("standard: ") and choices["max_gaussians"] == "40: asked for"
    assert choices["background"] == "sphere: preset standard"
    assert choices["initial_gaussians"] == "40: points of the scene"


@pytest.mark.parametrize(
    ("make", "source"),
    [
        (lambda: make_rig_scene(ring(12)), "random, in the box"),
        (lambda: alpha_scene(), "random, inside the silhouettes"),
        (lambda: ball_scene(points=2000, alpha=True), "points of the scene"),
    ],
)
def test_the_first_gaussians_origin_is_recorded(make, source):
    model, _, choices = build_model(make(), TrainConfig(max_gaussians=200, surface_points=False))
    assert choices["initial_gaussians"] == f"{len(model)}: {source}"


def test_grids_and_direction_encoding_follow_the_settings():
    model, _, _ = build_model(ball_scene(), TrainConfig())
    for grid in (model.config.geometry, model.config.radiance):
        assert (grid.base, grid.finest) == (8, 512)
    assert model.config.direction_encoding == "frequency"

    model, _, _ = build_model(ball_scene(), TrainConfig(grid_resolutions=(16, 100), direction_encoding="sh"))
    for grid in (model.config.geometry, model.config.radiance):
        assert (grid.base, grid.finest) == (16, 100)
    assert model.config.direction_encoding == "sh"


def test_building_twice_gives_the_same_bits():
    first, second, other = (build_model(ball_scene(), TrainConfig(seed=seed))[0] for seed in (5, 5, 6))
    assert all(torch.equal(a, b) for a, b in zip(first.parameters(), second.parameters(), strict=True))
    assert not torch.equal(first.radiance.grid.table, other.radiance.grid.table)


def test_building_does_not_use_the_global_random_generators():
    torch.manual_seed(1)
    np.random.seed(1)
    expected = torch.rand(3), np.random.rand(3)
    torch.manual_seed(1)
    np.random.seed(1)
    build_model(ball_scene(), TrainConfig())
    assert torch.equal(torch.rand(3), expected[0]) and np.array_equal(np.random.rand(3), expected[1])


@pytest.mark.parametrize("build", [build_model, Trainer, train_model])
def test_a_scene_without_training_views_is_rejected(build, tmp_path):
    scene = dataclasses.replace(ball_scene(), train=[], test=ball_scene().train)
    folder = [tmp_path] if build is train_model else []
    with pytest.raises(HyrfTrainingError, match="no views are left for training"):
        build(scene, *folder, TrainConfig())


def test_the_tests_photos_show_the_balls():
    """This checks the tests' own helper: the centre of each ball projects onto its colour."""
    picture = photograph(camera_at((0.0, -3.0, 0.0), width=64, height=64))
    assert picture.rgb[32, int(64 * -0.5 / 3 + 32)].argmax() == 0


@pytest.mark.parametrize(("count", "expected"), [(1, [0]), (2, [0, 9]), (4, [0, 3, 6, 9]), (24, range(10))])
def test_evenly_spaced_views_reach_from_the_first_to_the_last(count, expected):
    found = [view.name for view in evenly_spaced(make_rig_scene(ring(10)).train, count)]
    assert found == [f"{place:03d}.png" for place in expected]
