"""Implements activation in Triton with one launch forward and one backward; plain torch needs a dozen for each."""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.autograd.function import once_differentiable

from hyrfpack.ops.gpu_rows import count_used_rows

_GAUSSIANS_PER_PROGRAM = 128


@triton.jit
def _scale_bounds(positions, index, live, half_extent, HAS_HALF_EXTENT: tl.constexpr):
    """Return the scale bounds S(p) of a block of Gaussians, see `scale_bounds`."""
    bound = tl.full(index.shape, 1.0, tl.float32)
    if HAS_HALF_EXTENT:
        at = positions + index * 3
        x = tl.load(at, mask=live, other=0.0) / half_extent[0]
        y = tl.load(at + 1, mask=live, other=0.0) / half_extent[1]
        z = tl.load(at + 2, mask=live, other=0.0) / half_extent[2]
        length = tl.sqrt_rn(x * x + y * y + z * z)
        bound = tl.where(length < 1, bound, length)  # Unlike a maximum, this keeps NaN.
    return bound


@triton.jit(do_not_specialize=["total", "raw_row", "raw_column"])
def activate(
    raw, raw_row, raw_column, positions, scale_logits, opacity_logits, half_extent, total, used,
    scales, quats, opacities,
    HAS_HALF_EXTENT: tl.constexpr, RULE_IS_SUM: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Write scales (N, 3), quats (N, 4) and opacities (N,)."""
    index = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    count = count_used_rows(used, total)
    if tl.program_id(0) * BLOCK >= count:
        return
    live = index < count
    first = raw + index * raw_row
    opacity = tl.load(first, mask=live, other=0.0) + tl.load(opacity_logits + index, mask=live, other=0.0)
    tl.store(opacities + index, tl.sigmoid(opacity), mask=live)
    bound = _scale_bounds(positions, index, live, half_extent, HAS_HALF_EXTENT)
    explicit = tl.load(scale_logits + index, mask=live, other=0.0)
    for axis in tl.static_range(3):
        neural = tl.load(first + (1 + axis) * raw_column, mask=live, other=0.0)
        share = tl.sigmoid(neural + explicit) if RULE_IS_SUM else tl.sigmoid(neural) * tl.sigmoid(explicit)
        tl.store(scales + index * 3 + axis, share * bound, mask=live)
    for part in tl.static_range(4):
        neural = tl.load(first + (4 + part) * raw_column, mask=live, other=0.0)
        tl.store(quats + index * 4 + part, neural + 1 if part == 0 else neural, mask=live)


@triton.jit(do_not_specialize=["total", "raw_row", "raw_column", "grad_row", "grad_column"])
def activate_backward(
    raw, raw_row, raw_column, positions, scale_logits, half_extent, opacities, grad_scales, grad_quats, grad_opacities,
    total, used, grad_raw, grad_row, grad_column, grad_scale_logits, grad_opacity_logits,
    HAS_HALF_EXTENT: tl.constexpr, RULE_IS_SUM: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Write the gradients of raw (N, 8) and of both logits (N, 1)."""
    index = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    count = count_used_rows(used, total)
    if tl.program_id(0) * BLOCK >= count:
        return
    live = index < count
    first, grad_first = raw + index * raw_row, grad_raw + index * grad_row
    opacity = tl.load(opacities + index, mask=live, other=0.0)
    grad = tl.load(grad_opacities + index, mask=live, other=0.0) * opacity * (1 - opacity)
    tl.store(grad_first, grad, mask=live)
    tl.store(grad_opacity_logits + index, grad, mask=live)
    bound = _scale_bounds(positions, index, live, half_extent, HAS_HALF_EXTENT)
    explicit = tl.load(scale_logits + index, mask=live, other=0.0)
    total_grad = tl.zeros_like(explicit)
    for axis in tl.static_range(3):
        neural = tl.load(first + (1 + axis) * raw_column, mask=live, other=0.0)
        grad = tl.load(grad_scales + index * 3 + axis, mask=live, other=0.0) * bound
        if RULE_IS_SUM:
            share = tl.sigmoid(neural + explicit)
            grad *= share * (1 - share)
            total_grad += grad
        else:
            neural_share, explicit_share = tl.sigmoid(neural), tl.sigmoid(explicit)
            grad *= neural_share * explicit_share
            total_grad += grad * (1 - explicit_share)
            grad *= 1 - neural_share
        tl.store(grad_first + (1 + axis) * grad_column, grad, mask=live)
    tl.store(grad_scale_logits + index, total_grad, mask=live)
    for part in tl.static_range(4):
        grad = tl.load(grad_quats + index * 4 + part, mask=live, other=0.0)
        tl.store(grad_first + (4 + part) * grad_column, grad, mask=live)


class _Activate(torch.autograd.Function):
    """Autograd function of `activate_geometry`; computes the gradients of `raw` and of both logits."""

    @staticmethod
    def forward(
        ctx,
        raw: Tensor,
        positions: Tensor,
        scale_logits: Tensor,
        opacity_logits: Tensor,
        half_extent: tuple[float, float, float] | None,
        rule: str,
        used: Tensor | None,
    ) -> tuple[Tensor, Tensor, Tensor]:
        raw, total = raw.detach(), len(raw)
        positions, scale_logits, opacity_logits = (
            tensor.detach().contiguous() for tensor in (positions, scale_logits, opacity_logits)
        )
        scales, quats, opacities = raw.new_empty(total, 3), raw.new_empty(total, 4), raw.new_empty(total)
        ctx.half_extent = tuple(half_extent or (1.0, 1.0, 1.0))
        ctx.constants = {
            "HAS_HALF_EXTENT": half_extent is not None,
            "RULE_IS_SUM": rule == "sum",
            "BLOCK": _GAUSSIANS_PER_PROGRAM,
            "num_warps": 4,
        }
        if total:
            activate[(triton.cdiv(total, _GAUSSIANS_PER_PROGRAM),)](
                raw, *raw.stride(), positions, scale_logits, opacity_logits, ctx.half_extent, total, used,
                scales, quats, opacities, **ctx.constants, enable_fp_fusion=True,
            )  # fmt: skip
        ctx.save_for_backward(raw, positions, scale_logits, opacities, used)
        return scales, quats, opacities

    @staticmethod
    @once_differentiable
    def backward(ctx, grad_scales: Tensor, grad_quats: Tensor, grad_opacities: Tensor) -> tuple[Tensor | None, ...]:
        raw, positions, scale_logits, opacities, used = ctx.saved_tensors
        total = len(raw)
        grad_raw = torch.empty_like(raw)  # This has the strides of `raw`, unless elements of `raw` share memory.
        grad_scale_logits, grad_opacity_logits = raw.new_empty(total, 1), raw.new_empty(total, 1)
        if total:
            activate_backward[(triton.cdiv(total, _GAUSSIANS_PER_PROGRAM),)](
                raw, *raw.stride(), positions, scale_logits, ctx.half_extent, opacities,
                grad_scales.contiguous(), grad_quats.contiguous(), grad_opacities.contiguous(), total, used,
                grad_raw, *grad_raw.stride(), grad_scale_logits, grad_opacity_logits,
                **ctx.constants, enable_fp_fusion=True,
            )  # fmt: skip
        return grad_raw, None, grad_scale_logits, grad_opacity_logits, None, None, None


def activate_geometry(
    raw: Tensor,
    positions: Tensor,
    scale_logits: Tensor,
    opacity_logits: Tensor,
    half_extent: tuple[float, float, float] | None,
    rule: str,
    used: Tensor | None = None,
) -> tuple[Tensor, Tensor, Tensor]:
    """Compute `hyrfpack.ops.activate.activate_geometry` without a gradient of positions."""
    return _Activate.apply(raw, positions, scale_logits, opacity_logits, half_extent, rule, used)
