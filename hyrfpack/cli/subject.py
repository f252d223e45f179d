"""What `hyrfpack render` and `evaluate` draw: a model, or splats of another program. Loads torch."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch

from hyrfpack.cameras.capture import Capture
from hyrfpack.cameras.paths import Viewpoint
from hyrfpack.errors import HyrfError
from hyrfpack.format import describe, find_model, load
from hyrfpack.model import HybridModel
from hyrfpack.splats.draw import Drawable
from hyrfpack.splats.files import read_splats
from hyrfpack.splats.names import bytes_on_disk, is_splats, sog_folder
from hyrfpack.splats.viewpoints import WeightedSplats


@dataclass(frozen=True)
class Subject:
    """A model or splats to be drawn.

    Attributes:
        path: the file, that of a run where its folder was named.
        device, precision: where and how exactly to draw; splats are drawn in float32.
        fraction: how much of the file must be there, see `hyrfpack.load`.
        facts: of a model, see `hyrfpack.describe`; None of splats.
        splats: ready to be drawn; None of a model, which `load` reads.
    """

    path: Path
    device: torch.device
    precision: str
    fraction: float | None
    facts: dict | None = None
    splats: Drawable | None = None

    @classmethod
    def of(cls, path: Path, device: torch.device, precision: str, allow_partial: bool) -> Subject:
        """Read what a path names: splats whole, of a model its first kilobytes.

        Raises:
            HyrfError: it cannot be read, or what is asked for is not known of splats.
        """
        if is_splats(path):
            if allow_partial:
                raise HyrfError(f"{path}: splats are read whole; leave out --allow-partial")
            splats = read_splats(path)
            drawable = Drawable.from_splats(splats, WeightedSplats.from_splats(splats, str(path)).frame, device)
            return cls(path, device, precision, None, splats=drawable)
        model, fraction = find_model(path), 1.0 if allow_partial else None
        return cls(model, device, precision, fraction, facts=describe(model, fraction))

    def load(self) -> HybridModel | Drawable:
        """Return what is to be drawn, on the device."""
        if self.splats is not None:
            return self.splats
        model = load(self.path, self.device, self.fraction)
        model.precision = self.precision
        return model

    @property
    def viewpoint(self) -> Viewpoint:
        """What an orbit goes around: what the photos showed, or the middle of the splats."""
        if self.splats is not None:
            frame = self.splats.frame
            return Viewpoint.from_frame(frame.center, frame.scale)
        return Capture(self.facts or {}).viewpoint

    @property
    def folder(self) -> Path | None:
        """The folder all of whose files are read; None where one file is."""
        return sog_folder(self.path) if self.splats is not None else None

    @property
    def bytes(self) -> int:
        """On disk."""
        return bytes_on_disk(self.path)
