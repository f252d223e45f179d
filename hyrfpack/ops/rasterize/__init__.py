"""Rasterises 3D Gaussians to an image, differentiably."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from torch import Tensor

from hyrfpack.ops.dispatch import choose_implementation
from hyrfpack.ops.finite import all_finite
from hyrfpack.ops.rasterize import reference
from hyrfpack.ops.rasterize.inputs import INPUT_SHAPES, Gaussians3D, RasterSettings, check_shapes
from hyrfpack.ops.shade import Shading
from hyrfpack.ops.viewport import Viewport

__all__ = ["INPUT_SHAPES", "Gaussians3D", "RasterSettings", "Rasterization", "Viewport", "rasterize"]


@dataclass(frozen=True)
class Rasterization:
    """An image of the Gaussians alone, without background.

    Attributes:
        rgb: (H, W, 3) sum over Gaussians of T alpha color.
        transmittance: (H, W) the share of light that passes all Gaussians; differentiable like rgb.
        depth: (H, W) mean camera z weighted by T alpha, in world units, 0 where nothing is hit; not differentiable.
            None unless requested.
        visible: (N,) bool, whether a Gaussian is in front of the near plane and reaches alpha >= 1/255 in some tile.
        pairs: number of (Gaussian, tile) pairs blended, or reserved.
        seconds: wall time of the stages project, sort, bin and blend, and of cull and decode if colours were decoded;
            empty on the GPU, where the stages run asynchronously.
        nonfinite: names of the inputs (means, quats, scales, opacities, colors) that contain NaN or infinity. Such
            Gaussians are skipped or corrupt the pixels they cover; callers must check this field.
        demand: None, or if pairs are reserved, (2,) int64 on the device, which callers must check instead: not 0 if an
            input contains NaN or infinity; and the number of pairs. If it exceeds the reserve, Gaussians are missing.
    """

    rgb: Tensor
    transmittance: Tensor
    depth: Tensor | None
    visible: Tensor
    pairs: int
    seconds: dict[str, float]
    nonfinite: tuple[str, ...]
    demand: Tensor | None = None


def rasterize(
    gaussians: Gaussians3D,
    colors: Tensor | Shading,
    viewport: Viewport,
    settings: RasterSettings = RasterSettings(),  # noqa: B008 - frozen
    *,
    absgrad: Tensor | None = None,
    used: Tensor | None = None,
    reserve: int | None = None,
    implementation: str = "auto",
) -> Rasterization:
    """Render 3D Gaussians from a camera (3D Gaussian Splatting, Kerbl et al. 2023).

    Each Gaussian is projected to a 2D Gaussian (EWA, with a low-pass filter of 0.3 px^2 by default). The 2D Gaussians
    are blended front to back, in the order of camera z and then of index:

        alpha = min(0.99, opacity exp(-1/2 d^T Sigma^-1 d)),  skipped below 1/255
        rgb = sum_i T_i alpha_i color_i,   T_i = product over j < i of (1 - alpha_j)

    A pixel is finished once T <= transmittance_min, so that it loses less than this share of its light. (The 3DGS
    kernels also skip the Gaussian that would lower T to this value, and thereby lose up to 1 % of the light.) Gradients
    flow to means, quats, scales, opacities and colors, but not to the camera. No gradient passes through an alpha that
    is clamped to 0.99, as in autograd; the 3DGS kernels let it pass. Results do not depend on the number of threads.

    With a `Shading` in place of colours, the result equals that of `frustum_cull`, `shade` from the camera's centre and
    this function, and is not differentiable. "gpu" runs all steps before binning in one kernel, which decodes a colour
    while it projects, and only for a Gaussian that is drawn.

    Args:
        gaussians: N Gaussians.
        colors: (N, 3) RGB, or the colour decoder of these N Gaussians.
        viewport: the camera.
        settings: near plane, antialiasing, transmittance_min, depth, culling and low-pass filter.
        absgrad: (N, 2) buffer to which backward adds the sums over pixels of |dL/d mean2d| (x, y) in 1/px,
            the criterion of densification by absolute gradients.
        used: the number of Gaussians in use, see `hyrfpack.ops.rows`, for "gpu"; None if all are.
        reserve: number of (Gaussian, tile) pairs that "gpu" reserves memory for, without waiting for their number; see
            `Rasterization.demand`. None waits, and reserves as many as there are.
        implementation: "auto", "reference", "cpu" or "gpu"; with a `Shading` "reference" runs each step in its fastest
            implementation, and there is no "cpu".

    Raises:
        FloatingPointError: with a `Shading`, a centre is NaN or infinite ("reference"; "gpu" reports it as
            `nonfinite`).
        ValueError: shapes, dtypes or devices do not match; pairs are reserved for another implementation than "gpu"; or
            `absgrad`, `used` or `reserve` is given with a `Shading`.
        MemoryError: there are more (Gaussian, tile) pairs than "cpu" (2^28) or "gpu" (2^31) can index.

    Example:
        >>> shape = torch.tensor([[0.0, 0.0, 2.0]]), torch.tensor([[1.0, 0.0, 0.0, 0.0]]), torch.full((1, 3), 0.1)
        >>> gaussians, red = Gaussians3D(*shape, torch.tensor([0.9])), torch.tensor([[1.0, 0.0, 0.0]])
        >>> image = rasterize(gaussians, red, Viewport(torch.eye(4), (32.0, 32.0, 16.0, 16.0), 32, 32))
        >>> image.rgb.shape, bool(image.rgb[16, 16, 0] > 0.8)
        (torch.Size([32, 32, 3]), True)
    """
    if isinstance(colors, Shading):
        from hyrfpack.ops.rasterize.shaded import rasterize_shaded

        if any(value is not None for value in (absgrad, used, reserve)):
            raise ValueError("absgrad, used and reserve need colours, not a Shading")
        return rasterize_shaded(gaussians, colors, viewport, settings, implementation)
    check_shapes(gaussians, colors)
    count, dtype = len(gaussians.means), gaussians.means.dtype
    if absgrad is not None and (absgrad.shape != (count, 2) or absgrad.dtype != dtype):
        raise ValueError(f"absgrad is {absgrad.dtype} {tuple(absgrad.shape)}, expected {dtype} {(count, 2)}")

    chosen = choose_implementation("rasterize", implementation, ("reference", "cpu", "gpu"), *gaussians, colors)
    if chosen == "gpu":
        from hyrfpack.ops.rasterize import gpu

        return Rasterization(*gpu.rasterize(gaussians, colors, viewport, settings, absgrad, used, reserve))
    if used is not None or reserve is not None:
        raise ValueError(f"the {chosen} implementation reserves no pairs and takes all Gaussians")
    run: Callable[..., tuple] = reference.rasterize
    if chosen == "cpu":
        from hyrfpack.ops.rasterize import cpu

        run = cpu.rasterize
    results = run(gaussians, colors, viewport, settings, absgrad)
    inputs = zip(INPUT_SHAPES, (*gaussians, colors), strict=True)
    results += (tuple(name for name, tensor in inputs if not all_finite(tensor)),)
    return Rasterization(*results)
