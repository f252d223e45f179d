"""Joins the chunks of a scene into one model."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from hyrfpack.model.gaussians import Gaussians
from hyrfpack.model.hybrid import HybridModel
from hyrfpack.model.merged import MergedModel


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


def join_parts(
    names: Sequence[str], fields: Sequence[HybridModel], chunks: Sequence[HybridModel], parts: Sequence[int]
) -> HybridModel | MergedModel:
    """Return the model of a scene: one model, or a merged model if the scene has several parts.

    Args:
        names: name of each part.
        fields: for each part, a model of its fields; a part without chunks has the Gaussians of this model.
        chunks: the models of chunks, which share the fields of their part.
        parts: number of the part of each chunk.
    """
    models = [
        join_chunks(part_fields, [chunk for chunk, part in zip(chunks, parts, strict=True) if part == number])
        for number, part_fields in enumerate(fields)
    ]
    return models[0] if len(models) == 1 else MergedModel(tuple(names), tuple(models))
