"""Renders of a model before compression, against which compressed versions are compared."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor

from hyrfpack.cameras.view_sampling import sample_views
from hyrfpack.model import Decoded, HybridModel
from hyrfpack.parallel.pool import parallel_map
from hyrfpack.render import render_view
from hyrfpack.render.in_view import colors_in_view
from hyrfpack.scene import Camera

T = TypeVar("T")

# The number of views of one comparison is chosen so that about this many Gaussians are drawn in all of them together.
COMPARISON_DRAWN_GAUSSIANS = 1_000_000
# Half of the views are at cameras and half between them.
MIN_COMPARISON_VIEWS = 6
MAX_COMPARISON_VIEWS = 10
# If the errors in two views are both higher, or both lower, than their prediction by more than this factor, the others
# are not measured: the prediction is then corrected by far more than the errors of views differ.
MAX_ROUGH_ERROR_RATIO = 6.0
# Larger changes of a colour logit are limited to this, because their exponentials would overflow float32.
MAX_LOGIT_CHANGE = 80.0


@dataclass(frozen=True)
class ReferenceRenders:
    """Renders of a model before compression, against which compressed versions are compared.

    Attributes:
        views: the cameras that were rendered.
        pictures: the render of each view, (H, W, 3) in [0, 1].
        colors: the colours (N, 3) of the model's Gaussians in each view, see `colors_in_view`; empty after calibration.
    """

    views: list[Camera]
    pictures: list[Tensor]
    colors: list[Tensor]

    @classmethod
    def from_model(
        cls, model: HybridModel, cameras: Sequence[Camera], decoded: Decoded | None = None
    ) -> ReferenceRenders:
        """Render a model, half of the views at some of its cameras and half between them.

        `decoded` is the result of `model.decode()`, if it is known.
        """
        views = COMPARISON_DRAWN_GAUSSIANS // max(len(model), 1)
        count = int(np.clip(views, MIN_COMPARISON_VIEWS, MAX_COMPARISON_VIEWS)) // 2
        # Another seed than that of sensitivities gives other views between the cameras.
        at, between = sample_views(cameras, count, seed=1)
        return cls.from_views([*at, *between], model, decoded)

    @classmethod
    def from_views(
        cls,
        views: list[Camera],
        model: HybridModel,
        decoded: Decoded | None = None,
        colors: list[Tensor] | None = None,
    ) -> ReferenceRenders:
        """Render a model at the given views; `decoded` and `colors` are as in `measure_error`.

        Raises:
            FloatingPointError: a position is NaN or infinite.
            HyrfError: another number of the model is.
        """
        decoded = model.decode() if decoded is None else decoded
        if colors is None:
            colors = _map_views(model, lambda index: colors_in_view(model, views[index], decoded), range(len(views)))
        return cls(views, _map_renders(model, views, range(len(views)), decoded, colors, lambda _, rgb: rgb), colors)

    def colors_of(self, index: np.ndarray) -> list[Tensor]:
        """Return the colours (n, 3) in each view of the Gaussians at `index` (n,)."""
        rows = torch.as_tensor(index, device=self.pictures[0].device)
        return parallel_map(lambda colors: colors.index_select(0, rows), self.colors, rows.device)

    def shift_color_logits(self, change: Tensor) -> list[Tensor]:
        """Return the colours (N, 3) in each view after a change (N, 3) of the explicit colour logits.

        The colours must be sigmoids of logits, as those of a model without colour residuals. A change d of the logit
        of a colour c multiplies its odds c / (1 - c) by r = exp(d), so the new colour is r c / (1 + (r - 1) c).
        """
        ratio = change.clamp(-MAX_LOGIT_CHANGE, MAX_LOGIT_CHANGE).exp()
        device = change.device
        return parallel_map(lambda colors: ratio * colors / (1 + (ratio - 1) * colors), self.colors, device)

    def measure_error(
        self,
        model: HybridModel,
        decoded: Decoded | None = None,
        colors: Sequence[Tensor] | None = None,
        predicted: float | None = None,
    ) -> float:
        """Render a model at the same views and return the median over views of the mean squared colour difference.

        The median ignores single views in which a Gaussian comes very close to the camera.

        Args:
            model: the model to compare with the references.
            decoded: the result of `model.decode()`, if it is known already.
            colors: the colours (N, 3) of the model's Gaussians in each view, if they are known: those of the references
                if only shapes and opacities differ.
            predicted: the predicted error. If the errors in a view at a camera and in one between cameras are both more
                than MAX_ROUGH_ERROR_RATIO times higher or both that much lower, the result is the one nearer to it.
        """
        decoded = model.decode() if decoded is None else decoded
        count = len(self.views)
        first_measured = range(count)[count // 4 :: max(1, count // 2)]  # from the middle of each half

        def error(index: int, rgb: Tensor) -> float:
            return float((rgb - self.pictures[index]).square().mean())

        def measure(indices: Sequence[int]) -> list[float]:
            return _map_renders(model, self.views, indices, decoded, colors, error)

        if predicted is None:
            return float(np.median(measure(range(count))))
        errors = measure(first_measured)
        if min(errors) > predicted * MAX_ROUGH_ERROR_RATIO:
            return min(errors)
        if max(errors) < predicted / MAX_ROUGH_ERROR_RATIO:
            return max(errors)
        return float(np.median(errors + measure([index for index in range(count) if index not in first_measured])))


def _map_renders(
    model: HybridModel,
    cameras: Sequence[Camera],
    indices: Sequence[int],
    decoded: Decoded,
    colors: Sequence[Tensor] | None,
    function: Callable[[int, Tensor], T],
) -> list[T]:
    """Render a model at the cameras at `indices`; return the function of each index and render, (H, W, 3) in [0, 1]."""

    def render(index: int) -> T:
        one_view = decoded if colors is None else replace(decoded, colors=colors[index])
        return function(index, render_view(model, cameras[index], decoded=one_view).rgb)

    return _map_views(model, render, indices)


def _map_views(model: HybridModel, function: Callable[[int], T], indices: Sequence[int]) -> list[T]:
    """Return the function of each view's index, called without gradients on the threads of the pool."""
    call = torch.no_grad()(function)  # Gradient mode is kept per thread.
    return parallel_map(call, indices, model.gaussians.positions.device)
