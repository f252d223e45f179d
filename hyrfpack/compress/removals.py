"""The error that leaving out each Gaussian adds to pictures, of a single model or of all parts of a merged one."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from hyrfpack.cameras.view_sampling import sample_views
from hyrfpack.compress.sensitivity import (
    choose_windows,
    combine_with_prior,
    draw_signs,
    expected_opacity_sensitivity,
    measure_sensitivity,
    prior_cells,
    removal_error,
)
from hyrfpack.model import HybridModel
from hyrfpack.model.merged import MergedModel
from hyrfpack.parallel.pool import torch_on_one_thread
from hyrfpack.progress import Progress, TaskEvent, ignore_progress
from hyrfpack.render import render_view
from hyrfpack.scene import Camera


@torch_on_one_thread()
def measure_removals(
    model: HybridModel | MergedModel, cameras: Sequence[Camera], progress: Progress = ignore_progress
) -> np.ndarray:
    """Estimate the mean squared error (N,) that leaving out each Gaussian adds to pictures; see `removal_error`.

    In a merged model the parts hide each other, so their Gaussians are measured in the same pictures. Arguments and
    errors are those of `measure_sensitivity`.
    """
    if not isinstance(model, MergedModel):
        return measure_sensitivity(model, cameras, progress=progress).removals
    windows = choose_windows(cameras, len(model))
    views = windows.views
    at, _ = sample_views(cameras, len(views) // 2)
    logits = [part.gaussians.opacity_logits for part in model.parts]
    required = [values.requires_grad for values in logits]
    squares = [torch.zeros_like(values) for values in logits]
    generator, pixels = torch.Generator(logits[0].device).manual_seed(0), 0
    try:
        for values in logits:
            values.requires_grad_(True)
        for number, camera in enumerate(views):
            progress(TaskEvent(f"measuring sensitivities, view {number + 1}/{len(views)}", number / len(views)))
            rgb = render_view(model, camera).rgb
            signs = draw_signs(rgb, generator)
            pixels += rgb.numel()
            if rgb.requires_grad:
                gradients = torch.autograd.grad((rgb * signs).sum(), logits, allow_unused=True)
                for square, gradient in zip(squares, gradients, strict=True):
                    if gradient is not None:
                        square += gradient.square()
    finally:
        for values, needed in zip(logits, required, strict=True):
            values.requires_grad_(needed)
    removals = []
    for part, square in zip(model.parts, squares, strict=True):
        measured = square[:, 0].double().numpy() / pixels
        geometry = part.decode_geometry()
        guess = expected_opacity_sensitivity(part, geometry, at)
        sensitivity = combine_with_prior(prior_cells(part), measured, guess, windows.pictures)
        removals.append(removal_error(geometry.opacities.detach().double().numpy(), sensitivity))
    return np.concatenate(removals)
