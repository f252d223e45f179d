"""Joins the chunks of a scene to one model."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from hyrfpack.model.gaussians import Gaussians
from hyrfpack.model.hybrid import HybridModel


def join_chunks(fields: HybridModel, chunks: Sequence[HybridModel]) -> HybridModel:
    """Return one model of the Gaussians of all chunks, in their order, with the fields of `fields`."""
    models = chunks or [fields]
    names = fields.gaussians.names
    joined = Gaussians(
        **{name: torch.cat([getattr(model.gaussians, name).detach() for model in models]) for name in names}
    )
    sizes = [model.gaussians.pixel_sizes for model in models if model.gaussians.pixel_sizes is not None]
    joined.pixel_sizes = torch.cat(sizes) if len(sizes) == len(models) else None
    return fields.with_gaussians(joined).requires_grad_(False)
