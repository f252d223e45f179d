"""Rendering of splats from other programs' files with our own rasteriser, as `hyrfpack.render_view` renders models."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from hyrfpack.config.render import GeometryConfig
from hyrfpack.errors import HyrfDataError
from hyrfpack.model import Frame
from hyrfpack.ops.harmonics import harmonics_basis
from hyrfpack.ops.poses import camera_center
from hyrfpack.ops.rasterize import Gaussians3D, Rasterization, rasterize
from hyrfpack.ops.rasterize.cull import frustum_cull
from hyrfpack.parallel.pool import torch_on_one_thread
from hyrfpack.render import RenderedPicture, RenderSettings
from hyrfpack.render.surface import render_surface
from hyrfpack.rotations import IDENTITY
from hyrfpack.scene import Camera
from hyrfpack.splats.splats import Splats


@dataclass(frozen=True)
class Drawable:
    """Splats as float32 tensors in the local units of a frame, ready to be drawn many times.

    Attributes:
        frame: the frame that defines the local units, without a rotation; near planes are in these units, too.
        positions (N, 3), scales (N, 3), quats (N, 4) wxyz, opacities (N,), harmonics (N, K, 3): as in Splats.
        antialiased: as in Splats.
    """

    frame: Frame
    positions: Tensor
    scales: Tensor
    quats: Tensor
    opacities: Tensor
    harmonics: Tensor
    antialiased: bool

    @classmethod
    def from_splats(
        cls,
        splats: Splats,
        frame: Frame,
        device: torch.device = torch.device("cpu"),  # noqa: B008 - a constant
        name: str = "the splats",
    ) -> Drawable:
        """Convert splats to the local units of a frame and copy them to a device.

        The frame's rotation is ignored: the axes remain those of the world, as the splats' harmonics need them.

        Raises:
            HyrfDataError: a position is too large for float32 in these units.
        """
        frame = replace(frame, rotation=IDENTITY)
        with np.errstate(over="ignore"):
            positions = frame.to_local(splats.positions).astype(np.float32)
        is_near = np.isfinite(positions).all(axis=1)
        if not is_near.all():
            x, y, z = splats.positions[~is_near][0].tolist()
            raise HyrfDataError(
                f"{name}: the Gaussian at ({x:.3g}, {y:.3g}, {z:.3g}) is more than 3e38 times as far away as the "
                f"others are spread ({frame.scale:.3g})",
                fix="remove it from the file",
            )
        scales = splats.scales / np.float32(frame.scale)
        arrays = positions, scales, splats.quats, splats.opacities, splats.harmonics
        means, sizes, quats, opacities, harmonics = (torch.from_numpy(array).to(device) for array in arrays)
        return cls(frame, means, sizes, quats, opacities, harmonics, splats.antialiased)

    def __getitem__(self, index: Tensor | slice) -> Drawable:
        """Return the splats at indices (n,) int64 on the same device, or those of a slice."""
        names = "positions", "scales", "quats", "opacities", "harmonics"
        return replace(self, **{name: getattr(self, name)[index] for name in names})

    @property
    def device(self) -> torch.device:
        """The device of the tensors."""
        return self.positions.device

    @property
    def degree(self) -> int:
        """The degree of the spherical harmonics."""
        return round(self.harmonics.shape[1] ** 0.5) - 1

    @property
    def gaussians(self) -> Gaussians3D:
        """The splats without colours, as the rasteriser takes them."""
        return Gaussians3D(self.positions, self.quats, self.scales, self.opacities)

    def evaluate_colors(self, viewpoint: Tensor, index: Tensor) -> Tensor:
        """Evaluate the colours (n, 3), not clamped, of splats `index` (n,) from `viewpoint` (3,) in local units."""
        directions = torch.nn.functional.normalize(self.positions[index] - viewpoint, dim=-1, eps=1e-12)
        return torch.einsum("nk,nkc->nc", harmonics_basis(directions, self.degree), self.harmonics[index]) + 0.5


@torch_on_one_thread()
@torch.no_grad()
def draw(
    drawable: Drawable,
    camera: Camera,
    settings: RenderSettings = RenderSettings(),  # noqa: B008 - frozen
    *,
    black: bool = False,
) -> Rasterization:
    """Render splats from a camera over a black background.

    `transmittance` of the result is the share of a background's light that reaches each pixel.

    Args:
        drawable: the splats.
        camera: a camera in world units.
        settings: near plane (local units), culling and transmittance, as in `hyrfpack.render_view`.
        black: draw all splats black, which is faster where only the transmittance is needed.
    """
    viewport = drawable.frame.local_viewport(camera)
    index = frustum_cull(drawable.positions, viewport, settings.near, settings.cull_tolerance)
    gaussians = drawable.gaussians.select(index)
    means = gaussians.means
    viewpoint = camera_center(viewport.pose).to(means.device, non_blocking=means.is_cuda)
    colors = torch.zeros_like(means) if black else drawable.evaluate_colors(viewpoint, index).clamp_min(0)
    return rasterize(gaussians, colors, viewport, settings.raster_settings(drawable.antialiased))


def draw_picture(
    drawable: Drawable,
    camera: Camera,
    settings: RenderSettings = RenderSettings(),  # noqa: B008 - frozen
    *,
    geometry: GeometryConfig = GeometryConfig(),  # noqa: B008 - frozen
) -> RenderedPicture:
    """Render splats as a picture over black, with the depth and the normals that `geometry` asks for."""
    rgb = draw(drawable, camera, settings).rgb
    if not geometry.is_wanted:
        return RenderedPicture(rgb)
    frame, raster_settings = drawable.frame, settings.raster_settings(drawable.antialiased)
    index = frustum_cull(drawable.positions, frame.local_viewport(camera), settings.near, settings.cull_tolerance)
    visible, has_normals = drawable.gaussians.select(index), geometry.normals is not None
    return RenderedPicture(rgb, *render_surface(visible, frame, camera, raster_settings, normals=has_normals))
