"""Photos of which only some pixels count."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from hyrfpack.scene import Picture, View

if TYPE_CHECKING:
    from torch import Tensor

# Two renders show the same in a pixel if no channel differs by more. Gaussians that are hardly seen change pixels by
# less, cuts, removed objects and other parts by more.
MAX_SAME_PIXEL_DIFFERENCE = 8 / 255


def mask_view(view: View, mask: np.ndarray) -> View:
    """Return a view of which only the pixels inside a mask (H, W) bool count, and inside its own mask if it has one."""
    return replace(view, load=_MaskedPhoto(view.load, mask))


def mask_differing_pixels(view: View, first: Tensor, second: Tensor) -> View | None:
    """Return a view of which only the pixels count in which two renders show the same; None if there are none.

    Args:
        view: the view.
        first, second: (H, W, 3) renders of two models from the camera of the view.
    """
    shows_same = (first - second).abs().amax(-1) <= MAX_SAME_PIXEL_DIFFERENCE
    return mask_view(view, shows_same.numpy(force=True)) if shows_same.any() else None


@dataclass(frozen=True, eq=False)
class _MaskedPhoto:
    """Loads a photo and masks it."""

    load: Callable[[], Picture]
    mask: np.ndarray

    def __call__(self) -> Picture:
        picture = self.load()
        return replace(picture, mask=self.mask if picture.mask is None else picture.mask & self.mask)
