"""The renderer: cull -> decode the visible -> project, bin, blend -> background."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

import torch
from torch import Tensor

from hyrfpack.errors import HyrfError
from hyrfpack.model import Geometry, HybridModel, viewpoint_of
from hyrfpack.ops.rasterize import rasterize
from hyrfpack.ops.rasterize.reference import TRANSMITTANCE_MIN
from hyrfpack.parallel.pool import torch_on_one_thread
from hyrfpack.render.cull import frustum_cull
from hyrfpack.scene import Camera


@dataclass(frozen=True)
class RenderSettings:
    """How exactly to render. What each default costs and saves is in `docs/speed-and-accuracy.md`.

    Attributes:
        near: Gaussians nearer than this are dropped, local units (the frame's longest half-axis is 1).
        cull_tolerance: how far outside the picture a centre may project, as a fraction of half its size.
        background_threshold: pixels with no more transmittance than this get no background (the paper's tau).
        background_stride: the background is evaluated at every background_stride-th pixel of each axis and
            interpolated between; 1 is exact.
        transmittance_min: a pixel is finished once no more light than this passes; 0 blends every Gaussian.
    """

    near: float = 0.01
    cull_tolerance: float = 0.3
    background_threshold: float = 1 / 512
    background_stride: int = 2
    transmittance_min: float = TRANSMITTANCE_MIN

    def __post_init__(self) -> None:
        if not (self.near >= 0 and self.cull_tolerance >= 0 and self.background_threshold >= 0):
            raise ValueError("near, cull_tolerance and background_threshold must not be negative")
        if self.background_stride < 1:
            raise ValueError(f"background_stride is {self.background_stride}; it must be at least 1")
        if not 0 <= self.transmittance_min < 1:
            raise ValueError(f"transmittance_min is {self.transmittance_min}; it must lie in [0, 1)")


@dataclass(frozen=True)
class Rendering:
    """A rendered view.

    Attributes:
        rgb: (H, W, 3) display-referred colour, background included; within [0, 1] up to rounding.
        alpha: (H, W) coverage by Gaussians, 1 - transmittance.
        depth: (H, W) expected depth along the view axis in world units, 0 where nothing is hit; None unless asked.
        decoded: (n,) indices of the Gaussians that were decoded.
        visible: (n,) bool, which of these touched the picture.
        absgrad: (n, 2) sums over pixels of |dL/d mean2d| in pixels; zero until backward has run; None unless asked.
        pairs: Gaussian-tile pairs blended.
        seconds: wall time per stage.
    """

    rgb: Tensor
    alpha: Tensor
    depth: Tensor | None
    decoded: Tensor
    visible: Tensor
    absgrad: Tensor | None
    pairs: int
    seconds: dict[str, float] = field(default_factory=dict)


@torch_on_one_thread()
def render(
    model: HybridModel,
    camera: Camera,
    settings: RenderSettings = RenderSettings(),
    *,
    geometry: Geometry | None = None,
    depth: bool = False,
    absgrad: bool = False,
    solid: Tensor | None = None,
    background: bool = True,
) -> Rendering:
    """Render one view; differentiable in the model's parameters.

    Args:
        model: what to render.
        camera: from where, in world units.
        settings: accuracy against speed.
        geometry: `model.decode_geometry()` of all Gaussians, when the caller keeps it between views (it does not
            depend on the view, so inference decodes it once).
        depth: also return depth.
        absgrad: also collect absolute gradients of the projected centres during backward.
        solid: (3,) colour behind everything instead of the model's own; for models without a background sphere.
        background: False leaves the background sphere out.

    Raises:
        HyrfError: a number that the view needs is NaN or infinite.
    """
    seconds: dict[str, float] = {}
    positions = model.gaussians.positions
    pose = torch.as_tensor(model.config.frame.local_pose(camera), dtype=positions.dtype, device=positions.device)
    _refuse_nonfinite(pose=pose, positions=positions)
    with _timed(seconds, "cull"), torch.no_grad():
        index = frustum_cull(
            positions, pose, camera.intrinsics, camera.width, camera.height, settings.near, settings.cull_tolerance
        )
    with _timed(seconds, "decode"):
        geometry = model.decode_geometry(index) if geometry is None else geometry[index]
        colors = model.decode_colors(viewpoint_of(pose), index)
    _refuse_nonfinite(scales=geometry.scales, rotations=geometry.quats, opacities=geometry.opacities, colours=colors)
    gradients = positions.new_zeros(len(index), 2) if absgrad else None
    raster = rasterize(
        positions[index],
        geometry.quats,
        geometry.scales,
        geometry.opacities,
        colors,
        pose,
        camera.intrinsics,
        camera.width,
        camera.height,
        near=settings.near,
        antialiased=model.config.antialiased,
        transmittance_min=settings.transmittance_min,
        depth=depth,
        absgrad=gradients,
    )
    seconds.update(raster.seconds)
    with _timed(seconds, "background"):
        if model.config.background and background:
            behind = _background(model, camera, pose, raster.transmittance, settings)
        else:
            behind = positions.new_tensor(model.config.solid) if solid is None else solid
            _refuse_nonfinite(background=behind)
        rgb = raster.rgb + raster.transmittance[..., None] * behind
    return Rendering(
        rgb=rgb,
        alpha=1 - raster.transmittance,
        depth=None if raster.depth is None else raster.depth * model.config.frame.scale,
        decoded=index,
        visible=raster.visible,
        absgrad=gradients,
        pairs=raster.pairs,
        seconds=seconds,
    )


def _refuse_nonfinite(**values: Tensor) -> None:
    """Raise HyrfError for NaN and infinity: further on they fail every comparison and are left out without a word."""
    for name, tensor in values.items():
        if tensor.numel() and not torch.stack(tensor.detach().aminmax()).isfinite().all():
            raise HyrfError(
                f"the view's {name} hold NaN or infinity, from a broken model or a pose beyond float32; "
                "train the model again or mend the pose"
            )


def _background(
    model: HybridModel, camera: Camera, pose: Tensor, transmittance: Tensor, settings: RenderSettings
) -> Tensor:
    """(H, W, 3) colours of the sphere where it shines through; anything where it does not."""
    height, width = transmittance.shape
    stride = settings.background_stride
    rows, columns = (-(-(size - 1) // stride) + 1 for size in (height, width))  # nodes, the last at or past the edge
    # A node is needed when light passes at any pixel whose colour it takes part in.
    reach = stride - 1
    padded = torch.nn.functional.pad(
        transmittance.detach()[None], (reach, columns * stride - width, reach, rows * stride - height)
    )
    light = torch.nn.functional.max_pool2d(padded, kernel_size=2 * stride - 1, stride=stride)[0]
    nodes = torch.nonzero(light.reshape(-1) > settings.background_threshold).squeeze(-1)
    colors = transmittance.new_zeros(rows * columns, 3)
    if len(nodes):
        places = torch.stack((nodes % columns, torch.div(nodes, columns, rounding_mode="floor")), dim=-1)
        points = places.to(transmittance.dtype) * stride + 0.5
        shades = model.decode_background(points, camera.intrinsics, pose)
        _refuse_nonfinite(background=shades)
        colors = colors.index_put((nodes,), shades)
    grid = colors.T.reshape(1, 3, rows, columns)
    if stride > 1:
        size = ((rows - 1) * stride + 1, (columns - 1) * stride + 1)
        grid = torch.nn.functional.interpolate(grid, size, mode="bilinear", align_corners=True)
    return grid[0, :, :height, :width].permute(1, 2, 0)


@contextmanager
def _timed(seconds: dict[str, float], stage: str) -> Iterator[None]:
    start = time.perf_counter()
    yield
    seconds[stage] = time.perf_counter() - start
