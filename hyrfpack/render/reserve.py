"""Memory reserved for a view, so that a GPU renders it without making the host wait for its counts."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from hyrfpack.ops.dispatch import has_triton, replaced_operations

RESERVING_OPERATIONS = {"frustum_cull", "rasterize"}


@dataclass(frozen=True)
class Reserve:
    """How much a view may need; if it needs more, its rendering lacks Gaussians, see `Rendering.demand`.

    Attributes:
        gaussians: number of Gaussians in view.
        pairs: number of (Gaussian, tile) pairs.
    """

    gaussians: int
    pairs: int

    @property
    def limits(self) -> tuple[int, int, int, int]:
        """The largest values that `Rendering.demand` may have for a complete and finite rendering."""
        return 0, self.gaussians, 0, self.pairs


def can_reserve(device: torch.device) -> bool:
    """Return whether views can be rendered into a reserve on a device: a GPU whose kernels cull and rasterise."""
    return device.type == "cuda" and has_triton() and not RESERVING_OPERATIONS & replaced_operations()
