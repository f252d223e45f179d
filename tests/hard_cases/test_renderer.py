"""Hard cases of rendering from model and camera to picture, and the checks that reject NaN.

`docs/explanation/numerics.md` states the bounds.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from scenes import ball_points, ball_scene, camera_at, small_model
from torch import Tensor

import hyrfpack
from hyrfpack.errors import HyrfError, HyrfTrainingError
from hyrfpack.model import HybridModel
from hyrfpack.model.gaussians import Gaussians
from hyrfpack.ops.background import BACKGROUND_RADIUS
from hyrfpack.render import Rendering, RenderSettings, render_view
from hyrfpack.scene import Camera
from hyrfpack.train import TrainConfig
from hyrfpack.train.trainer import Trainer

# All Gaussians and every background pixel are drawn, so that float32 and float64 differ only by rounding.
EXACT_SETTINGS = RenderSettings(background_threshold=0.0, background_stride=1, transmittance_min=0.0)


def _ball_model(count: int = 120, **settings) -> HybridModel:
    points, colors = ball_points(count)
    settings = {"scale_logits": -2.5, "opacity_logits": 0.5, "fields": 1.0, "background": True, **settings}
    return small_model(points, color_logits=torch.from_numpy(colors) * 4 - 2, **settings)


def _model_around_camera() -> HybridModel:
    """Return the balls, and a Gaussian of a third of the scene's size around the camera at (0, -3, 0)."""
    positions = np.vstack([[0.0, -2.98, 0.02], ball_points(60)[0]])
    scale_logits = torch.tensor([[-0.7]] + [[-2.5]] * 60)
    return small_model(positions, scale_logits=scale_logits, fields=1.0, background=True)


def _camera(position, target=(0, 0, 0), *, width: int = 40, height: int = 30, focal: float = 40.0, up=(0, 0, 1)):
    return camera_at(position, target, up, width=width, height=height, focal=focal)


CAMERA_POSITION = (0.0, -3.0, 0.0)
BALL_POSITION = ball_points(120)[0][0]
# Name -> (model, camera, whether Gaussians are visible).
HARD_CASES: dict[str, Callable[[], tuple[HybridModel, Camera, bool]]] = {
    "1 x 1": lambda: (_ball_model(), _camera(CAMERA_POSITION, width=1, height=1, focal=2.0), True),
    "17 x 3": lambda: (_ball_model(), _camera(CAMERA_POSITION, width=17, height=3, focal=12.0), True),
    "inside a Gaussian": lambda: (_model_around_camera(), _camera(CAMERA_POSITION), True),
    "outside the sphere": lambda: (_ball_model(), _camera((0, -2.5 * BACKGROUND_RADIUS, 0), focal=2e3), True),
    "outside, looking past": lambda: (
        _ball_model(),
        _camera((0, -2.5 * BACKGROUND_RADIUS, 0), (BACKGROUND_RADIUS, -2.5 * BACKGROUND_RADIUS, 0)),
        False,
    ),
    "1e5 away": lambda: (_ball_model(), _camera((0, -1e5, 0), focal=1e6), True),
    "upside down": lambda: (_ball_model(), _camera((2.0, -2.5, 1.0), up=(0, 0, -1)), True),
    "focal length of a thousandth of the width": lambda: (_ball_model(), _camera((0, -1.0, 0), focal=0.04), True),
    "focal length of 1e5 widths": lambda: (_ball_model(), _camera(CAMERA_POSITION, BALL_POSITION, focal=4e6), True),
    "opacity logits of 80": lambda: (_ball_model(opacity_logits=80.0), _camera((2.0, -2.5, 1.0)), True),
    "opacity logits of -80": lambda: (_ball_model(opacity_logits=-80.0), _camera((2.0, -2.5, 1.0)), False),
    "colour and scale logits of 80": lambda: (
        small_model(ball_points(9)[0], color_logits=80.0, scale_logits=80.0, fields=1.0, background=True),
        _camera((2.0, -2.5, 1.0)),
        True,
    ),
    "500 coincident": lambda: (
        small_model(np.zeros((500, 3)), scale_logits=-1.0, fields=1.0, background=True),
        _camera((2.0, -2.5, 1.0)),
        True,
    ),
    "one Gaussian": lambda: (_ball_model(1), _camera(CAMERA_POSITION), True),
}


def _render(model: HybridModel, camera: Camera) -> tuple[Rendering, dict[str, Tensor]]:
    """Return the rendering, and the gradients of a random linear function of it, by parameter group."""
    rendering = render_view(model, camera, EXACT_SETTINGS, depth=True)
    weights = torch.randn(camera.height, camera.width, 3, generator=torch.Generator().manual_seed(1))
    (rendering.rgb * weights.to(rendering.rgb.dtype)).sum().backward()
    parts = {name: [getattr(model.gaussians, name)] for name in Gaussians.PARAMETER_NAMES}
    parts |= {"geometry": list(model.geometry.parameters()), "radiance": list(model.radiance.parameters())}
    grads = {name: torch.cat([p.grad.double().flatten() for p in ps]) for name, ps in parts.items()}
    return rendering, grads


def _assert_same_picture(found: Rendering, expected: Rendering) -> None:
    """Check nearly all pixels up to rounding; where it moves an alpha across 1/255, up to what the Gaussian adds."""
    for error in ((found.rgb - expected.rgb).abs().amax(-1), (found.alpha - expected.alpha).abs()):
        assert (error < 3e-6).double().mean() > 0.99 and error.max() < 0.005
    farthest = expected.depth.max().clamp_min(1e-3)
    assert ((found.depth - expected.depth).abs() / farthest < 2e-5).double().mean() > 0.99


# Bounds relative to the length of a parameter group. The gradient of one pixel is a difference of nearly equal numbers,
# and so is that of a picture inside one Gaussian. Behind 500 layers the light has the rounding of all of them.
MAX_GRADIENT_ERROR_RATIO = {"1 x 1": 5e-4, "focal length of 1e5 widths": 1e-2, "500 coincident": 3e-3}


@pytest.mark.parametrize("name", HARD_CASES)
def test_pictures_and_gradients_agree_with_float64(name: str) -> None:
    model, camera, shows = HARD_CASES[name]()
    found, gradients = _render(model, camera)
    expected, expected_gradients = _render(HARD_CASES[name]()[0].double(), camera)

    assert bool(expected.visible.any()) == shows
    _assert_same_picture(found, expected)
    for part, gradient in gradients.items():
        wanted = expected_gradients[part]
        assert (gradient - wanted).norm() <= MAX_GRADIENT_ERROR_RATIO.get(name, 5e-5) * wanted.norm(), part


@pytest.mark.acceptance
@torch.no_grad()
def test_a_picture_of_4096_by_64_agrees_with_float64() -> None:
    model, camera = _ball_model(40), _camera(CAMERA_POSITION, width=4096, height=64, focal=900.0)
    found = render_view(model, camera, EXACT_SETTINGS, depth=True)
    expected = render_view(model.double(), camera, EXACT_SETTINGS, depth=True)
    assert expected.visible.sum() > 10 and (expected.alpha > 0).any(0).sum() > 300  # columns
    _assert_same_picture(found, expected)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_an_inverted_camera_gives_the_rotated_picture(dtype: torch.dtype) -> None:
    """The camera has an off-centre principal point and fx != fy, and the picture is no multiple of a tile."""
    model = _ball_model().to(dtype)
    upright = Camera(45, 37, 40.0, 47.0, 17.25, 22.5, _camera((2.0, -2.5, 1.0)).camera_from_world)
    half_turn = np.diag([-1.0, -1.0, 1.0, 1.0])
    turned = Camera(45, 37, 40.0, 47.0, 45 - 17.25, 37 - 22.5, half_turn @ upright.camera_from_world)

    with torch.no_grad():
        difference = (
            render_view(model, turned, EXACT_SETTINGS).rgb.flip(0, 1) - render_view(model, upright, EXACT_SETTINGS).rgb
        )

    assert difference.abs().max() < (3e-6 if dtype == torch.float32 else 1e-13)


# -- values that are not finite --------------------------------------------------------------------------------------


@pytest.mark.parametrize("poison", [math.nan, math.inf])
@pytest.mark.parametrize("name", [name for name, _ in _ball_model(1).named_parameters()])
def test_a_parameter_that_is_not_finite_is_never_rendered(name: str, poison: float) -> None:
    model, camera = _ball_model(), _camera(CAMERA_POSITION)
    with torch.no_grad():
        dict(model.named_parameters())[name].view(-1)[:: 3 if "gaussians" in name else 1] = poison

    try:
        with torch.no_grad():
            rendering = hyrfpack.render_view(model, camera)
    except HyrfError as error:
        assert "NaN or infinite" in str(error)
    else:  # an activation may clip an infinite logit or weight, which is as good as a large one
        assert math.isinf(poison) and torch.isfinite(rendering.rgb).all()
        assert name not in ("gaussians.positions", "radiance.weights.0", "geometry.weights.0")


def test_one_nan_position_among_many_is_rejected_though_it_is_culled() -> None:
    model = _ball_model()
    with torch.no_grad():
        model.gaussians.positions[7, 1] = math.nan
    with pytest.raises(HyrfError, match="positions"):
        hyrfpack.render_view(model, _camera(CAMERA_POSITION))


def test_decoded_geometry_and_solid_colours_that_are_not_finite_are_rejected() -> None:
    model, camera = _ball_model(background=False), _camera(CAMERA_POSITION)
    decoded = model.decode()
    decoded.geometry.opacities[:] = math.nan
    with pytest.raises(HyrfError, match="opacities"):
        render_view(model, camera, decoded=decoded)
    with pytest.raises(HyrfError, match="background"):
        render_view(model, camera, solid=torch.tensor([0.0, math.nan, 0.0]))


def test_a_pose_beyond_float32_is_rejected() -> None:
    camera, model = _camera(CAMERA_POSITION), _ball_model()
    pose = camera.camera_from_world.copy()
    pose[2, 3] = 3e38  # in local units it exceeds float32
    model.config = dataclasses.replace(model.config, frame=dataclasses.replace(model.config.frame, scale=0.01))
    with pytest.raises(HyrfError, match="pose"):
        render_view(model, Camera(40, 30, *camera.intrinsics, pose))


def test_positions_whose_squares_overflow_are_rejected() -> None:
    """The position is finite, so a file's reader accepts it, but S(p) = |u| is not."""
    model = _ball_model()
    with torch.no_grad():
        model.gaussians.positions[:] = torch.tensor([0.0, 1e30, 0.0])
    with pytest.raises(HyrfError, match="scales"):
        render_view(model, _camera(CAMERA_POSITION))


@pytest.mark.parametrize("poison", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("name", ["fx", "fy", "cx", "cy", "camera_from_world"])
def test_a_camera_with_a_value_that_is_not_finite_is_rejected(name: str, poison: float) -> None:
    camera = _camera(CAMERA_POSITION)
    value = np.where(np.eye(4, k=3) > 0, poison, camera.camera_from_world) if "world" in name else poison
    with pytest.raises(ValueError, match="finite"):
        dataclasses.replace(camera, **{name: value})


@pytest.mark.parametrize("change", [{"width": 0}, {"height": -3}, {"fx": 0.0}, {"fy": -1.0}])
def test_a_camera_without_pixels_or_focal_length_is_rejected(change: dict) -> None:
    with pytest.raises(ValueError, match=r"pixels|positive"):
        dataclasses.replace(_camera(CAMERA_POSITION), **change)


@pytest.mark.parametrize("poison", [math.nan, math.inf])
@pytest.mark.parametrize("name", ["points", "point_colors"])
def test_a_scene_with_a_point_that_is_not_finite_is_rejected(name: str, poison: float) -> None:
    scene = ball_scene()
    values = getattr(scene, name).copy()
    values[3, 1] = poison
    with pytest.raises(ValueError, match="finite"):
        dataclasses.replace(scene, **{name: values})


@pytest.mark.parametrize("name", ["positions", "color_logits", "scale_logits", "opacity_logits"])
def test_one_nan_gaussian_stops_a_training_that_sees_it(name: str) -> None:
    trainer = Trainer(ball_scene(), TrainConfig(steps=3, preset="standard"))
    with torch.no_grad():
        getattr(trainer.model.gaussians, name)[7] = math.nan
    with pytest.raises(HyrfTrainingError, match=rf"step 1 on view .*gaussians.{name}"):
        trainer.run()


def test_a_nan_model_is_not_saved(tmp_path) -> None:
    model = _ball_model()
    with torch.no_grad():
        model.gaussians.scale_logits[3] = math.nan
    with pytest.raises(HyrfError, match="NaN or infinite"):
        hyrfpack.save_model(model, tmp_path / "model.hyrf")
    assert not list(tmp_path.iterdir())
