"""Draw a scene folder at the levels of detail that suit each view."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from copy import deepcopy
from functools import cached_property

import torch

from hyrfpack.config.render import GeometryConfig
from hyrfpack.errors import HyrfError
from hyrfpack.format.scene_folder import SceneFolder
from hyrfpack.lod.select import LevelSelection, select_levels
from hyrfpack.model import HybridModel
from hyrfpack.model.field import Field
from hyrfpack.model.merged import MergedModel, parts_of
from hyrfpack.render import RenderedPicture, RenderSettings
from hyrfpack.render.files import make_renderer
from hyrfpack.scene import Camera

MAX_CACHED_GAUSSIANS = 8_000_000


class LevelRenderer:
    """Chooses levels of detail for each view of a scene folder, and loads them.

    Attributes:
        scene: the scene folder.
        gaussians, bytes: limits of each view, see `select_levels`.
        choices: the choice for each view that was loaded, in order.
    """

    def __init__(
        self,
        scene: SceneFolder,
        *,
        gaussians: int | None = None,
        bytes: int | None = None,
        device: str | torch.device = "cpu",
        precision: str = "mixed",
    ) -> None:
        """Check the limits of each view, see `select_levels`.

        Raises:
            HyrfError: the limit is too small for any chunk.
        """
        levels = [level for chunk in scene.manifest.chunks for level in chunk.levels]
        if bytes is None:
            unit, limit, min_limit = "Gaussians", gaussians, min((level.gaussians for level in levels), default=0)
        else:
            unit, limit = "bytes", bytes
            min_limit = scene.manifest.shared_bytes + min((level.bytes for level in levels), default=0)
        if limit is not None and limit < min_limit:
            raise HyrfError(
                f"{scene.path}: no chunk can be drawn within {limit:,} {unit}",
                fix=f"allow at least {min_limit:,} {unit}",
            )
        self.scene, self.gaussians, self.bytes = scene, gaussians, bytes
        self.choices: list[LevelSelection] = []
        self._device, self._precision = device, precision
        self._chunks: OrderedDict[tuple[int, int], HybridModel] = OrderedDict()
        # The levels and the model of the last view, and its renderer, because neighbouring views often share them.
        self._last: tuple[list[int | None], HybridModel | MergedModel] | None = None
        self._last_renderer: tuple[GeometryConfig, RenderSettings, Callable[[Camera], RenderedPicture]] | None = None

    def load(self, camera: Camera) -> tuple[HybridModel | MergedModel, LevelSelection]:
        """Return a model of the levels that are chosen for a view, and the choice.

        Views with the same levels in a row share one model. All models of a renderer share their fields.

        Raises:
            HyrfFormatError: a file is missing or damaged.
        """
        choice = select_levels(self.scene.manifest, camera, gaussians=self.gaussians, bytes=self.bytes)
        self.choices.append(choice)
        if self._last is None or self._last[0] != choice.levels:
            self._last = self._last_renderer = None  # frees the memory before the next model is joined
            self._last = choice.levels, self._join_chunks(choice.levels)
        return self._last[1], choice

    def draw(
        self,
        camera: Camera,
        *,
        geometry: GeometryConfig = GeometryConfig(),  # noqa: B008 - frozen
        settings: RenderSettings = RenderSettings(),  # noqa: B008 - frozen
    ) -> RenderedPicture:
        """Render a view at the levels that are chosen for it. The arguments are those of `make_renderer`."""
        model, _ = self.load(camera)
        last = self._last_renderer
        if last is None or last[:2] != (geometry, settings):
            self._last_renderer = None  # frees the memory before the model is decoded again
            last = self._last_renderer = geometry, settings, make_renderer(model, geometry=geometry, settings=settings)
        return last[2](camera)

    def _join_chunks(self, levels: list[int | None]) -> HybridModel | MergedModel:
        """Return one model of the chunks at these levels, which shares the fields of this renderer."""
        chunks = [None if level is None else self._load_chunk(number, level) for number, level in enumerate(levels)]
        model = self.scene.join(chunks)
        for part, (geometry, radiance) in zip(parts_of(model), self._fields, strict=True):
            part.geometry, part.radiance = geometry, radiance
            part.to(self._device)
            part.precision = self._precision
        return model

    @cached_property
    def _fields(self) -> list[tuple[Field, Field]]:
        """Return the fields of each part on the device, as copies, because moving them would move those of `scene`."""
        return [
            (deepcopy(part.geometry).to(self._device), deepcopy(part.radiance).to(self._device))
            for part in self.scene.fields
        ]

    def _load_chunk(self, number: int, level: int) -> HybridModel:
        """Return the model of a chunk at a level, from the cache if possible."""
        key = (number, level)
        if key not in self._chunks:
            self._chunks[key] = self.scene.load_chunk(number, level)
        self._chunks.move_to_end(key)
        while len(self._chunks) > 1 and sum(map(len, self._chunks.values())) > MAX_CACHED_GAUSSIANS:
            self._chunks.popitem(last=False)
        return self._chunks[key]
