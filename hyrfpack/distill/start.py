"""The model that distillation starts from: the original's Gaussians, and fields fitted to their shapes and colours.

What a model stores of a Gaussian (place, one size, opacity, colour) is taken over as it is. How it is stretched and
turned, and how its colour changes with the direction, only the fields can say: they are fitted, before anything is
rendered, by regression over the Gaussians.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from hyrfpack.model import HashGridConfig, HybridModel, ModelConfig
from hyrfpack.model.gaussians import Gaussians, logit
from hyrfpack.model.hybrid import scale_bounds
from hyrfpack.ops.poses import camera_center
from hyrfpack.parallel.pool import keep_freed_memory, torch_on_one_thread
from hyrfpack.progress import Report, no_report
from hyrfpack.scene import Camera
from hyrfpack.splats.draw import Drawable
from hyrfpack.splats.harmonics import SH_C0
from hyrfpack.train.config import LearningRates
from hyrfpack.train.optimizer import Optimizer

# Gaussians for each row and level of the tables. A source with harmonics is 2 to 4 times as large, and so may its
# model be: it has colours to learn, too.
PER_ROW, PER_ROW_HARMONICS = 8, 2
FINEST = 1024  # vertices of the finest level along an axis
SILENT = HashGridConfig(4, levels=1, base=2, finest=2)  # of a field that has nothing to say
SMALLEST = 2e-4  # local units that scales are told apart down to: half a pixel, at 1000 across the box
BATCH = 4096  # Gaussians a step: many small steps come nearer than few large ones that take as long
EPOCHS, LEAST_STEPS, MOST_STEPS = 80, 2400, 6000
# Of many Gaussians a step takes the longer for the tables' size, whatever its batch: fewer steps, of larger batches.
MOST_WORK, LEAST_EPOCHS = 1_000_000_000, 16  # steps times Gaussians
RATES = LearningRates(fields=(4e-3, 1e-4), color_logits=(1e-2, 1e-3))
SIZE_WEIGHT = 0.1  # of the squared error of a size that the field may guess, against those of shapes that it must know
MOST_WEIGHT = 10.0  # of a Gaussian, in means
COLOR_WEIGHT = 10.0  # of squared errors of colours
OPAQUE = 0.99  # where the rasteriser cuts alpha: beyond, gradients die
COLORS = 0.005, 0.995  # that logits are taken of
REPORT_EVERY_STEPS = 20


@dataclass(frozen=True)
class _Shapes:
    """What ellipsoids are, without saying which of their axes is the first: the matrices R diag(logits) R^T.

    Attributes:
        sizes: (N,) the mean of the three scale logits.
        matrices: (9, N) the rest of it, symmetric and traceless, row by row.
    """

    sizes: Tensor
    matrices: Tensor

    @classmethod
    def of(cls, scale_logits: Tensor, quats: Tensor) -> _Shapes:
        """Of (N, 3) logits and (N, 4) quaternions."""
        # Gaussians last: all of this runs along them.
        logits, turns = scale_logits.T.contiguous(), rotations(quats)
        sizes = logits.mean(0)
        stretched = turns * (logits - sizes)
        return cls(sizes, (stretched[:, None] * turns).sum(2).view(9, -1))

    def part(self, some: Tensor) -> _Shapes:
        """Those at `some` (n,) int64."""
        return _Shapes(self.sizes.index_select(0, some), self.matrices.T.index_select(0, some).T)


def rotations(quats: Tensor) -> Tensor:
    """(3, 3, N) of quaternions (N, 4) wxyz of any length."""
    w, x, y, z = torch.nn.functional.normalize(quats.T.contiguous(), dim=0)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return torch.stack([torch.stack(row) for row in rows])


def model_shape(drawable: Drawable, degree: int) -> ModelConfig:
    """Sizes that hold so many Gaussians, and a radiance field only where colours change with the direction."""
    rows = len(drawable.positions) / (PER_ROW_HARMONICS if degree else PER_ROW)
    grid = HashGridConfig(min(21, max(8, round(math.log2(max(1, rows))))), finest=FINEST)
    return ModelConfig(
        frame=drawable.frame,
        geometry=grid,
        radiance=grid if degree else SILENT,
        background=False,
        direction_encoding="sh",
        antialiased=drawable.antialiased,
    )


def initial_model(
    drawable: Drawable,
    light: Tensor,
    cameras: Sequence[Camera],
    seed: int,
    share: float = 1.0,
    report: Report = no_report,
) -> HybridModel:
    """A model of splats, as like them as regression makes it.

    Args:
        drawable: the splats; at least one. The model will be on their device.
        light: (N,) what each sends to pictures; errors count by its square root.
        cameras: that the splats' colours are looked at from.
        seed: of the first weights, and of the order.
        share: of the usual steps of regression.
        report: told of the steps, and the share of the work that is done.
    """
    degree = drawable.degree
    config = model_shape(drawable, degree)
    scales = drawable.scales.clamp_min(SMALLEST)
    shapes = _Shapes.of(logit(scales / scale_bounds(drawable.positions, config)), drawable.quats)
    opacity_logits = logit(drawable.opacities[:, None].clamp_max(OPAQUE))
    colors = (0.5 + SH_C0 * drawable.harmonics[:, 0]).clamp(*COLORS)
    gaussians = Gaussians(drawable.positions, logit(colors), shapes.sizes[:, None], opacity_logits)
    model = HybridModel(config, gaussians, torch.Generator().manual_seed(seed)).to(drawable.device)
    with torch.no_grad():
        for values in (model.radiance.weights[-1], model.radiance.biases[-1]):
            values.zero_()
    if not degree:
        model.radiance.requires_grad_(False)
    _fit(model, drawable, shapes, light, cameras if degree else (), seed, share, report)
    with torch.no_grad():  # what the field says of sizes and opacities comes off what Gaussians store
        raw = model.geometry(model.cube_coords(gaussians.positions))
        gaussians.scale_logits.copy_(shapes.sizes[:, None] - raw[:, 1:4].mean(1, keepdim=True))
        gaussians.opacity_logits.copy_(opacity_logits - raw[:, :1])
    return model


def _batches(count: int, batch: int, generator: torch.Generator, device: torch.device) -> Iterator[Tensor]:
    """Indices of `batch` of `count` rows, without end: none twice in one batch (see `take_rows`), all in each round."""
    while True:
        yield from torch.randperm(count, generator=generator).to(device).split(batch)


def _fit(
    model: HybridModel,
    drawable: Drawable,
    shapes: _Shapes,
    light: Tensor,
    cameras: Sequence[Camera],
    seed: int,
    share: float,
    report: Report,
) -> None:
    """Fit the fields: the geometry to shapes, and the radiance, with the explicit colours, to colours at cameras."""
    count = len(model)
    generator = torch.Generator().manual_seed(seed)
    weights = (light / light.mean().clamp_min(1e-30)).clamp(0, MOST_WEIGHT).sqrt()
    shapes = _Shapes(shapes.sizes, shapes.matrices.T.contiguous().T)  # what one takes of it lies together
    typical = (weights * shapes.sizes).sum() / weights.sum().clamp_min(1e-30)
    coords = model.cube_coords(drawable.positions)
    poses = (torch.as_tensor(drawable.frame.local_pose(camera), dtype=torch.float32) for camera in cameras)
    viewpoints = [camera_center(pose).to(coords.device) for pose in poses]
    no_turn = torch.eye(1, 4, device=coords.device)
    optimizer = Optimizer(model, RATES)
    whole = min(max(LEAST_STEPS, EPOCHS * count // BATCH), MOST_STEPS, max(1, MOST_WORK // count))
    batch, steps = max(BATCH, LEAST_EPOCHS * count // whole), math.ceil(share * whole)
    keep_freed_memory()
    with torch_on_one_thread():
        for step, some in zip(range(steps), _batches(count, batch, generator, coords.device), strict=False):
            if step % REPORT_EVERY_STEPS == 0:
                report(f"fitting the fields, step {step:,} of {steps:,}", step / steps)
            opacity, scales, turns = model.geometry(coords.index_select(0, some)).split((1, 3, 4), 1)
            made, wanted = _Shapes.of(scales, turns + no_turn), shapes.part(some)
            errors = (made.matrices - wanted.matrices).square().sum(0)
            errors = errors + SIZE_WEIGHT * (made.sizes + typical - wanted.sizes).square()
            errors = errors + SIZE_WEIGHT * opacity[:, 0].square()
            if viewpoints:
                viewpoint = viewpoints[int(torch.randint(0, len(viewpoints), (1,), generator=generator))]
                colors = drawable.evaluate_colors(viewpoint, some).clamp(0, 1)
                errors = errors + COLOR_WEIGHT * (model.decode_colors(viewpoint, some) - colors).square().sum(1)
            (weights.index_select(0, some) * errors).mean().backward()
            optimizer.step(step, steps)
