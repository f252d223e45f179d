"""Composites an image over a background that is given at a grid of its pixels."""

from __future__ import annotations

from collections.abc import Callable

from torch import Tensor

from hyrfpack.ops.background import grid_size
from hyrfpack.ops.composite import reference
from hyrfpack.ops.dispatch import choose_implementation

__all__ = ["composite"]


def composite(rgb: Tensor, transmittance: Tensor, grid: Tensor, stride: int, *, implementation: str = "auto") -> Tensor:
    """Composite an image over the background: C = C_fg + T B, with B interpolated bilinearly between grid nodes.

    Args:
        rgb: (H, W, 3) C_fg, the foreground, premultiplied by its alpha.
        transmittance: (H, W) T, the transmittance of the foreground.
        grid: (R, S, 3), in any layout, B at the pixels 0, stride, 2 stride, ... of both axes, as returned by
            `background_grid`. The last node of an axis lies at or past the image's edge.
        stride: pixels between neighbouring nodes, at least 1.
        implementation: "auto", "reference", "cpu" or "gpu" (the last two take float32). On CUDA the reference
            accumulates its gradient by atomics, so that equal runs differ; "gpu" gathers each node's gradient in a
            fixed order, and so does "cpu", for any number of threads.

    Returns:
        (H, W, 3). Differentiable once in `rgb`, `transmittance` and `grid`.

    Raises:
        ValueError: shapes, dtypes or devices do not match.

    Example:
        >>> import torch
        >>> nodes = torch.tensor([0.0, 1.0, 2.0])[None, :, None].expand(1, 3, 3)
        >>> composite(torch.zeros(1, 5, 3), torch.full((1, 5), 0.5), nodes, 2)[0, :, 0]
        tensor([0.0000, 0.2500, 0.5000, 0.7500, 1.0000])
    """
    height, width = transmittance.shape
    fits = stride >= 1 and grid.shape == (*grid_size(height, width, stride), 3)
    if not fits or rgb.shape != (height, width, 3):
        raise ValueError(
            f"a picture {tuple(rgb.shape)}, transmittance {(height, width)} and a grid {tuple(grid.shape)} at every "
            f"{stride}-th pixel do not fit together"
        )
    run: Callable[..., Tensor] = reference.composite
    chosen = choose_implementation("composite", implementation, ("reference", "cpu", "gpu"), rgb, transmittance, grid)
    if chosen == "gpu":
        from hyrfpack.ops.composite import gpu

        run = gpu.composite
    elif chosen == "cpu":
        from hyrfpack.ops.composite import cpu

        run = cpu.composite
    return run(rgb, transmittance, grid, stride)
