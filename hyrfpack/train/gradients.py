"""The gradients of one training view, from tensors on the device."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor, nn

from hyrfpack.measure.stages import add_seconds
from hyrfpack.model import HybridModel
from hyrfpack.ops.ssim import photometric_loss
from hyrfpack.ops.viewport import PackedCamera
from hyrfpack.render import Rendering, RenderSettings, render_view
from hyrfpack.render.reserve import Reserve
from hyrfpack.scene import Camera
from hyrfpack.train.exposure import Exposures
from hyrfpack.train.step_checks import StepChecks, check_step


class StepInputs(NamedTuple):
    """What a view's gradients are computed from, besides the parameters and the `StepShape`.

    Attributes:
        target: (H, W, 3) the photo.
        mask: (H, W) bool, the pixels that count; None if all do.
        solid: (3,) colour behind everything; None for the background sphere.
        photo_row: (1,) int64, the photo's row among the gains of `Exposures`; None without exposure compensation.
        camera: the camera's numbers; None on a CPU, where they are those of `StepShape.camera`.
    """

    target: Tensor
    mask: Tensor | None = None
    solid: Tensor | None = None
    photo_row: Tensor | None = None
    camera: PackedCamera | None = None


@dataclass(frozen=True)
class StepShape:
    """What the host knows of a step when it launches it. Steps of equal shapes launch the same work.

    Attributes:
        size: width and height in pixels.
        settings: settings of the rendering.
        absgrad: whether absolute gradients are collected.
        is_masked: whether the photo has a mask.
        reserve: the memory that the view is rendered into, or None.
        camera: the camera. Shapes with other cameras of the same size are equal, if the camera is packed.
    """

    size: tuple[int, int]
    settings: RenderSettings
    absgrad: bool
    is_masked: bool
    reserve: Reserve | None
    camera: Camera = dataclasses.field(compare=False)


@dataclass(frozen=True)
class ViewGradients:
    """The result of a view's forward and backward pass.

    Attributes:
        gradients: the gradient of each parameter; None for one that the view does not depend on.
        loss, error: scalars on the device: loss, and mean squared error, NaN if all of the photo is masked.
        rendering: the rendering, with its absolute gradients and without the graph of its other ones.
        checks: whether the step is valid; None if the view was rendered without a reserve.
        seconds: wall time of each stage.
    """

    gradients: Sequence[Tensor | None]
    loss: Tensor
    error: Tensor
    rendering: Rendering
    checks: StepChecks | None
    seconds: dict[str, float]


def compute_gradients(
    model: HybridModel,
    exposures: Exposures | None,
    parameters: Sequence[nn.Parameter],
    ssim_weight: float,
    shape: StepShape,
    inputs: StepInputs,
) -> ViewGradients:
    """Render a view, and compute the gradients of its loss in the parameters.

    Raises:
        HyrfError: a number to be rendered is not finite; see `render_view`.
    """
    rendering = render_view(
        model,
        shape.camera,
        shape.settings,
        absgrad=shape.absgrad,
        solid=inputs.solid,
        reserve=shape.reserve,
        packed=inputs.camera,
    )
    seconds = dict(rendering.seconds)
    with add_seconds(seconds, "loss"):
        image = rendering.rgb
        if exposures is not None and inputs.photo_row is not None:
            image = exposures.exposed(image, inputs.photo_row)
        loss = photometric_loss(image, inputs.target, inputs.mask, ssim_weight=ssim_weight)
    with add_seconds(seconds, "backward"):
        learnt = [parameter for parameter in parameters if parameter.requires_grad]
        found = dict(zip(learnt, torch.autograd.grad(loss, learnt, allow_unused=True), strict=True))
        computed = [found.get(parameter) for parameter in parameters]
        gradients = [None if gradient is None else gradient.contiguous() for gradient in computed]
    with add_seconds(seconds, "loss"):
        error = _mean_square(image.detach() - inputs.target, inputs.mask)
    # What the graph of the rendering holds on to is as large as all that the view needed.
    rendering = dataclasses.replace(rendering, rgb=rendering.rgb.detach(), alpha=rendering.alpha.detach())
    checks = None
    if shape.reserve is not None and rendering.demand is not None:
        known = [gradient for gradient in gradients if gradient is not None]
        checks = check_step(loss.detach(), known, rendering.demand, shape.reserve)
    return ViewGradients(gradients, loss.detach(), error, rendering, checks, seconds)


def _mean_square(error: Tensor, mask: Tensor | None) -> Tensor:
    """Return the mean square of `error` (H, W, 3) over the pixels inside the mask; NaN if there are none."""
    squares = error.square()
    if mask is None:
        return squares.mean()
    return torch.where(mask[..., None], squares, 0).sum() / (squares.shape[-1] * mask.sum())
