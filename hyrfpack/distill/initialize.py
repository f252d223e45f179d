"""Initialise a distilled model: copy explicit values of the splats, and fit the fields by regression.

The explicit values that a model stores for each Gaussian (position, one size, opacity, colour) are copied. Anisotropic
scales, rotations and view-dependent colours come from the fields, which are fitted by regression over the Gaussians
before anything is rendered.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from hyrfpack.config.train import LearningRates
from hyrfpack.model import HashGridConfig, HybridModel, ModelConfig
from hyrfpack.model.gaussians import Gaussians, logit
from hyrfpack.model.hybrid import scale_bounds
from hyrfpack.ops.poses import camera_center
from hyrfpack.parallel.pool import keep_freed_memory, torch_on_one_thread
from hyrfpack.progress import Progress, TaskEvent, ignore_progress
from hyrfpack.scene import Camera
from hyrfpack.splats.draw import Drawable
from hyrfpack.splats.harmonics import SH_C0
from hyrfpack.train.optimizer import Optimizer

# The number of Gaussians for each row of a level determines the size of the hash tables. With harmonics the tables are
# larger, because the model must learn view-dependent colours. Its source is then also 2 to 4 times as large.
GAUSSIANS_PER_ROW = 8
GAUSSIANS_PER_ROW_WITH_HARMONICS = 2
# Vertices of the finest level along each axis.
FINEST_RESOLUTION = 1024
# A radiance field that does not affect colours gets the smallest hash grid.
UNUSED_FIELD_GRID = HashGridConfig(4, levels=1, base=2, finest=2)
# Smaller scales, in local units, are raised to this: half a pixel if the box is 1000 pixels wide.
MIN_SCALE_LOCAL = 2e-4
# Many steps of small batches fit better than few steps of large batches that take the same time.
MIN_BATCH_GAUSSIANS = 4096
TARGET_EPOCHS = 80
MIN_STEPS = 2400
MAX_STEPS = 6000
# With many Gaussians the hash tables are large, and the time of a step grows with their size for any batch. So
# there are fewer steps, with larger batches.
MAX_STEPS_TIMES_GAUSSIANS = 1_000_000_000
MIN_EPOCHS = 16
REGRESSION_RATES = LearningRates(fields=(4e-3, 1e-4), color_logits=(1e-2, 1e-3))
# The loss of sizes and opacities has a low weight, because the explicit values correct them; shapes have weight 1.
SIZE_LOSS_WEIGHT = 0.1
# Weights of Gaussians are clamped to this multiple of their mean.
MAX_RELATIVE_WEIGHT = 10.0
COLOR_LOSS_WEIGHT = 10.0
# The rasteriser clamps alpha here, so opacities above it have no gradient.
MAX_OPACITY = 0.99
# Colours are clamped to this range before their logits are taken.
COLOR_RANGE = 0.005, 0.995
REPORT_EVERY_STEPS = 20


@dataclass(frozen=True)
class _EllipsoidShapes:
    """Shapes of ellipsoids as matrices R diag(logits) R^T, which do not depend on the order of the axes.

    Attributes:
        sizes: (N,) the mean of the three scale logits.
        matrices: (9, N) the symmetric, traceless remainder of the matrices, row by row.
    """

    sizes: Tensor
    matrices: Tensor

    @classmethod
    def from_logits(cls, scale_logits: Tensor, quats: Tensor) -> _EllipsoidShapes:
        """Compute the shapes of (N, 3) scale logits and (N, 4) quaternions wxyz."""
        # Gaussians are the last axis, so that all operations run over contiguous memory.
        logits, turns = scale_logits.T.contiguous(), rotations(quats)
        sizes = logits.mean(0)
        stretched = turns * (logits - sizes)
        return cls(sizes, (stretched[:, None] * turns).sum(2).view(9, -1))

    def subset(self, index: Tensor) -> _EllipsoidShapes:
        """Return the shapes at `index` (n,) int64."""
        return _EllipsoidShapes(self.sizes.index_select(0, index), self.matrices.T.index_select(0, index).T)


def rotations(quats: Tensor) -> Tensor:
    """Return the rotation matrices (3, 3, N) of quaternions (N, 4) wxyz of any length."""
    w, x, y, z = torch.nn.functional.normalize(quats.T.contiguous(), dim=0)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return torch.stack([torch.stack(row) for row in rows])


def choose_model_config(drawable: Drawable, degree: int) -> ModelConfig:
    """Choose hash table sizes by the number of Gaussians, and a radiance field only if colours depend on the view."""
    rows = len(drawable.positions) / (GAUSSIANS_PER_ROW_WITH_HARMONICS if degree else GAUSSIANS_PER_ROW)
    grid = HashGridConfig(min(21, max(8, round(math.log2(max(1, rows))))), finest=FINEST_RESOLUTION)
    return ModelConfig(
        frame=drawable.frame,
        geometry=grid,
        radiance=grid if degree else UNUSED_FIELD_GRID,
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
    progress: Progress = ignore_progress,
) -> HybridModel:
    """Make a model of splats and fit its fields to them by regression, without rendering.

    Args:
        drawable: the splats; at least one. The model is on their device.
        light: (N,) light that each Gaussian sends to pictures; errors are weighted by its square root.
        cameras: viewpoints at which view-dependent colours are fitted.
        seed: random seed of the initial weights and of the order.
        share: share of the usual number of regression steps, above 0.
        progress: called with `TaskEvent`s.
    """
    degree = drawable.degree
    config = choose_model_config(drawable, degree)
    scales = drawable.scales.clamp_min(MIN_SCALE_LOCAL)
    shapes = _EllipsoidShapes.from_logits(logit(scales / scale_bounds(drawable.positions, config)), drawable.quats)
    opacity_logits = logit(drawable.opacities[:, None].clamp_max(MAX_OPACITY))
    colors = (0.5 + SH_C0 * drawable.harmonics[:, 0]).clamp(*COLOR_RANGE)
    gaussians = Gaussians(drawable.positions, logit(colors), shapes.sizes[:, None], opacity_logits)
    model = HybridModel(config, gaussians, torch.Generator().manual_seed(seed)).to(drawable.device)
    with torch.no_grad():
        for values in (model.radiance.weights[-1], model.radiance.biases[-1]):
            values.zero_()
    if not degree:
        model.radiance.requires_grad_(False)
    _fit_fields(model, drawable, shapes, light, cameras if degree else (), seed, share, progress)
    with torch.no_grad():  # the explicit logits of sizes and opacities compensate what the field adds to them
        raw = model.geometry(model.cube_coords(gaussians.positions))
        gaussians.scale_logits.copy_(shapes.sizes[:, None] - raw[:, 1:4].mean(1, keepdim=True))
        gaussians.opacity_logits.copy_(opacity_logits - raw[:, :1])
    return model


def _batches(count: int, batch: int, generator: torch.Generator, device: torch.device) -> Iterator[Tensor]:
    """Yield endless batches of indices: each epoch has all `count` rows, and no batch has a row twice (`take_rows`)."""
    while True:
        yield from torch.randperm(count, generator=generator).to(device).split(batch)


def _fit_fields(
    model: HybridModel,
    drawable: Drawable,
    shapes: _EllipsoidShapes,
    light: Tensor,
    cameras: Sequence[Camera],
    seed: int,
    share: float,
    progress: Progress,
) -> None:
    """Fit the geometry field to shapes, and the radiance field and explicit colours to colours seen from cameras."""
    count = len(model)
    generator = torch.Generator().manual_seed(seed)
    weights = (light / light.mean().clamp_min(1e-30)).clamp(0, MAX_RELATIVE_WEIGHT).sqrt()
    # Column-major order keeps the matrix of each Gaussian contiguous.
    shapes = _EllipsoidShapes(shapes.sizes, shapes.matrices.T.contiguous().T)
    typical = (weights * shapes.sizes).sum() / weights.sum().clamp_min(1e-30)
    coords = model.cube_coords(drawable.positions)
    poses = (torch.as_tensor(drawable.frame.local_pose(camera), dtype=torch.float32) for camera in cameras)
    viewpoints = [camera_center(pose).to(coords.device) for pose in poses]
    identity_quat = torch.eye(1, 4, device=coords.device)
    optimizer = Optimizer(model, REGRESSION_RATES)
    full_steps = min(
        max(MIN_STEPS, TARGET_EPOCHS * count // MIN_BATCH_GAUSSIANS),
        MAX_STEPS,
        max(1, MAX_STEPS_TIMES_GAUSSIANS // count),
    )
    batch, steps = max(MIN_BATCH_GAUSSIANS, MIN_EPOCHS * count // full_steps), math.ceil(share * full_steps)
    keep_freed_memory()
    with torch_on_one_thread():
        for step, index in zip(range(steps), _batches(count, batch, generator, coords.device), strict=False):
            if step % REPORT_EVERY_STEPS == 0:
                progress(TaskEvent(f"fitting the fields, step {step}/{steps}", step / steps))
            opacity, scales, turns = model.geometry(coords.index_select(0, index)).split((1, 3, 4), 1)
            predicted, target = _EllipsoidShapes.from_logits(scales, turns + identity_quat), shapes.subset(index)
            errors = (predicted.matrices - target.matrices).square().sum(0)
            errors = errors + SIZE_LOSS_WEIGHT * (predicted.sizes + typical - target.sizes).square()
            errors = errors + SIZE_LOSS_WEIGHT * opacity[:, 0].square()
            if viewpoints:
                viewpoint = viewpoints[int(torch.randint(0, len(viewpoints), (1,), generator=generator))]
                colors = drawable.evaluate_colors(viewpoint, index).clamp(0, 1)
                errors = errors + COLOR_LOSS_WEIGHT * (model.decode_colors(viewpoint, index) - colors).square().sum(1)
            (weights.index_select(0, index) * errors).mean().backward()
            optimizer.step(step, steps)
