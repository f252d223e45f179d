"""Renders sample a scene no more finely than its photos did."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scenes import ball_points, camera_at, ring, small_model

import hyrfpack
from hyrfpack.cameras.capture import provenance_cameras, quantized_provenance
from hyrfpack.format import decode_model, encode_model
from hyrfpack.ops.rasterize import Gaussians3D
from hyrfpack.ops.rasterize.inputs import LOW_PASS_VARIANCE
from hyrfpack.render import RenderSettings, render_view
from hyrfpack.render.sampling import SAMPLING_VARIANCE, background_stride, widen_to_photos
from hyrfpack.scene import Camera

EXACT_SETTINGS = RenderSettings(background_threshold=0, transmittance_min=0)


def enlarge(camera: Camera, factor: float) -> Camera:
    """Return a camera with the same field of view and a larger picture."""
    width, height = round(camera.width * factor), round(camera.height * factor)
    fx, fy, cx, cy = (factor * number for number in camera.intrinsics)
    return replace(camera, width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy)


def stored_model(model: hyrfpack.HybridModel, **provenance) -> hyrfpack.HybridModel:
    """Return the model as read from a file with this provenance."""
    return decode_model(encode_model(model, "raw", provenance))


def ball_model(**settings) -> hyrfpack.HybridModel:
    points, colors = ball_points(200)
    settings = {"scale_logits": -4.5, "opacity_logits": 1.0, "fields": 1.0, **settings}
    return small_model(points, color_logits=torch.from_numpy(colors) * 4 - 2, **settings)


def point_model(depth: float = 0.0, **settings) -> hyrfpack.HybridModel:
    """Return a model of one white Gaussian that is far smaller than a pixel."""
    return small_model([(0, depth, 0)], scale_logits=-12.0, opacity_logits=6.0, color_logits=9.0, **settings)


def render_rgb(model, camera, settings: RenderSettings = EXACT_SETTINGS) -> torch.Tensor:
    with torch.no_grad():
        return render_view(model, camera, settings).rgb


def measure_variance(picture: torch.Tensor) -> float:
    """Return the variance of a blob, in px^2: the mean of both axes, weighted by its brightness."""
    light = picture.sum(-1).double().numpy()
    rows, columns = np.mgrid[: light.shape[0], : light.shape[1]].astype(float)
    weight = light / light.sum()
    return float(np.mean([(weight * axis**2).sum() - (weight * axis).sum() ** 2 for axis in (rows, columns)]))


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("background", [False, True])
def test_views_of_the_photos_do_not_change(antialiased, background):
    cameras = ring(6)
    model = ball_model(antialiased=antialiased, background=background)
    stored = stored_model(model, cameras=provenance_cameras(cameras), background_stride=1)
    for camera in cameras:
        torch.testing.assert_close(render_rgb(stored, camera), render_rgb(model, camera), atol=2e-5, rtol=0)


@pytest.mark.parametrize("factor", [2, 4])
def test_an_enlarged_view_is_filtered_as_wide_as_the_photo(factor):
    photo = camera_at((0, -4.0, 0), width=33, height=33)
    model = stored_model(point_model(), cameras=provenance_cameras([photo]))
    found = measure_variance(render_rgb(model, enlarge(photo, factor)))
    assert found == pytest.approx(LOW_PASS_VARIANCE + SAMPLING_VARIANCE * (factor**2 - 1), rel=0.05)


def test_a_close_up_is_filtered_as_wide_as_the_photo():
    photo, near = (camera_at((0, -distance, 0), width=33, height=33) for distance in (4.0, 1.0))
    model = stored_model(point_model(), cameras=provenance_cameras([photo]))
    found = measure_variance(render_rgb(model, near))
    assert found == pytest.approx(LOW_PASS_VARIANCE + SAMPLING_VARIANCE * (4**2 - 1), rel=0.05)
    unknown = measure_variance(render_rgb(point_model(), near))
    assert unknown == pytest.approx(LOW_PASS_VARIANCE, rel=0.35)  # of few pixels above the threshold of alpha


def test_views_from_farther_away_do_not_change():
    photo, far = (camera_at((0, -distance, 0)) for distance in (3.0, 6.0))
    model = ball_model()
    stored = stored_model(model, cameras=provenance_cameras([photo]))
    torch.testing.assert_close(render_rgb(stored, far), render_rgb(model, far), atol=2e-5, rtol=0)


def test_an_antialiased_model_keeps_its_brightness_when_enlarged():
    """The light of an enlarged picture is that of the photo times the area of its pixels."""
    photo = camera_at((0, -4.0, 0), width=33, height=33)
    model = point_model(antialiased=True)
    quats = torch.tensor([[1.0, 0, 0, 0]])
    gaussians = Gaussians3D(torch.zeros(1, 3), quats, torch.tensor([[0.02, 1e-6, 0.05]]), torch.tensor([0.8]))
    viewport = model.config.frame.local_viewport(photo, torch.float32)
    size = torch.tensor([0.3])  # of a photo's pixel
    found = widen_to_photos(gaussians, size, viewport, antialiased=True)
    added = SAMPLING_VARIANCE * (0.3**2 - (4.0 / photo.fx) ** 2)
    expected = np.sqrt(np.array([0.02, 1e-6, 0.05]) ** 2 + added)
    np.testing.assert_allclose(found.scales[0].numpy(), expected, rtol=1e-6)
    # Seen along the shortest axis, opacity times area is that of before.
    assert float(found.opacities) * expected[0] * expected[2] == pytest.approx(0.8 * 0.02 * 0.05, rel=1e-5)
    assert float(widen_to_photos(gaussians, size, viewport, antialiased=False).opacities) == pytest.approx(0.8)


def test_gradients_match_those_of_float64():
    generator = torch.Generator().manual_seed(3)
    means, quats = torch.randn(20, 3, generator=generator), torch.randn(20, 4, generator=generator)
    scales = torch.rand(20, 3, generator=generator) * torch.tensor([1e-8, 0.01, 1.0])
    opacities, sizes = torch.rand(20, generator=generator), torch.rand(20, generator=generator)
    sizes[::3] = 0
    grads = {}
    for dtype in (torch.float32, torch.float64):
        values = [value.to(dtype).clone().requires_grad_() for value in (means, quats, scales, opacities)]
        viewport = point_model().config.frame.local_viewport(camera_at((0, -4.0, 0)), dtype)
        found = widen_to_photos(Gaussians3D(*values), sizes.to(dtype), viewport, antialiased=True)
        (found.scales.sum() + found.opacities.sum()).backward()
        grads[dtype] = [value.grad for value in values]
    assert grads[torch.float32][0] is None  # the width that is added is a constant
    for found, expected in zip(grads[torch.float32][2:], grads[torch.float64][2:], strict=True):
        assert torch.isfinite(found).all()
        torch.testing.assert_close(found.double(), expected, rtol=1e-4, atol=1e-4 * float(expected.abs().max()))


def test_a_scale_of_zero_has_finite_gradients():
    scales = torch.zeros(2, 3, requires_grad=True)
    gaussians = Gaussians3D(torch.zeros(2, 3), torch.ones(2, 4), scales, torch.ones(2))
    viewport = point_model().config.frame.local_viewport(camera_at((0, -4.0, 0)), torch.float32)
    widen_to_photos(gaussians, torch.tensor([0.0, 0.3]), viewport, antialiased=False).scales.sum().backward()
    assert torch.isfinite(scales.grad).all()


@pytest.mark.parametrize(("factor", "stride"), [(0.3, 1), (0.5, 1), (1, 3), (2, 6), (7.5, 22), (1000, 64)])
def test_nodes_of_the_background_are_as_far_apart_as_in_training(factor, stride):
    photo = camera_at((0, -4.0, 0), width=40, height=30)
    model = stored_model(point_model(background=True), cameras=provenance_cameras([photo]), background_stride=3)
    viewport = model.config.frame.local_viewport(enlarge(photo, factor))
    assert background_stride(model.background_spacing, viewport) == stride


def test_rounded_focal_lengths_give_the_same_nodes():
    photos = [replace(camera, fx=71.2345, fy=70.0) for camera in ring(40)]
    kept = quantized_provenance({"cameras": provenance_cameras(photos)}, 1.0)
    model = stored_model(point_model(background=True), **kept)
    assert background_stride(model.background_spacing, model.config.frame.local_viewport(photos[0])) == 2


def test_an_enlarged_view_interpolates_the_background():
    photo = camera_at((0, -4.0, 0), width=40, height=30)
    model = stored_model(
        small_model(np.zeros((0, 3)), fields=2.0, background=True), cameras=provenance_cameras([photo])
    )
    large = enlarge(photo, 3)
    found, expected, exact = (
        render_rgb(model, large, replace(EXACT_SETTINGS, background_stride=stride)) for stride in (None, 6, 1)
    )
    assert torch.equal(found, expected) and not torch.allclose(found, exact, atol=1e-3)


def test_without_cameras_the_background_is_exact():
    model = small_model(np.zeros((0, 3)), fields=2.0, background=True)
    camera = camera_at((0, -4.0, 0))
    assert torch.equal(
        render_rgb(model, camera), render_rgb(model, camera, replace(EXACT_SETTINGS, background_stride=1))
    )


def test_a_part_of_a_model_keeps_its_sampling():
    stored = stored_model(ball_model(), cameras=provenance_cameras(ring(6)))
    part = stored.subset(torch.tensor([5, 3]))
    assert part.gaussians.pixel_sizes.tolist() == stored.gaussians.pixel_sizes[[5, 3]].tolist()
    assert part.background_spacing == stored.background_spacing > 0
    assert stored.double().gaussians.pixel_sizes.dtype == torch.float64  # it follows the parameters
