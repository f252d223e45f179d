"""Merged models are drawn as each part alone, and in one order of depth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from exposures import random_map
from scenes import ball_points, camera_at, ring, shift_cameras, small_model
from scipy.spatial.transform import Rotation

from hyrfpack.config.render import GeometryConfig
from hyrfpack.errors import HyrfError
from hyrfpack.evaluate.metrics import psnr
from hyrfpack.model import Frame, HybridModel
from hyrfpack.model.merged import MergedModel
from hyrfpack.ops.rasterize import Gaussians3D, RasterSettings, rasterize
from hyrfpack.ops.viewport import Viewport
from hyrfpack.render import RenderSettings, render_view
from hyrfpack.render.files import make_renderer

WORLD_FRAME = Frame((10.0, -20.0, 5.0), 7.0, (1.0, 0.5, 0.5))
CAMERAS = ring(3)
RATIO_TOLERANCE = 2e-3  # A Gaussian can be skipped at a pixel by rounding where its alpha is 1/255.


def ball_model(count: int = 150, *, seed: int = 0, **settings) -> HybridModel:
    points, colors = ball_points(count, seed)
    settings = {"scale_logits": -2.5, "opacity_logits": 0.5, "fields": 1.0, "background": True, **settings}
    return small_model(points, color_logits=torch.from_numpy(colors) * 4 - 2, seed=seed, **settings)


def moved_model(model: HybridModel, frame: Frame) -> HybridModel:
    """Return the model with another frame and the same numbers."""
    moved = HybridModel(replace(model.config, frame=frame), model.gaussians)
    moved.geometry, moved.radiance = model.geometry, model.radiance
    moved.copy_settings(model)
    return moved


def split_model(model: HybridModel, seed: int = 0) -> MergedModel:
    """Return the same scene as two parts, each with a random half of the Gaussians in its order."""
    chosen = torch.from_numpy(np.random.default_rng(seed).random(len(model)) < 0.5)
    halves = [model.subset(torch.nonzero(half).squeeze(1)) for half in (chosen, ~chosen)]
    return MergedModel(("a", "b"), tuple(halves))


def render(model, camera, **settings):
    with torch.no_grad():
        return render_view(model, camera, RenderSettings(**settings), depth=True)


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("number", range(len(CAMERAS)))
def test_a_scene_in_two_interpenetrating_parts_is_drawn_like_the_whole(number, antialiased):
    model = ball_model(antialiased=antialiased)
    model.gaussians.pixel_sizes = torch.full((len(model),), 0.1)

    whole, merged = (render(scene, CAMERAS[number]) for scene in (model, split_model(model)))

    torch.testing.assert_close(merged.rgb, whole.rgb, atol=RATIO_TOLERANCE, rtol=0)
    torch.testing.assert_close(merged.alpha, whole.alpha, atol=RATIO_TOLERANCE, rtol=0)
    torch.testing.assert_close(merged.depth, whole.depth, atol=0.02, rtol=0)
    assert len(merged.indices) == len(whole.indices)


@pytest.mark.parametrize("scale", [0.002, 1.0])
def test_near_gaussians_of_a_small_part_are_drawn_as_in_the_part_alone(scale):
    scene, camera = ball_model(1), CAMERAS[0]
    scene = moved_model(scene.subset(torch.empty(0, dtype=torch.int64)), WORLD_FRAME)
    part = moved_model(ball_model(), Frame(tuple(camera.position), scale, (1.0, 1.0, 1.0)))

    merged = render(MergedModel(("scene", "part"), (scene, part)), camera)

    alone = render(part, camera).alpha
    assert alone.mean() > 0.1
    torch.testing.assert_close(merged.alpha, alone, atol=RATIO_TOLERANCE, rtol=0)


def test_rounded_poses_of_small_files_are_drawn_alike():
    """Compressed files round the rotations of their cameras, which are then no exact rotations."""
    model = ball_model()
    pose = CAMERAS[1].camera_from_world.copy()
    pose[:3, :3] = pose[:3, :3].round(3)
    camera = replace(CAMERAS[1], camera_from_world=pose)

    whole, merged = (render(scene, camera) for scene in (model, split_model(model)))

    torch.testing.assert_close(merged.rgb, whole.rgb, atol=RATIO_TOLERANCE, rtol=0)


def test_precomputed_geometry_changes_nothing():
    merged = split_model(ball_model())

    plain = render(merged, CAMERAS[0])
    with torch.no_grad():
        decoded = render_view(merged, CAMERAS[0], decoded=merged.decode())

    assert torch.equal(decoded.rgb, plain.rgb)


def test_parts_side_by_side_are_drawn_like_each_alone():
    first = ball_model(frame=WORLD_FRAME)
    second = ball_model(seed=5, frame=Frame((900.0, -20.0, 5.0), 21.0, (1.0, 1.0, 1.0)), background=False)
    merged = MergedModel(("first", "second"), (first, second))

    def cameras_of(model):
        center, scale = np.array(model.config.frame.center), model.config.frame.scale
        return [camera_at(center + scale * np.array(away), center) for away in ((0.1, -2.5, 0.6), (0.2, 2.4, -0.3))]

    for camera in cameras_of(first):
        assert psnr(render(merged, camera).rgb, render(first, camera).rgb) > 60
    for camera in cameras_of(second):
        together, alone = render(merged, camera), render(second, camera)
        assert float((together.alpha - alone.alpha).abs().max()) < RATIO_TOLERANCE
        opaque = alone.alpha > 0.98
        assert opaque.any()
        torch.testing.assert_close(together.rgb[opaque], alone.rgb[opaque], atol=0.02, rtol=0)
        torch.testing.assert_close(together.depth, alone.depth, atol=0.5, rtol=0)


def test_parts_of_different_frames_match_a_float64_union_in_the_world():
    first = ball_model(frame=WORLD_FRAME, background=False)
    second = ball_model(seed=7, frame=Frame((12.0, -18.0, 4.0), 5.0, (1.0, 0.5, 1.0)), background=False)
    camera = camera_at((10.0, -45.0, 9.0), (11.0, -19.0, 5.0), width=64, height=48)

    picture = render(MergedModel(("a", "b"), (first, second)), camera, exposure="consistent", transmittance_min=0.0)

    parts = []
    with torch.no_grad():
        for model in (first, second):
            frame = model.config.frame
            geometry = model.decode_geometry()
            seen_from = torch.from_numpy(frame.to_local(camera.position[None])[0]).float()
            parts.append(
                (
                    torch.from_numpy(frame.to_world(model.gaussians.positions.numpy())),
                    geometry.quats.double(),
                    geometry.scales.double() * frame.scale,
                    geometry.opacities.double(),
                    model.decode_colors(seen_from).double(),
                )
            )
        means, quats, scales, opacities, colors = (torch.cat(values) for values in zip(*parts, strict=True))
        viewport = Viewport(torch.from_numpy(camera.camera_from_world), camera.intrinsics, camera.width, camera.height)
        union = rasterize(
            Gaussians3D(means, quats, scales, opacities),
            colors,
            viewport,
            RasterSettings(near=0.01 * WORLD_FRAME.scale, transmittance_min=0.0),
            implementation="reference",
        )
        expected = union.rgb + union.transmittance[..., None] * torch.tensor(first.config.solid).double()
    assert psnr(picture.rgb.double(), expected) > 60


@pytest.mark.parametrize("seed", range(3))
def test_turned_cameras_turn_the_axes_of_the_gaussians(seed):
    """The parts are brought to the camera's axes, so a camera that is turned about its axis turns the picture."""
    model = split_model(ball_model(background=False, seed=seed))
    camera = camera_at((0.3, -3.0, 0.4), width=33, height=33)
    half_turn = np.eye(4)
    half_turn[:3, :3] = Rotation.from_euler("z", 180, degrees=True).as_matrix()

    upright = render(model, camera).rgb
    turned = render(model, replace(camera, camera_from_world=half_turn @ camera.camera_from_world)).rgb

    torch.testing.assert_close(turned.flip(0, 1), upright, atol=RATIO_TOLERANCE, rtol=0)


def test_one_exposure_map_in_both_parts_is_applied_like_that_of_the_whole():
    model = ball_model()
    model.exposure = random_map(3, centers=4)

    whole, merged = (render(scene, CAMERAS[1]).rgb for scene in (model, split_model(model)))

    assert not torch.allclose(whole, render(model, CAMERAS[1], exposure="consistent").rgb, atol=0.02)
    torch.testing.assert_close(merged, whole, atol=RATIO_TOLERANCE, rtol=0)


def test_pixels_that_show_one_part_have_the_exposure_of_that_part():
    first = ball_model(opacity_logits=6.0, fields=0.0, scale_logits=-1.5)
    second = moved_model(first, Frame((6.0, 0.0, 0.0), 1.0, (1.0, 1.0, 1.0)))
    second.exposure = random_map(8, centers=4)
    merged = MergedModel(("a", "b"), (first, second))
    (camera,) = shift_cameras([camera_at((0.0, -3.0, 0.5))], (6.0, 0.0, 0.0))

    together, alone = render(merged, camera), render(second, camera)

    opaque = alone.alpha > 0.995
    assert opaque.float().mean() > 0.05
    torch.testing.assert_close(together.rgb[opaque], alone.rgb[opaque], atol=0.01, rtol=0)
    clear = alone.alpha < 1e-4  # the background is that of the first part, which has no exposure map
    torch.testing.assert_close(together.rgb[clear], render(first, camera).rgb[clear], atol=0.01, rtol=0)


def test_models_of_different_filters_cannot_be_merged():
    with pytest.raises(HyrfError, match="antialiased"):
        MergedModel(("a", "b"), (ball_model(antialiased=False), ball_model(antialiased=True)))


def test_a_position_that_is_not_finite_is_an_error():
    merged = split_model(ball_model())
    with torch.no_grad():
        merged.parts[1].gaussians.positions[3, 1] = float("nan")

    with pytest.raises(HyrfError, match="positions"):
        render(merged, CAMERAS[0])


def test_depth_and_normals_are_those_of_the_whole():
    model = ball_model(opacity_logits=3.0)
    geometry = GeometryConfig(depth="exr", normals="exr")

    with torch.no_grad():
        whole, merged = (make_renderer(scene, geometry=geometry)(CAMERAS[0]) for scene in (model, split_model(model)))

    known = whole.depth > 0
    assert known.float().mean() > 0.05
    agree = (merged.depth - whole.depth).abs() < 0.01
    assert agree.float().mean() > 0.99
    both = known & (merged.depth > 0)
    assert float((merged.normals[both] * whole.normals[both]).sum(-1).median()) > 0.999


def test_depth_and_normals_of_a_near_small_part_are_those_of_the_part_alone():
    scene, camera = ball_model(1), CAMERAS[0]
    scene = moved_model(scene.subset(torch.empty(0, dtype=torch.int64)), WORLD_FRAME)
    frame = Frame(tuple(camera.position), 0.02, (1.0, 1.0, 1.0))
    part = moved_model(ball_model(opacity_logits=3.0, background=False), frame)
    geometry = GeometryConfig(depth="exr", normals="exr")
    models = part, MergedModel(("scene", "part"), (scene, part))

    with torch.no_grad():
        alone, merged = (make_renderer(model, geometry=geometry)(camera) for model in models)

    known = alone.depth > 0
    assert known.float().mean() > 0.05
    assert ((merged.depth > 0) == known).float().mean() > 0.99
    torch.testing.assert_close(merged.depth[known].median(), alone.depth[known].median(), rtol=1e-3, atol=0)


def test_all_parts_move_to_a_device():
    moved = split_model(ball_model()).to(torch.device("meta"))
    assert {parameter.device.type for part in moved.parts for parameter in part.parameters()} == {"meta"}
