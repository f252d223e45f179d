"""Make a synthetic room of any number of Gaussians for measurements of speed, similar to a trained model.

Gaussians lie on surfaces (floor, ceiling, walls, boxes, spheres) and are as large as the gaps between them; a share of
them fills two plants. Most are opaque, and a fifth is nearly transparent. One wall has a window that shows only the
background sphere. The random seed is fixed, so the room is the same on every machine.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from hyrfpack.bench.operation_calls import collect_splat_inputs
from hyrfpack.cameras.paths import look_at
from hyrfpack.model import Frame, HashGridConfig, HybridModel, ModelConfig
from hyrfpack.model.gaussians import Gaussians, logit
from hyrfpack.ops.poses import camera_center
from hyrfpack.ops.rasterize import Gaussians3D, RasterSettings
from hyrfpack.ops.rasterize.inputs import TRANSMITTANCE_MIN
from hyrfpack.ops.rasterize.reference import ALPHA_MAX, ALPHA_MIN, TILE_SIZE, project
from hyrfpack.ops.viewport import Viewport
from hyrfpack.render import render_view
from hyrfpack.scene import Camera, Picture, Scene, View

# All lengths are in local units, and z is up.
ROOM_HALF_EXTENTS = (1.5, 1.1, 0.6)
WINDOW_YZ_RANGES = ((-0.6, 0.5), (-0.25, 0.4))  # the window is in the wall at x = +1.5
BOX_CENTERS_AND_HALF_EXTENTS = (
    ((0.5, 0.45, -0.4), (0.3, 0.2, 0.2)),
    ((-0.7, -0.6, -0.35), (0.2, 0.3, 0.25)),
    ((0.1, -0.2, -0.5), (0.1,) * 3),
)
SPHERE_CENTERS_AND_RADII = (((0.5, 0.45, -0.08), 0.12), ((-0.2, 0.55, -0.42), 0.18), ((-0.65, -0.6, 0.03), 0.13))
PLANT_CENTERS_AND_RADII = (((-1.1, 0.6, -0.1), 0.28), ((0.9, -0.6, -0.2), 0.24))
PLANT_GAUSSIAN_RATIO = 0.2
GAUSSIANS_PER_ROW = 20  # training sizes its hash tables by the same ratio
FOCAL_LENGTH_TO_WIDTH_RATIO = 0.75
MAX_SAMPLED_TILES = 48


@dataclass(frozen=True)
class Look:
    """Size and transparency of a room's Gaussians.

    Attributes:
        size: size of a Gaussian as a multiple of the gaps between Gaussians.
        faint: share of the Gaussians that are nearly transparent.
    """

    size: float = 1.0
    faint: float = 0.2


TIDY_LOOK = Look()
# After training on photos, Gaussians are larger than the gaps, most are nearly transparent, and many overlap. This room
# has three to five times as many Gaussian-tile pairs as the tidy one.
TRAINED_LOOK = Look(size=3.0, faint=0.7)


def make_model(gaussians: int, device: torch.device, look: Look = TIDY_LOOK, seed: int = 0) -> HybridModel:
    """Return the room as a model with the given number of Gaussians, on a device."""
    generator = torch.Generator().manual_seed(seed)
    points, colors, sizes, opacities = _draw_gaussians(gaussians, look, generator)
    log2 = min(21, max(8, round(math.log2(max(1, gaussians / GAUSSIANS_PER_ROW)))))
    frame = Frame((0.0, 0.0, 0.0), 1.0, (1.0, 1.0, 1.0))
    config = ModelConfig(frame=frame, geometry=HashGridConfig(log2 - 1), radiance=HashGridConfig(log2))
    bounds = torch.linalg.vector_norm(points, dim=-1, keepdim=True).clamp_min(1)
    explicit = Gaussians(points, logit(colors), logit(sizes / bounds), logit(opacities))
    return HybridModel(config, explicit, generator).to(device)


def make_cameras(count: int, width: int, height: int) -> list[Camera]:
    """Return cameras on an ellipse inside the room that look across it; every fourth looks at the window."""
    cameras = []
    for number in range(count):
        angle = 2 * math.pi * (number + 0.25) / count
        position = np.array([0.95 * math.cos(angle), 0.7 * math.sin(angle), 0.15 + 0.2 * math.sin(3 * angle)])
        target = np.array([-0.5 * math.cos(angle + 0.5), -0.4 * math.sin(angle + 0.5), -0.2])
        if number % 4 == 0:
            position, target = np.array([-0.9, 0.1 * number / count, 0.1]), np.array([1.5, -0.05, 0.05])
        cameras.append(_make_camera(position, target, width, height))
    return cameras


def make_scene(truth: HybridModel, cameras: list[Camera]) -> Scene:
    """Render photos of the model; return them as a scene in memory, with some of the model's points."""
    views = []
    for number, camera in enumerate(cameras):
        with torch.no_grad():
            rgb = (255 * render_view(truth, camera).rgb.clamp(0, 1)).round().byte().cpu().numpy()
        views.append(View(f"{number:04d}", camera, _picture_loader(Picture(rgb))))
    points = truth.gaussians.positions.detach()[:: max(1, len(truth) // 500)].double().cpu().numpy()
    colors = np.full(points.shape, 0.5, np.float32)
    return Scene("a made-up room", "nerfstudio", views[1:], views[:1], points, colors)


def _picture_loader(picture: Picture) -> Callable[[], Picture]:
    return lambda: picture


@torch.no_grad()
def perturb(model: HybridModel) -> HybridModel:
    """Add noise to the model's colours, sizes and opacities, in place, so that training has something to improve."""
    generator = torch.Generator().manual_seed(1)
    explicit = model.gaussians
    for values, size in ((explicit.color_logits, 0.5), (explicit.scale_logits, 0.15), (explicit.opacity_logits, 0.3)):
        values += (size * torch.randn(values.shape, generator=generator)).to(values.device)
    return model


@dataclass(frozen=True)
class Splats:
    """Arguments of the rasteriser for one view of a model.

    Attributes:
        inputs: the tensors of `Gaussians3D` and the colours, by name and in this order.
        viewport: the camera, with its pose on the CPU, where the rasteriser expects it.
    """

    inputs: dict[str, Tensor]
    viewport: Viewport

    @property
    def gaussians(self) -> Gaussians3D:
        """The Gaussians without colours."""
        return Gaussians3D(*(self.inputs[name] for name in Gaussians3D._fields))

    @property
    def colors(self) -> Tensor:
        """The colours, (N, 3)."""
        return self.inputs["colors"]


def decode_splats(model: HybridModel, camera: Camera) -> Splats:
    """Decode all Gaussians of the model for one view."""
    viewport = model.config.frame.local_viewport(camera, torch.float64)
    inputs = collect_splat_inputs(model, camera_center(viewport.pose))
    return Splats({name: tensor.contiguous() for name, tensor in inputs.items()}, viewport)


@torch.no_grad()
def count_blended(splats: Splats) -> tuple[float, float]:
    """Estimate the work of blending from up to MAX_SAMPLED_TILES of the picture's tiles, evenly spread.

    Returns:
        The mean number of Gaussians that contribute to a pixel, and the mean share of a tile's Gaussians that are
        processed before all its pixels are finished.
    """
    viewport = splats.viewport
    projected = project(splats.gaussians, viewport, RasterSettings())
    projected = projected.select(torch.argsort(projected.depths))
    reach = (2 * torch.log(255 * projected.opacities).clamp_min(0))[:, None] * projected.covs2d[:, [0, 2]]
    lower, upper = projected.means2d - reach.sqrt(), projected.means2d + reach.sqrt()
    columns, rows = -(-viewport.width // TILE_SIZE), -(-viewport.height // TILE_SIZE)
    tiles = torch.linspace(0, columns * rows - 1, min(MAX_SAMPLED_TILES, columns * rows)).long().tolist()
    corners = torch.stack(torch.meshgrid(torch.arange(TILE_SIZE), torch.arange(TILE_SIZE), indexing="xy"), -1).view(
        -1, 2
    )
    added = reached = pairs = 0.0
    for tile in tiles:
        corner = torch.tensor([TILE_SIZE * (tile % columns), TILE_SIZE * (tile // columns)])
        pixels = (corner + corners + 0.5).to(lower)
        inside = (lower <= pixels[-1]).all(-1) & (upper >= pixels[0]).all(-1) & (projected.opacities >= ALPHA_MIN)
        covering = projected.select(torch.nonzero(inside)[:, 0])
        dx, dy = (covering.means2d - pixels[:, None]).unbind(-1)
        a, b, c = covering.conics.unbind(-1)
        alphas = covering.opacities * torch.exp((-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy).clamp_max(0))
        alphas = torch.where(alphas >= ALPHA_MIN, alphas.clamp_max(ALPHA_MAX), 0)
        touched = (alphas > 0).any(0)
        alphas = alphas[:, touched]
        light = torch.cumprod(1 - alphas, 1).roll(1, 1)
        light[:, :1] = 1
        open_ = light > TRANSMITTANCE_MIN
        added += float((open_ & (alphas > 0)).sum()) / len(pixels)
        reached += float(open_.any(0).sum())
        pairs += alphas.shape[1]
    return added / len(tiles), reached / max(1.0, pairs)


def _draw_gaussians(count: int, look: Look, generator: torch.Generator) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Draw positions (N, 3), colours (N, 3) in (0, 1), sizes (N, 1) in local units and opacities (N, 1)."""
    leaves = int(PLANT_GAUSSIAN_RATIO * count)
    surface, area = _draw_surface_points(count - leaves, generator)
    spacing = math.sqrt(area / max(1, len(surface)))
    groups = [surface]
    sizes = [torch.full((len(surface), 1), 0.6 * spacing)]
    for number, (center, radius) in enumerate(PLANT_CENTERS_AND_RADII):
        count_here = leaves // len(PLANT_CENTERS_AND_RADII) + (number < leaves % len(PLANT_CENTERS_AND_RADII))
        radii = radius * torch.rand(count_here, 1, generator=generator) ** (1 / 3)
        groups.append(torch.tensor(center) + radii * _draw_unit_vectors(count_here, generator))
        gap = (4 / 3 * math.pi * radius**3 / max(1, count_here)) ** (1 / 3)
        sizes.append(torch.full((count_here, 1), 0.35 * gap))
    points = torch.cat(groups)
    size = look.size * torch.cat(sizes) * torch.exp(0.5 * torch.randn(count, 1, generator=generator))
    is_faint = torch.rand(count, 1, generator=generator) < look.faint
    draw = torch.rand(count, 1, generator=generator)
    opacities = torch.where(is_faint, 0.01 + 0.2 * draw, 0.6 + 0.38 * draw)
    # The colours are stripes and checks of several sizes, so that the radiance varies.
    phases = points @ (8 * torch.randn(3, 6, generator=generator))
    colors = 0.5 + 0.4 * torch.sin(phases[:, :3]) * torch.cos(0.4 * phases[:, 3:])
    order = torch.randperm(count, generator=generator)
    return points[order], colors[order], size[order], opacities[order]


def _draw_surface_points(count: int, generator: torch.Generator) -> tuple[Tensor, float]:
    """Draw points evenly over all surfaces except the window; return them and the area of the surfaces."""
    boxes = [((0.0, 0.0, 0.0), ROOM_HALF_EXTENTS), *BOX_CENTERS_AND_HALF_EXTENTS]
    areas = [8 * (x * y + y * z + x * z) for _, (x, y, z) in boxes] + [
        4 * math.pi * r * r for _, r in SPHERE_CENTERS_AND_RADII
    ]
    counts = [int(count * area / sum(areas)) for area in areas]
    counts[0] += count - sum(counts)
    parts = [
        _draw_box_points(count_here, center, half, generator)
        for count_here, (center, half) in zip(counts, boxes, strict=False)
    ]
    for count_here, (center, radius) in zip(counts[len(boxes) :], SPHERE_CENTERS_AND_RADII, strict=True):
        parts.append(torch.tensor(center) + radius * _draw_unit_vectors(count_here, generator))
    points = torch.cat(parts)
    (low_y, high_y), (low_z, high_z) = WINDOW_YZ_RANGES
    _, y, z = points.unbind(-1)
    glass = (points[:, 0] >= ROOM_HALF_EXTENTS[0]) & (y > low_y) & (y < high_y) & (z > low_z) & (z < high_z)
    points[glass, 0] = -ROOM_HALF_EXTENTS[0]  # points inside the window move to the opposite wall
    return points, sum(areas)


def _draw_box_points(count: int, center: tuple, half: tuple, generator: torch.Generator) -> Tensor:
    """Draw points on the faces of a box, in proportion to the faces' areas."""
    x, y, z = half
    axis = torch.multinomial(torch.tensor([y * z, x * z, x * y]), max(1, count), True, generator=generator)[:count]
    points = 2 * torch.rand(count, 3, generator=generator) - 1
    side = torch.where(torch.rand(count, generator=generator) < 0.5, -1.0, 1.0)
    points[torch.arange(count), axis] = side
    return torch.tensor(center) + points * torch.tensor(half)


def _draw_unit_vectors(count: int, generator: torch.Generator) -> Tensor:
    return torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=-1)


def _make_camera(position: np.ndarray, target: np.ndarray, width: int, height: int) -> Camera:
    pose = look_at(position, target, np.array([0.0, 0.0, 1.0]))
    return Camera(
        width,
        height,
        FOCAL_LENGTH_TO_WIDTH_RATIO * width,
        FOCAL_LENGTH_TO_WIDTH_RATIO * width,
        width / 2,
        height / 2,
        pose,
    )
