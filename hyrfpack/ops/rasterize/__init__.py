"""Rasterising: 3D Gaussians and a camera to a picture, differentiably."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from torch import Tensor

from hyrfpack.ops.dispatch import choose_implementation
from hyrfpack.ops.finite import all_finite
from hyrfpack.ops.rasterize import reference
from hyrfpack.ops.rasterize.reference import TRANSMITTANCE_MIN

__all__ = ["SHAPES", "Rasterization", "check", "rasterize"]

# What each input holds of one Gaussian.
SHAPES = {"means": (3,), "quats": (4,), "scales": (3,), "opacities": (), "colors": (3,)}


@dataclass(frozen=True)
class Rasterization:
    """A picture of the Gaussians alone, with no background.

    Attributes:
        rgb: (H, W, 3) sum over Gaussians of T alpha color.
        transmittance: (H, W) the share of light that passes all Gaussians; differentiable like rgb.
        depth: (H, W) mean camera z weighted by T alpha, in world units, 0 where nothing is hit; not differentiable.
            None unless asked for.
        visible: (N,) bool, in front of the near plane and reaching alpha >= 1/255 in at least one tile.
        pairs: number of (Gaussian, tile) pairs blended.
        seconds: wall time of the stages project, sort, bin and blend; empty on the GPU, where they overlap with what
            the caller does.
        nonfinite: names of the inputs (means, quats, scales, opacities, colors) that hold NaN or infinity anywhere.
            Such Gaussians are left out or spoil what they cover; it is for the caller to refuse them.
    """

    rgb: Tensor
    transmittance: Tensor
    depth: Tensor | None
    visible: Tensor
    pairs: int
    seconds: dict[str, float]
    nonfinite: tuple[str, ...]


def rasterize(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
    camera_from_world: Tensor,
    intrinsics: tuple[float, float, float, float],
    width: int,
    height: int,
    *,
    near: float = 0.01,
    antialiased: bool = False,
    transmittance_min: float = TRANSMITTANCE_MIN,
    depth: bool = False,
    absgrad: Tensor | None = None,
    implementation: str = "auto",
) -> Rasterization:
    """Draw 3D Gaussians as a camera sees them (3D Gaussian Splatting, Kerbl et al. 2023).

    Each Gaussian is projected to a 2D Gaussian (EWA, with 0.3 px^2 of low-pass) and blended front to back, by camera
    z and then by index:

        alpha = min(0.99, opacity exp(-1/2 d^T Sigma^-1 d)),  skipped below 1/255
        rgb = sum_i T_i alpha_i color_i,   T_i = product over j < i of (1 - alpha_j)

    and a pixel is finished once T <= transmittance_min, so that less than this of its light is missed (the 3DGS kernels
    also leave out the Gaussian that would take T there, and with it up to 1 % of the light). Gradients reach means,
    quats, scales, opacities and colors, not the camera; none passes through an alpha that is cut at 0.99 (as autograd
    has it; the 3DGS kernels let it through). Results do not depend on the number of threads.

    Args:
        means: (N, 3) centres in world units.
        quats: (N, 4) wxyz of any length; normalised here. Zero counts as no rotation.
        scales: (N, 3) standard deviations along the rotated axes, in world units, > 0.
        opacities: (N,) in [0, 1].
        colors: (N, 3) RGB.
        camera_from_world: (4, 4) rigid transform, best in float64; OpenCV axes.
        intrinsics: (fx, fy, cx, cy) in pixels; the first pixel's centre is (0.5, 0.5).
        width, height: picture size in pixels.
        near: Gaussians with camera z <= near, in world units and >= 0, are left out.
        antialiased: scale opacities by sqrt(det(Sigma) / det(Sigma + 0.3 I)), so that the low-pass adds no light.
        transmittance_min: T at which a pixel is finished, in [0, 1); 0 blends all.
        depth: also return depth.
        absgrad: (N, 2) buffer to which backward adds the sums over pixels of |dL/d mean2d| (x, y) in 1/px,
            the signal of abs-gradient densification.
        implementation: "auto", "reference", "cpu" or "gpu".

    Raises:
        ValueError: shapes, dtypes or devices that do not fit, or a picture without pixels.
        MemoryError: more pairs of a Gaussian and a tile than "cpu" (2^28) or "gpu" (2^31) can number.

    Example:
        >>> one = torch.tensor([[0.0, 0.0, 2.0]]), torch.tensor([[1.0, 0.0, 0.0, 0.0]]), torch.full((1, 3), 0.1)
        >>> red, light = torch.tensor([[1.0, 0.0, 0.0]]), torch.tensor([0.9])
        >>> drawn = rasterize(*one, light, red, torch.eye(4), (32.0, 32.0, 16.0, 16.0), 32, 32)
        >>> drawn.rgb.shape, bool(drawn.rgb[16, 16, 0] > 0.8)
        (torch.Size([32, 32, 3]), True)
    """
    inputs = (means, quats, scales, opacities, colors)
    named = dict(zip(SHAPES, inputs, strict=True))
    check(named, camera_from_world, width, height, near, transmittance_min)
    if absgrad is not None and (absgrad.shape != (len(means), 2) or absgrad.dtype != means.dtype):
        raise ValueError(f"absgrad is {absgrad.dtype} {tuple(absgrad.shape)}, expected {means.dtype} {(len(means), 2)}")

    chosen = choose_implementation(implementation, ("reference", "cpu", "gpu"), *inputs)
    run: Callable[..., tuple] = reference.rasterize
    if chosen == "gpu":
        from hyrfpack.ops.rasterize import gpu

        run = gpu.rasterize
    elif chosen == "cpu":
        from hyrfpack.ops.rasterize import cpu

        run = cpu.rasterize
    results = run(
        *inputs,
        camera_from_world,
        intrinsics,
        width,
        height,
        near=near,
        antialiased=antialiased,
        transmittance_min=transmittance_min,
        depth=depth,
        absgrad=absgrad,
    )
    if chosen != "gpu":  # whose kernels look at every number anyway
        results += (tuple(name for name, tensor in named.items() if not all_finite(tensor)),)
    return Rasterization(*results)


def check(
    inputs: Mapping[str, Tensor],
    camera_from_world: Tensor,
    width: int,
    height: int,
    near: float,
    transmittance_min: float,
) -> None:
    """Raise the ValueErrors of `rasterize` for inputs by name, some or all, and a view."""
    count = len(inputs["means"])
    for name, tensor in inputs.items():
        if tensor.shape != (count, *SHAPES[name]):
            raise ValueError(f"{name} is {tuple(tensor.shape)}, expected {(count, *SHAPES[name])}")
    if camera_from_world.shape != (4, 4):
        raise ValueError(f"camera_from_world is {tuple(camera_from_world.shape)}, expected (4, 4)")
    if not near >= 0:
        raise ValueError(f"near is {near}, expected a distance in front of the camera")
    if not 0 <= transmittance_min < 1:
        raise ValueError(f"transmittance_min is {transmittance_min}; it must lie in [0, 1)")
    if width < 1 or height < 1:
        raise ValueError(f"a picture of {width} x {height} has no pixels")
