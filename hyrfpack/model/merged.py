"""Several models in one world, drawn together."""

from __future__ import annotations

from dataclasses import dataclass

import torch

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
        """Evaluate geometry that no view changes, of all Gaussians in the order of the parts, in units of each part."""
        parts = [part.decode_geometry() for part in self.parts]
        values = zip(*((part.scales, part.quats, part.opacities) for part in parts), strict=True)
        return Decoded(Geometry(*(torch.cat(value) for value in values)), None)

    def __len__(self) -> int:
        return sum(len(part) for part in self.parts)
