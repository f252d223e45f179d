"""The source of pictures that `hyrfpack render` and `evaluate` draw: a model, or splats of another program.

This module imports torch.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch

from hyrfpack.cameras.capture import Capture
from hyrfpack.cameras.paths import Viewpoint
from hyrfpack.errors import HyrfError
from hyrfpack.format import describe_file, find_model, load_merged_model, load_model
from hyrfpack.format.scene_folder import SceneFolder, is_scene
from hyrfpack.lod import LevelRenderer
from hyrfpack.model import HybridModel
from hyrfpack.model.merged import MergedModel
from hyrfpack.splats.draw import Drawable
from hyrfpack.splats.files import bytes_on_disk, read_splats
from hyrfpack.splats.names import find_sog_folder, is_splats
from hyrfpack.splats.viewpoints import WeightedSplats


@dataclass(frozen=True)
class RenderSource:
    """A model or splats to be drawn.

    Attributes:
        path: path of the file; for a run, path of its model.
        device, precision: device and precision of drawing; splats are drawn in float32.
        fraction: share of the file that must exist, see `hyrfpack.load_model`.
        facts: description of a model, see `hyrfpack.describe_file`; None for splats.
        splats: the splats, ready to be drawn; None for a model, which `load` reads.
        scene: the scene folder that `path` names, if it is one.
    """

    path: Path
    device: torch.device
    precision: str
    fraction: float | None
    facts: dict | None = None
    splats: Drawable | None = None
    scene: SceneFolder | None = None

    @classmethod
    def open(cls, path: Path, device: torch.device, precision: str, allow_partial: bool) -> RenderSource:
        """Open a file: read splats completely, but only the first kilobytes of a model.

        Raises:
            HyrfError: the file cannot be read, or an option does not apply to splats.
        """
        if is_splats(path):
            if allow_partial:
                raise HyrfError(f"{path}: splats are read whole", fix="leave out --allow-partial")
            splats = read_splats(path)
            frame = WeightedSplats.from_splats(splats, str(path)).frame
            drawable = Drawable.from_splats(splats, frame, device, str(path))
            return cls(path, device, precision, None, splats=drawable)
        if is_scene(path):
            if allow_partial:
                raise HyrfError(f"{path}: a scene of several files is read whole", fix="leave out --allow-partial")
            return cls(find_model(path), device, precision, None, facts=describe_file(path), scene=SceneFolder(path))
        model, fraction = find_model(path), 1.0 if allow_partial else None
        return cls(model, device, precision, fraction, facts=describe_file(model, fraction))

    def load(self) -> HybridModel | MergedModel | Drawable:
        """Return the model or the splats on the device."""
        if self.splats is not None:
            return self.splats
        if self.facts is not None and "parts" in self.facts:
            merged = load_merged_model(self.path, self.device)
            for part in merged.parts:
                part.precision = self.precision
            return merged
        model = load_model(self.path, self.device, self.fraction)
        model.precision = self.precision
        return model

    def load_levels(self, gaussians: int | None, bytes: int | None) -> LevelRenderer:
        """Return a renderer that chooses levels of detail for each view, within a number of Gaussians or bytes.

        Raises:
            HyrfError: the source is no scene folder.
        """
        if self.scene is None:
            raise HyrfError(
                f"{self.path}: it has no levels of detail to choose from", fix="make them with 'hyrfpack split'"
            )
        return LevelRenderer(self.scene, gaussians=gaussians, bytes=bytes, device=self.device, precision=self.precision)

    @property
    def viewpoint(self) -> Viewpoint:
        """The viewpoint to orbit around: that of the photos, or the middle of the splats."""
        if self.splats is not None:
            frame = self.splats.frame
            return Viewpoint.from_frame(frame.center, frame.scale)
        return Capture(self.facts or {}).viewpoint

    @property
    def folder(self) -> Path | None:
        """The folder whose files are all read; None if a single file is read."""
        if self.scene is not None and self.scene.path.is_dir():
            return self.scene.path
        return find_sog_folder(self.path) if self.splats is not None else None

    @property
    def bytes(self) -> int:
        """Size on disk in bytes."""
        if self.scene is not None:
            return self.scene.manifest.total_bytes
        return bytes_on_disk(self.path)
