"""The explicit part of a model, which has eight numbers per Gaussian."""

from __future__ import annotations

import math

from torch import Tensor, nn

LOGIT_LIMIT = 12.0  # There the sigmoid is within 7e-6 of 0 or 1; beyond, its gradient vanishes.


def logit(values: Tensor) -> Tensor:
    """Return the inverse of the sigmoid, clamped to +-LOGIT_LIMIT so that 0 and 1 give finite, trainable logits."""
    edge = 1 / (1 + math.exp(LOGIT_LIMIT))
    values = values.double().clamp(edge, 1 - edge)
    return (values.log() - (-values).log1p()).float()


class Gaussians(nn.Module):
    """Positions and explicit logits, one row per Gaussian.

    Attributes:
        positions: (N, 3) in local units.
        color_logits: (N, 3) explicit RGB logits.
        scale_logits: (N, 1) explicit logit of the scale.
        opacity_logits: (N, 1) explicit logit of the opacity.
        shape_residuals, color_residuals: (N, 5) and (N, 3 K) corrections of what the fields predict, see
            `hyrfpack.model.residuals`; None in a model without them. Models with residuals are not trained.
        pixel_sizes: (N,) the size of a photo's pixel at each Gaussian, in local units, of the photo that shows it at
            the highest rate. None if the photos' cameras are not known, as in training. It is not trained, and files
            do not store it. `hyrfpack.render_view` samples the Gaussians no more finely.
    """

    PARAMETER_NAMES = ("positions", "color_logits", "scale_logits", "opacity_logits")
    PARAMETER_WIDTHS = (3, 3, 1, 1)
    RESIDUAL_NAMES = ("shape_residuals", "color_residuals")
    positions: Tensor
    color_logits: Tensor
    scale_logits: Tensor
    opacity_logits: Tensor
    shape_residuals: Tensor | None
    color_residuals: Tensor | None
    pixel_sizes: Tensor | None

    def __init__(
        self,
        positions: Tensor,
        color_logits: Tensor,
        scale_logits: Tensor,
        opacity_logits: Tensor,
        shape_residuals: Tensor | None = None,
        color_residuals: Tensor | None = None,
    ) -> None:
        super().__init__()
        for name, width, values in zip(
            self.PARAMETER_NAMES,
            self.PARAMETER_WIDTHS,
            (positions, color_logits, scale_logits, opacity_logits),
            strict=True,
        ):
            if values.shape != (len(positions), width):
                raise ValueError(f"{name} has shape {tuple(values.shape)}; ({len(positions)}, {width}) is needed")
            setattr(self, name, nn.Parameter(values.float().contiguous()))
        for name, residuals in zip(self.RESIDUAL_NAMES, (shape_residuals, color_residuals), strict=True):
            self.register_buffer(name, None if residuals is None else residuals.detach().float().contiguous())
        self.register_buffer("pixel_sizes", None, persistent=False)

    @property
    def names(self) -> tuple[str, ...]:
        """The names of all values that these Gaussians have: the parameters, and the residuals if there are any."""
        return (*self.PARAMETER_NAMES, *(name for name in self.RESIDUAL_NAMES if getattr(self, name) is not None))

    def subset(self, index: Tensor) -> Gaussians:
        """Return copies of the Gaussians at `index` (n,) int64."""
        subset = Gaussians(**{name: getattr(self, name).detach()[index] for name in self.names})
        subset.pixel_sizes = None if self.pixel_sizes is None else self.pixel_sizes[index]
        return subset

    def __len__(self) -> int:
        return len(self.positions)
