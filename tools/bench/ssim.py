"""Measure speed and error of the photometric loss and its gradient against the torch reference in the same run."""

from __future__ import annotations

import torch
from torch import Tensor

from hyrfpack.bench.operation_calls import make_loss_call
from hyrfpack.measure.error import measure_error, measure_relative_error
from hyrfpack.measure.timing import time_alternately

TIMING_REPEATS = 7
PICTURE_SIZES = ((200, 200), (240, 320), (800, 800))  # (height, width) in pixels


def make_pictures(height: int, width: int) -> tuple[Tensor, Tensor]:
    """Return a noisy and a smooth version of one picture, each (H, W, 3) in [0, 1]."""
    random = torch.Generator().manual_seed(0)
    small = torch.rand(1, 3, height // 10, width // 10, generator=random)
    smooth = torch.nn.functional.interpolate(small, size=(height, width), mode="bilinear")[0].permute(1, 2, 0)
    noise = 0.05 * torch.randn(height, width, 3, generator=random)
    return (smooth + noise).clamp(0, 1), smooth.contiguous()


def compare(image: Tensor, target: Tensor, mask: Tensor | None) -> dict[str, float]:
    """Return the time of loss and gradient together, and the errors against float64.

    The gradient's error is relative to its largest value.
    """
    call = make_loss_call(image, target, mask)
    times, results = time_alternately(
        {implementation: call.forward_backward_task(implementation) for implementation in ("cpu", "reference")},
        TIMING_REPEATS,
    )
    (value, (gradient,)), (exact, (slope,)) = results["cpu"], call.forward_backward_task("reference", torch.float64)()
    return {
        "ms": times["cpu"].ms,
        "ns_a_pixel": 1e6 * times["cpu"].ms / image[..., 0].numel(),
        "reference_ms": times["reference"].ms,
        "times_faster": times["reference"].ratio_to(times["cpu"]).wall,
        "value_error": measure_error(value, exact, "loss").max,
        "gradient_error": measure_relative_error(gradient, slope, "gradient").max,
    }


def bench() -> list[dict]:
    """Time the loss with its gradient and the reference in alternation; times are medians."""
    rows = []
    for height, width in PICTURE_SIZES:
        image, target = make_pictures(height, width)
        half = torch.rand(height, width, generator=torch.Generator().manual_seed(1)) < 0.5
        for name, mask in (("none", None), ("half", half)):
            rows.append({"picture": f"{width}x{height}x3", "mask": name, **compare(image, target, mask)})
    return rows
