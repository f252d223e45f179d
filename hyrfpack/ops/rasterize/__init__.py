"""Rasterises 3D Gaussians to an image, differentiably."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from torch import Tensor

from hyrfpack.ops.dispatch import choose_implementation
from hyrfpack.ops.finite import all_finite
from hyrfpack.ops.rasterize import reference
from hyrfpack.ops.rasterize.reference import TRANSMITTANCE_MIN

__all__ = ["INPUT_SHAPES", "Rasterization", "check_inputs", "rasterize"]

# The shape of each input for one Gaussian.
INPUT_SHAPES = {"means": (3,), "quats": (4,), "scales": (3,), "opacities": (), "colors": (3,)}


@dataclass(frozen=True)
class Rasterization:
    """An image of the Gaussians alone, without background.

    Attributes:
        rgb: (H, W, 3) sum over Gaussians of T alpha color.
        transmittance: (H, W) the share of light that passes all Gaussians; differentiable like rgb.
        depth: (H, W) mean camera z weighted by T alpha, in world units, 0 where nothing is hit; not differentiable.
            None unless requested.
        visible: (N,) bool, whether a Gaussian is in front of the near plane and reaches alpha >= 1/255 in some tile.
        pairs: number of (Gaussian, tile) pairs blended.
        seconds: wall time of the stages project, sort, bin and blend; empty on the GPU, where the stages run
            asynchronously.
        nonfinite: names of the inputs (means, quats, scales, opacities, colors) that contain NaN or infinity. Such
            Gaussians are skipped or corrupt the pixels they cover; callers must check this field.
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
    """Render 3D Gaussians from a camera (3D Gaussian Splatting, Kerbl et al. 2023).

    Each Gaussian is projected to a 2D Gaussian (EWA, with a low-pass filter of 0.3 px^2). The 2D Gaussians are blended
    front to back, in the order of camera z and then of index:

        alpha = min(0.99, opacity exp(-1/2 d^T Sigma^-1 d)),  skipped below 1/255
        rgb = sum_i T_i alpha_i color_i,   T_i = product over j < i of (1 - alpha_j)

    A pixel is finished once T <= transmittance_min, so that it loses less than this share of its light. (The 3DGS
    kernels also skip the Gaussian that would lower T to this value, and thereby lose up to 1 % of the light.) Gradients
    flow to means, quats, scales, opacities and colors, but not to the camera. No gradient passes through an alpha that
    is clamped to 0.99, as in autograd; the 3DGS kernels let it pass. Results do not depend on the number of threads.

    Args:
        means: (N, 3) centres in world units.
        quats: (N, 4) wxyz of any length; they are normalised. Zero means no rotation.
        scales: (N, 3) standard deviations along the rotated axes, in world units, > 0.
        opacities: (N,) in [0, 1].
        colors: (N, 3) RGB.
        camera_from_world: (4, 4) rigid transform, preferably in float64; OpenCV axes.
        intrinsics: (fx, fy, cx, cy) in pixels; the first pixel's centre is (0.5, 0.5).
        width, height: image size in pixels.
        near: distance of the near plane in world units, >= 0. Gaussians with camera z <= near are skipped.
        antialiased: scale opacities by sqrt(det(Sigma) / det(Sigma + 0.3 I)), so that the low-pass adds no light.
        transmittance_min: T at which a pixel is finished, in [0, 1); 0 blends all Gaussians.
        depth: also compute depth.
        absgrad: (N, 2) buffer to which backward adds the sums over pixels of |dL/d mean2d| (x, y) in 1/px,
            the criterion of densification by absolute gradients.
        implementation: "auto", "reference", "cpu" or "gpu".

    Raises:
        ValueError: shapes, dtypes or devices do not match, a setting is out of range, or the image has no pixels.
        MemoryError: there are more (Gaussian, tile) pairs than "cpu" (2^28) or "gpu" (2^31) can index.

    Example:
        >>> shape = torch.tensor([[0.0, 0.0, 2.0]]), torch.tensor([[1.0, 0.0, 0.0, 0.0]]), torch.full((1, 3), 0.1)
        >>> opacities, red = torch.tensor([0.9]), torch.tensor([[1.0, 0.0, 0.0]])
        >>> image = rasterize(*shape, opacities, red, torch.eye(4), (32.0, 32.0, 16.0, 16.0), 32, 32)
        >>> image.rgb.shape, bool(image.rgb[16, 16, 0] > 0.8)
        (torch.Size([32, 32, 3]), True)
    """
    inputs = (means, quats, scales, opacities, colors)
    inputs_by_name = dict(zip(INPUT_SHAPES, inputs, strict=True))
    check_inputs(inputs_by_name, camera_from_world, width, height, near, transmittance_min)
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
    if chosen != "gpu":  # The GPU kernels check every number and have set this field already.
        results += (tuple(name for name, tensor in inputs_by_name.items() if not all_finite(tensor)),)
    return Rasterization(*results)


def check_inputs(
    inputs: Mapping[str, Tensor],
    camera_from_world: Tensor,
    width: int,
    height: int,
    near: float,
    transmittance_min: float,
) -> None:
    """Raise the ValueErrors of `rasterize` for some or all of its inputs, by name, and for a view."""
    count = len(inputs["means"])
    for name, tensor in inputs.items():
        if tensor.shape != (count, *INPUT_SHAPES[name]):
            raise ValueError(f"{name} is {tuple(tensor.shape)}, expected {(count, *INPUT_SHAPES[name])}")
    if camera_from_world.shape != (4, 4):
        raise ValueError(f"camera_from_world is {tuple(camera_from_world.shape)}, expected (4, 4)")
    if not near >= 0:
        raise ValueError(f"near is {near}, expected a distance in front of the camera")
    if not 0 <= transmittance_min < 1:
        raise ValueError(f"transmittance_min is {transmittance_min}; it must lie in [0, 1)")
    if width < 1 or height < 1:
        raise ValueError(f"a picture of {width} x {height} has no pixels")
