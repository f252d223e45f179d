"""Blend weights of Gaussians from one pass, compared with the derivative of pictures."""

from __future__ import annotations

import pytest
import torch

from hyrfpack.ops.rasterize import Gaussians3D, RasterSettings, rasterize
from hyrfpack.ops.rasterize.blend_weights import sum_blend_weights
from hyrfpack.ops.viewport import Viewport

VIEWPORT = Viewport(torch.eye(4, dtype=torch.float64), (50.0, 50.0, 24.0, 20.0), 48, 40)


def make_scene(kind: str, count: int = 300) -> Gaussians3D:
    generator = torch.Generator().manual_seed(len(kind))
    means = torch.randn(count, 3, generator=generator) * 0.8
    means[:, 2] += 4.0
    scales = 0.1 * torch.exp(0.5 * torch.randn(count, 3, generator=generator))
    opacities = torch.sigmoid(1.5 * torch.randn(count, generator=generator))
    if kind == "opaque, so that tiles end early":
        scales, opacities = scales * 8, torch.full_like(opacities, 0.99)
    if kind == "coincident":
        means[:] = means[0]
    if kind == "behind the camera and beside the picture":
        means[::2, 2] -= 9.0
        means[1::4, 0] += 40.0
    if kind == "needles":
        scales[:, 0] *= 300
    if kind == "too faint":
        opacities[::2] = 1 / 256
    return Gaussians3D(means, torch.randn(count, 4, generator=generator), scales, opacities)


SCENE_KINDS = [
    "a cloud",
    "opaque, so that tiles end early",
    "coincident",
    "behind the camera and beside the picture",
    "needles",
    "too faint",
]


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("kind", SCENE_KINDS)
def test_one_pass_agrees_with_the_float64_derivative(kind: str, antialiased: bool) -> None:
    gaussians, settings = make_scene(kind), RasterSettings(antialiased=antialiased)
    expected = sum_blend_weights(Gaussians3D(*(part.double() for part in gaussians)), VIEWPORT, settings)
    found = sum_blend_weights(gaussians, VIEWPORT, settings, implementation="cpu")
    assert expected[0].max() > 1 > expected[1].min()
    for tensor, wanted in zip(found, expected, strict=True):
        torch.testing.assert_close(tensor, wanted.float(), atol=2e-4, rtol=2e-4)


def test_all_blend_weights_add_up_to_one_minus_the_transmittance() -> None:
    gaussians = make_scene("a cloud")
    picture = rasterize(gaussians, torch.ones(300, 3), VIEWPORT)
    light, passed = sum_blend_weights(gaussians, VIEWPORT)
    assert torch.equal(passed, picture.transmittance)
    assert float(light.sum()) == pytest.approx(float((1 - picture.transmittance).sum()), rel=1e-5)
    assert not light.requires_grad and not light[~picture.visible].any()


@pytest.mark.parametrize("implementation", ["cpu", "reference"])
def test_gaussians_that_are_not_drawn_have_no_weight(implementation: str) -> None:
    gaussians = make_scene("a cloud")
    behind = gaussians._replace(means=gaussians.means - torch.tensor([0.0, 0.0, 99.0]))
    nothing, passed = sum_blend_weights(behind, VIEWPORT, implementation=implementation)
    assert nothing.shape == (300,) and not nothing.any() and bool((passed == 1).all())
    empty = gaussians.select(torch.zeros(0, dtype=torch.int64))
    none, _ = sum_blend_weights(empty, VIEWPORT, implementation=implementation)
    assert none.shape == (0,)


def test_bytes_do_not_depend_on_the_number_of_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    gaussians, found = make_scene("a cloud", 3000), set()
    for threads in (1, 2, 5):
        monkeypatch.setenv("HYRFPACK_THREADS", str(threads))
        found.add(sum_blend_weights(gaussians, VIEWPORT)[0].numpy().tobytes())
    assert len(found) == 1


def test_shapes_that_do_not_fit_are_rejected() -> None:
    gaussians = make_scene("a cloud")
    with pytest.raises(ValueError, match="scales"):
        sum_blend_weights(gaussians._replace(scales=gaussians.scales[:9]), VIEWPORT)
