"""Photos of which only some pixels count."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from hyrfpack.scene import Picture, View


def mask_view(view: View, mask: np.ndarray) -> View:
    """Return a view of which only the pixels inside a mask (H, W) bool count, and inside its own mask if it has one."""
    return replace(view, load=_MaskedPhoto(view.load, mask))


@dataclass(frozen=True, eq=False)
class _MaskedPhoto:
    """Loads a photo and masks it."""

    load: Callable[[], Picture]
    mask: np.ndarray

    def __call__(self) -> Picture:
        picture = self.load()
        return replace(picture, mask=self.mask if picture.mask is None else picture.mask & self.mask)
