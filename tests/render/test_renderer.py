from __future__ import annotations

import math
from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest
import torch
from scenes import ball_points, camera_at, look_at, ring, small_model

from hyrfpack.model import Frame
from hyrfpack.model.gaussians import Gaussians
from hyrfpack.ops.background import BACKGROUND_RADIUS, reference
from hyrfpack.render import RenderSettings, render_view
from hyrfpack.render.in_view import colors_in_view, gaussians_in_view
from hyrfpack.scene import Camera
from tools.safety.make_golden import add_golden_residuals

WORLD_FRAME = Frame((10.0, -20.0, 5.0), 7.0, (1.0, 0.5, 0.5))
EXACT_SETTINGS = RenderSettings(background_threshold=0.0, background_stride=1)


def to_world(local) -> np.ndarray:
    return WORLD_FRAME.to_world(np.asarray(local, np.float64))


def off_centre_camera(local_position=(0.2, -3.0, 0.7), local_target=(0.1, 0.0, 0.0)) -> Camera:
    """Return a camera with fx != fy, an off-centre principal point and a picture that is no multiple of a tile."""
    return Camera(75, 50, 80.0, 95.0, 33.3, 28.4, look_at(to_world(local_position), to_world(local_target)))


def ball_model(count: int = 120, **settings):
    """Return a model of balls of Gaussians whose fields contribute."""
    points, colors = ball_points(count)
    settings = {"scale_logits": -2.5, "opacity_logits": 0.5, "fields": 1.0, **settings}
    return small_model(points, color_logits=torch.from_numpy(colors) * 4 - 2, **settings)


def render_rgb(model, camera, **options) -> torch.Tensor:
    with torch.no_grad():
        return render_view(model, camera, **options).rgb


def render_exact_background(model, camera) -> torch.Tensor:
    """Return the (H, W, 3) background sphere, evaluated at every pixel."""
    columns, rows = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    points = torch.from_numpy(np.stack([columns, rows], -1).reshape(-1, 2)).float()
    viewport = model.config.frame.local_viewport(camera)
    with torch.no_grad():
        return model.decode_background(points, viewport).view(camera.height, camera.width, 3)


# -- positions and scale ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("local", [(0.0, 0.0, 0.0), (0.3, 0.2, -0.25), (-0.4, -0.3, 0.1)])
def test_a_single_gaussian_is_drawn_where_the_camera_model_projects_it(local):
    camera = off_centre_camera()
    model = small_model([local], frame=WORLD_FRAME, scale_logits=-4.6, opacity_logits=5.0)
    x, y, z = camera.rotation @ to_world(local) + camera.camera_from_world[:3, 3]

    with torch.no_grad():
        rendering = render_view(model, camera, depth=True)

    weights = rendering.alpha.double().numpy()
    rows, columns = np.indices(weights.shape) + 0.5
    found = np.array([(weights * columns).sum(), (weights * rows).sum()]) / weights.sum()
    np.testing.assert_allclose(found, (camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy), atol=0.03)
    hit = rendering.alpha > 0
    assert 5 < hit.sum() < hit.numel() / 4
    np.testing.assert_allclose(
        rendering.depth[hit].numpy(), z, rtol=1e-5
    )  # in world units, because the frame's scale is 7
    assert (rendering.depth[~hit] == 0).all()


def test_a_single_gaussian_is_as_wide_as_projected():
    """Seen head on, a ball of sigma s at depth z has variance (f s / z)^2 + 0.3 px^2 in the picture."""
    model = small_model([[0.0, 0, 0]], scale_logits=float(np.log(0.05 / 0.95)), opacity_logits=1.0)
    camera = camera_at((0, -2.0, 0), width=96, height=96, focal=200.0)

    with torch.no_grad():
        alpha = render_view(model, camera).alpha.double().numpy()

    variance = (200 * 0.05 / 2) ** 2 + 0.3
    rows, columns = np.indices(alpha.shape) + 0.5 - 48
    opacity = 1 / (1 + np.exp(-1.0))
    expected = opacity * np.exp(-0.5 * (rows**2 + columns**2) / variance)
    np.testing.assert_allclose(alpha, np.where(expected >= 1 / 255, expected, 0), atol=1e-4)


def test_nearer_gaussians_hide_farther_ones_whatever_their_order():
    camera = camera_at((0, -3.0, 0))
    positions = np.array([[0, -1.0, 0], [0, 1.0, 0]])
    colors = torch.tensor([[5.0, -5, -5], [-5, -5, 5]])  # the red one is in front of the blue one
    for order in ([0, 1], [1, 0]):
        model = small_model(positions[order], color_logits=colors[order], scale_logits=-1.0, opacity_logits=3.0)
        middle = render_rgb(model, camera)[16, 16]
        assert middle[0] > 0.9 and middle[2] < 0.1


def test_rotating_the_camera_by_180_degrees_rotates_the_picture():
    model = ball_model(background=True)
    camera = camera_at((2.0, -2.5, 1.0))
    half_turn = np.diag([-1.0, -1.0, 1.0, 1.0])
    turned = Camera(32, 32, *camera.intrinsics, half_turn @ camera.camera_from_world)

    difference = render_rgb(model, turned, settings=EXACT_SETTINGS).flip(0, 1) - render_rgb(
        model, camera, settings=EXACT_SETTINGS
    )

    assert difference.abs().max() < 2e-4


def test_the_unit_of_the_world_has_no_effect():
    camera, moved = camera_at((2.0, -2.5, 1.0)), np.array([4e5, -3e5, 1e5])
    pose = camera.camera_from_world.copy()
    pose[:3, 3] = 1000 * pose[:3, 3] - pose[:3, :3] @ moved
    far = Camera(32, 32, *camera.intrinsics, pose)
    here = ball_model(background=True)
    there = ball_model(background=True, frame=Frame(tuple(moved), 1000.0, (1.0, 1.0, 1.0)))

    difference = render_rgb(there, far) - render_rgb(here, camera)

    assert difference.abs().max() < 1e-4


@pytest.mark.parametrize(("depth", "seen"), [(0.0099, False), (0.0101, True), (-1.0, False)])
def test_the_near_plane_is_in_local_units(depth, seen):
    camera = off_centre_camera()
    local_pose = WORLD_FRAME.local_pose(camera)
    on_axis = local_pose[:3, :3].T @ (np.array([0, 0, depth]) - local_pose[:3, 3])
    model = small_model([on_axis], frame=WORLD_FRAME, scale_logits=-6.0)
    with torch.no_grad():
        rendering = render_view(model, camera, RenderSettings(near=0.01))
    assert len(rendering.indices) == rendering.visible.sum() == seen
    assert bool(rendering.alpha.max() > 0) == seen


# -- extreme pictures and cameras --------------------------------------------------------------------------------------


@pytest.mark.parametrize(("width", "height"), [(1, 1), (17, 3), (3, 17), (16, 16), (33, 15)])
def test_pictures_of_any_size_are_rendered_completely(width, height):
    model, camera = ball_model(background=True), camera_at((0, -3.0, 0), width=width, height=height, focal=20.0)
    with torch.no_grad():
        rendering = render_view(model, camera, depth=True)
    assert rendering.rgb.shape == (height, width, 3)
    assert rendering.alpha.shape == rendering.depth.shape == (height, width)
    assert torch.isfinite(rendering.rgb).all() and rendering.alpha.max() > 0.2


@pytest.mark.parametrize(
    ("position", "target"),
    [
        ((0.0, 0.0, 0.0), (0.0, 1.0, 0.0)),  # in the middle of the scene
        ((-0.5, 0.0, 0.0), (0.1, -0.5, -0.2)),  # inside a ball
        ((0.0, 0.0, 90.0), (0.0, 0.1, 0.0)),  # close to the background sphere
        ((0.0, -3 * BACKGROUND_RADIUS, 0.0), (0.0, 0.0, 0.0)),  # outside the background sphere
        (
            (0.0, -3 * BACKGROUND_RADIUS, 0.0),
            (BACKGROUND_RADIUS, -3 * BACKGROUND_RADIUS, 0.0),
        ),  # outside the sphere, and looking past it
        ((1e6, 1e6, 0.0), (0.0, 0.0, 0.0)),
    ],
)
def test_pictures_stay_in_range_wherever_the_camera_is(position, target):
    model = ball_model(background=True)
    with torch.no_grad():
        rendering = render_view(model, camera_at(position, target), depth=True)
    assert rendering.rgb.min() >= 0 and rendering.rgb.max() <= 1 + 1e-5
    assert torch.isfinite(rendering.depth).all()


@pytest.mark.parametrize("background", [True, False])
@pytest.mark.parametrize("empty", ["no Gaussians", "all behind the camera"])
def test_a_model_without_visible_gaussians_renders_the_background(background, empty):
    camera = camera_at((0, -3.0, 0), (0, -6.0, 0))
    positions = ball_points(20)[0] if empty == "all behind the camera" else np.zeros((0, 3))
    model = small_model(positions, fields=1.0, background=background, solid=(0.25, 0.5, 0.75))

    rendering = render_view(model, camera, EXACT_SETTINGS, depth=True, absgrad=True)

    expected = (
        render_exact_background(model, camera) if background else torch.tensor([0.25, 0.5, 0.75]).expand(32, 32, 3)
    )
    torch.testing.assert_close(rendering.rgb, expected)
    assert (rendering.alpha == 0).all() and (rendering.depth == 0).all() and rendering.pairs == 0
    if background:
        rendering.rgb.sum().backward()
        assert model.radiance.grid.table.grad.abs().max() > 0


# -- background ------------------------------------------------------------------------------------------------------


def test_the_background_is_weighted_by_the_transmittance():
    """C = C_fg + T c, with the two parts rendered separately."""
    model, camera = ball_model(background=True), ring(8)[1]
    with torch.no_grad():
        whole = render_view(model, camera, EXACT_SETTINGS)
        gaussians = render_view(model, camera, background=False)

    left = 1 - whole.alpha[..., None]
    assert 0.2 < left.mean() < 0.95 and left.min() < 0.5
    torch.testing.assert_close(
        whole.rgb, gaussians.rgb + left * render_exact_background(model, camera), rtol=0, atol=1e-6
    )


def test_pixels_below_the_threshold_get_no_background():
    model, camera = ball_model(background=True), ring(8)[1]
    with torch.no_grad():
        whole = render_view(model, camera, EXACT_SETTINGS)
        cut = render_view(model, camera, RenderSettings(background_threshold=0.6, background_stride=1))
        gaussians = render_view(model, camera, background=False)

    skipped = 1 - whole.alpha <= 0.6
    assert 10 < skipped.sum() < skipped.numel() - 10
    torch.testing.assert_close(cut.rgb[skipped], gaussians.rgb[skipped])
    torch.testing.assert_close(cut.rgb[~skipped], whole.rgb[~skipped], rtol=0, atol=1e-6)


@pytest.mark.parametrize("stride", [2, 3, 5])
@pytest.mark.parametrize(("width", "height"), [(32, 32), (31, 18), (1, 1), (2, 7)])
def test_a_background_stride_interpolates_between_exact_pixels(stride, width, height):
    camera = camera_at((0, -3.0, 0), (0, -6.0, 0), width=width, height=height, focal=30.0)
    model = small_model(np.zeros((0, 3)), fields=1.0, background=True)
    # Every pixel of a larger picture of the same camera, which is interpolated.
    larger = Camera(width + stride, height + stride, *camera.intrinsics, camera.camera_from_world)
    sky = render_exact_background(model, larger).double().numpy()
    expected = np.empty((height, width, 3))
    for row, column in np.ndindex(height, width):
        top, left = row // stride * stride, column // stride * stride
        down, right = (row - top) / stride, (column - left) / stride
        upper = (1 - right) * sky[top, left] + right * sky[top, left + stride]
        lower = (1 - right) * sky[top + stride, left] + right * sky[top + stride, left + stride]
        expected[row, column] = (1 - down) * upper + down * lower

    found = render_rgb(model, camera, settings=RenderSettings(background_stride=stride))

    np.testing.assert_allclose(found.numpy(), expected, atol=1e-5)


def test_a_stride_of_two_evaluates_every_second_pixel_of_the_background(monkeypatch):
    model, camera = small_model(np.zeros((0, 3)), background=True), camera_at((0, -3.0, 0), width=31, height=18)
    asked = []
    encode = reference.hash_encode
    monkeypatch.setattr(
        reference, "hash_encode", lambda coords, *grid, **_: asked.append(coords) or encode(coords, *grid)
    )
    render_rgb(model, camera, settings=RenderSettings(background_stride=2))
    points = torch.tensor([(x + 0.5, y + 0.5) for y in range(0, 20, 2) for x in range(0, 32, 2)])
    model.decode_background(points, model.config.frame.local_viewport(camera, torch.float32))
    coords, expected = asked
    torch.testing.assert_close(coords, expected, rtol=0, atol=1e-6)


@pytest.mark.parametrize("stride", [1, 2, 3])
def test_no_pixel_above_the_threshold_lacks_background(stride):
    """A threshold omits only what lies below it, at any stride."""
    model, camera = ball_model(background=True, opacity_logits=5.0), ring(8, width=33, height=29)[1]
    with torch.no_grad():
        whole = render_view(model, camera, RenderSettings(background_threshold=0.0, background_stride=stride))
        cut = render_view(model, camera, RenderSettings(background_threshold=0.3, background_stride=stride))
    seen = 1 - whole.alpha > 0.3
    assert 50 < seen.sum() < seen.numel() - 50
    torch.testing.assert_close(cut.rgb[seen], whole.rgb[seen], rtol=0, atol=1e-6)


def test_the_default_threshold_is_invisible_in_8_bits():
    model, camera = ball_model(background=True, opacity_logits=6.0, scale_logits=-1.5), ring(8)[1]
    threshold = RenderSettings(background_stride=1)
    difference = render_rgb(model, camera, settings=threshold) - render_rgb(model, camera, settings=EXACT_SETTINGS)
    assert 0 < difference.abs().max() < 0.5 / 255


def test_a_solid_colour_lies_behind_a_model_without_a_sphere():
    model, camera = ball_model(solid=(1.0, 0.0, 0.5)), ring(8)[2]
    with torch.no_grad():
        black = render_view(model, camera, solid=torch.zeros(3))
        own = render_view(model, camera)
        asked = render_view(model, camera, solid=torch.tensor([0.2, 0.4, 0.6]))

    left = 1 - black.alpha[..., None]
    torch.testing.assert_close(own.rgb, black.rgb + left * torch.tensor([1.0, 0.0, 0.5]), rtol=0, atol=1e-6)
    torch.testing.assert_close(asked.rgb, black.rgb + left * torch.tensor([0.2, 0.4, 0.6]), rtol=0, atol=1e-6)


def test_antialiasing_dims_small_gaussians_by_what_the_low_pass_adds():
    camera, small = camera_at((0, -3.0, 0)), {"scale_logits": -4.0, "opacity_logits": 3.0}
    variance = (32 / 3 / (1 + np.exp(4.0))) ** 2  # in px^2, without the low-pass filter of 0.3
    with torch.no_grad():
        plain = render_view(small_model([[0.0, 0, 0]], **small), camera).alpha.max()
        compensated = render_view(small_model([[0.0, 0, 0]], antialiased=True, **small), camera).alpha.max()
    assert float(compensated / plain) == pytest.approx(variance / (variance + 0.3), rel=1e-3)


@pytest.mark.parametrize(
    "wrong",
    [
        {name: value}
        for name in (
            "near",
            "cull_tolerance",
            "background_threshold",
            "background_stride",
            "transmittance_min",
            "low_pass_variance",
        )
        for value in (-0.1, math.nan, math.inf, True, "2", None)
        if (name, value) not in (("cull_tolerance", math.inf), ("background_stride", None))
    ]
    + [{"low_pass_variance": 0.0}, {"background_stride": 0}, {"background_stride": 1.5}, {"transmittance_min": 1.0}],
    ids=str,
)
def test_impossible_settings_are_rejected(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        RenderSettings(**wrong)


# -- caching, repeatability, statistics ------------------------------------------------------------------------------


def test_a_model_decoded_beforehand_gives_the_same_picture():
    model = ball_model(background=True)
    with torch.no_grad():
        decoded = model.decode()
    for camera in ring(3):
        torch.testing.assert_close(
            render_rgb(model, camera, decoded=decoded), render_rgb(model, camera), rtol=0, atol=1e-6
        )


@pytest.mark.parametrize("degree", [0, 2])
def test_known_colours_give_the_same_picture(degree):
    model = ball_model(frame=WORLD_FRAME)
    model = add_golden_residuals(model, degree) if degree else model
    camera = off_centre_camera((0.1, -0.9, 0.2))  # near enough that some Gaussians are out of view
    decoded = model.decode()

    colors = colors_in_view(model, camera, decoded)

    index = gaussians_in_view(model, camera)
    assert colors.shape == (len(model), 3) and 0 < len(index) < len(model)
    assert (colors[index] > 0).any(dim=1).all() and int((colors > 0).any(dim=1).sum()) == len(index)
    picture = render_rgb(model, camera, decoded=replace(decoded, colors=colors))
    torch.testing.assert_close(picture, render_rgb(model, camera, decoded=decoded), rtol=0, atol=1e-6)
    black = render_rgb(model, camera, decoded=replace(decoded, colors=torch.zeros_like(colors)))
    assert float((picture - black).abs().max()) > 0.1
    half = torch.arange(0, len(model), 2)
    picture = render_rgb(model.subset(half), camera, decoded=replace(decoded, colors=colors)[half])
    torch.testing.assert_close(picture, render_rgb(model.subset(half), camera), rtol=0, atol=1e-6)


def test_rendering_twice_gives_the_same_bits():
    results = []
    for _ in range(2):
        model = ball_model(background=True)
        rendering = render_view(model, ring(8)[3], depth=True, absgrad=True)
        rendering.rgb.square().sum().backward()
        gradients = [p.grad for p in model.parameters()]
        results.append([rendering.rgb.detach(), rendering.alpha.detach(), rendering.absgrad, *gradients])
    for first, second in zip(*results, strict=True):
        assert torch.equal(first, second)


def test_statistics_describe_the_picture():
    model, camera = ball_model(), camera_at((0, -3.0, 0), (0.5, 0, 0), focal=60.0)
    with torch.no_grad():
        rendering = render_view(model, camera)
    assert 0 < len(rendering.indices) < len(model)  # the camera sees only a part
    assert 0 < rendering.visible.sum() <= len(rendering.indices)
    assert rendering.pairs >= rendering.visible.sum()
    assert {"cull", "decode", "background"} < set(rendering.seconds)
    assert all(seconds >= 0 for seconds in rendering.seconds.values())
    assert rendering.depth is None and rendering.absgrad is None


@pytest.mark.parametrize("fails", [False, True])
def test_torch_computes_on_one_thread_while_rendering_and_on_as_many_as_before_after(fails, monkeypatch):
    model, seen = ball_model(), []
    decode = model.decode_geometry

    def spy(*index):
        seen.append(torch.get_num_threads())
        if fails:
            raise RuntimeError("no")
        return decode(*index)

    monkeypatch.setattr(model, "decode_geometry", spy)
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(2)
        with pytest.raises(RuntimeError, match="no") if fails else nullcontext():
            render_rgb(model, ring(8)[0])
        assert seen == [1] and torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)


# -- gradients -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("background", [True, False])
def test_gradients_reach_every_parameter(background):
    model = ball_model(background=background)
    rendering = render_view(model, ring(8)[0], absgrad=True)
    assert (rendering.absgrad == 0).all()

    (rendering.rgb * torch.linspace(0, 1, 32 * 32 * 3).view(32, 32, 3)).sum().backward()

    for name, parameter in model.named_parameters():
        assert parameter.grad is not None and torch.isfinite(parameter.grad).all(), name
        assert parameter.grad.abs().max() > 0, name
    assert (rendering.absgrad[rendering.visible].sum(1) > 0).any()
    assert (rendering.absgrad[~rendering.visible] == 0).all()


@pytest.mark.parametrize("stride", [1, 2, 3])
@pytest.mark.parametrize("part", [*Gaussians.PARAMETER_NAMES, "geometry", "radiance"])
def test_gradients_match_finite_differences_through_the_whole_chain(part, stride):
    """In float64, with fields attached to positions, along one random direction of each parameter group."""
    model = ball_model(12, background=True, position_gradients=True, scale_logits=-1.8).double()
    camera = camera_at((0.5, -2.5, 0.8), width=12, height=10, focal=10.0)
    settings = RenderSettings(background_threshold=0.0, background_stride=stride)
    weights = torch.rand(10, 12, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    owner = getattr(model, part) if part in ("geometry", "radiance") else [getattr(model.gaussians, part)]
    parameters = list(owner.parameters()) if part in ("geometry", "radiance") else owner
    generator = torch.Generator().manual_seed(2)
    directions = [torch.randn(p.shape, generator=generator, dtype=torch.float64) for p in parameters]

    def value(step: float) -> float:
        with torch.no_grad():
            for p, d in zip(parameters, directions, strict=True):
                p.add_(step * d)
            total = float((render_view(model, camera, settings).rgb * weights).sum())
            for p, d in zip(parameters, directions, strict=True):
                p.sub_(step * d)
        return total

    (render_view(model, camera, settings).rgb * weights).sum().backward()
    slope = sum(float((p.grad * d).sum()) for p, d in zip(parameters, directions, strict=True))

    step = 1e-7
    assert slope == pytest.approx((value(step) - value(-step)) / (2 * step), rel=1e-4, abs=1e-6)
