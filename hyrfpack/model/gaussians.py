"""The explicit part of a model: eight numbers for each Gaussian."""

from __future__ import annotations

import math

from torch import Tensor, nn

LOGIT_LIMIT = 12.0  # sigmoid is within 7e-6 of its ends there; beyond, gradients die


def logit(values: Tensor) -> Tensor:
    """The inverse of the sigmoid, clamped to +-LOGIT_LIMIT so that 0 and 1 stay finite and trainable."""
    edge = 1 / (1 + math.exp(LOGIT_LIMIT))
    values = values.double().clamp(edge, 1 - edge)
    return (values.log() - (-values).log1p()).float()


class Gaussians(nn.Module):
    """Positions and the explicit logits, one row for each Gaussian.

    Attributes:
        positions: (N, 3) local units.
        color_logits: (N, 3). scale_logits: (N, 1). opacity_logits: (N, 1).
    """

    NAMES = ("positions", "color_logits", "scale_logits", "opacity_logits")
    WIDTHS = (3, 3, 1, 1)

    def __init__(self, positions: Tensor, color_logits: Tensor, scale_logits: Tensor, opacity_logits: Tensor) -> None:
        super().__init__()
        for name, width, values in zip(
            self.NAMES, self.WIDTHS, (positions, color_logits, scale_logits, opacity_logits), strict=True
        ):
            if values.shape != (len(positions), width):
                raise ValueError(f"{name} has shape {tuple(values.shape)}; ({len(positions)}, {width}) is needed")
            setattr(self, name, nn.Parameter(values.float().contiguous()))

    def __len__(self) -> int:
        return len(self.positions)
