"""Several models in one world, drawn together."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from hyrfpack.errors import HyrfError
from hyrfpack.model.hybrid import Decoded, Geometry, HybridModel


@dataclass(frozen=True, eq=False)
class MergedModel:
    """Several models in one world, drawn together in one order of depth.

    Each part is a complete model with its own fields, frame and exposure map; its frame places it in the world. The
    first part is the scene: the merged model has its background, its viewpoint and its cameras.

    Attributes:
        names: name of each part; no two are equal.
        parts: the models, at least one.

    Raises:
        HyrfError: parts differ in `antialiased`, which one picture cannot mix.
    """

    names: tuple[str, ...]
    parts: tuple[HybridModel, ...]

    def __post_init__(self) -> None:
        if len({part.config.antialiased for part in self.parts}) > 1:
            raise HyrfError(
                "some of the models are antialiased and others are not, so they cannot be drawn in one picture",
                fix="train all with the same setting `antialiased`",
            )

    @property
    def scene(self) -> HybridModel:
        """The first part."""
        return self.parts[0]

    @torch.no_grad()
    def decode(self) -> Decoded:
        """Evaluate what does not depend on the view: the geometry of all Gaussians, see `decode_geometry`."""
        return Decoded(self.decode_geometry(), None)

    def decode_geometry(self) -> Geometry:
        """Evaluate the geometry of all Gaussians in the order of the parts, in units of each part."""
        parts = [part.decode_geometry() for part in self.parts]
        return Geometry(
            scales=torch.cat([geometry.scales for geometry in parts]),
            quats=torch.cat([geometry.quats for geometry in parts]),
            opacities=torch.cat([geometry.opacities for geometry in parts]),
        )

    def subset(self, index: Tensor) -> MergedModel:
        """Return a model with copies of the Gaussians at ascending `index` (n,) int64, counted over all parts.

        Parts may be left with no Gaussian. Each shares its fields with the part that it is taken from.
        """
        ends = np.cumsum([len(part) for part in self.parts])
        bounds = torch.searchsorted(index, torch.from_numpy(ends)).tolist()
        starts, firsts = [0, *bounds[:-1]], [0, *ends[:-1].tolist()]
        indices = [index[start:end] - first for start, end, first in zip(starts, bounds, firsts, strict=True)]
        subsets = (part.subset(part_index) for part, part_index in zip(self.parts, indices, strict=True))
        return MergedModel(self.names, tuple(subsets))

    def to(self, device: torch.device) -> MergedModel:
        """Return the model with all parts on a device; parts that are elsewhere are moved in place."""
        return replace(self, parts=tuple(part.to(device) for part in self.parts))

    def without_emptied_parts(self, before: Sequence[HybridModel]) -> MergedModel:
        """Return the model without the parts that have no Gaussian left.

        Args:
            before: the parts before Gaussians were removed. One that had none is kept: it shows its background.
        """
        kept = [
            (name, part)
            for name, part, earlier in zip(self.names, self.parts, before, strict=True)
            if len(part) or not len(earlier)
        ]
        names, parts = zip(*kept, strict=True)
        return MergedModel(names, parts)

    def __len__(self) -> int:
        return sum(len(part) for part in self.parts)


def parts_of(model: HybridModel | MergedModel) -> tuple[HybridModel, ...]:
    """Return the parts of a merged model, or a single model as its only part."""
    return model.parts if isinstance(model, MergedModel) else (model,)


def scene_of(model: HybridModel | MergedModel) -> HybridModel:
    """Return the model whose background, viewpoint and cameras are shown: the first part of a merged model."""
    return parts_of(model)[0]


def map_parts(
    change: Callable[[HybridModel], HybridModel], model: HybridModel | MergedModel
) -> HybridModel | MergedModel:
    """Apply a function to a model, or to each part of a merged model."""
    if isinstance(model, MergedModel):
        return replace(model, parts=tuple(map(change, model.parts)))
    return change(model)


def world_positions(model: HybridModel | MergedModel) -> np.ndarray:
    """Return the centres (N, 3) of the Gaussians of all parts in world units, float64."""
    return np.concatenate(
        [part.config.frame.to_world(part.gaussians.positions.numpy(force=True)) for part in parts_of(model)]
    )
