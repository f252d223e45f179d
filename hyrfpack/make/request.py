"""What is asked for, and what of it is refused before any work."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import torch

from hyrfpack.data.folder import list_photos
from hyrfpack.errors import HyrfDataError, HyrfError
from hyrfpack.export.folder import check_folder
from hyrfpack.export.kinds import PLAYER_FOLDER, check_place, check_request, find_file_kind
from hyrfpack.format.min_file_size import check_target_bytes
from hyrfpack.make.source import Reading, Source
from hyrfpack.make.stages import EXPORTED, PACKED
from hyrfpack.make.state import NAME, State, digest
from hyrfpack.outputs import Outputs
from hyrfpack.train.config import TrainConfig
from hyrfpack.train.setup import check_target

_OF_PHOTOS = ("training", "compression", "scoring", "export")
_STAGES = {"model": _OF_PHOTOS[-1:], "splats": ("import", "export"), "scene": _OF_PHOTOS}


def work_folder(output: Path) -> Path:
    """Where the products of an output are kept if nobody says where: beside it. Raises HyrfError: it has no name."""
    named = output if output.name.strip(".") else Path(os.path.realpath(output))
    if not named.name:
        raise HyrfError(f"{output}: this is the top of all folders; name a folder or a file in it")
    return named.with_name(f"{named.stem}.work")


@dataclass(frozen=True)
class Request:
    """The arguments of `make`, and what it is given, looked at."""

    source: Source
    output: Path
    work: Path
    reading: Reading
    quality: str
    minutes: float | None
    matching: str
    target_bytes: int | None
    max_gaussians: int | None
    preset: str
    seed: int
    device: torch.device
    overwrite: bool

    @property
    def stages(self) -> list[str]:
        """Names of those to come, in order."""
        names = list(_STAGES.get(self.source.kind, ("poses", *_OF_PHOTOS)))
        if self.minutes is not None:
            names.insert(names.index("training"), "measurement")
        return names

    @property
    def makes_folder(self) -> bool:
        """Whether the output is a folder."""
        return not self._is_model and find_file_kind(self.output) is PLAYER_FOLDER

    def check(self) -> None:
        """Raises HyrfError: what is asked for cannot be, or may or can not be written."""
        self._check_options()
        self._check_places()
        if not self.overwrite and not self.is_made(State(self.work)):
            for outputs in self.source.outputs(overwrite=False):
                self._check_output(outputs, overwrite=False)

    def check_replacing(self, state: State) -> None:
        """Raises HyrfError: the output is there, made before of something else, and may not be replaced."""
        if not self.overwrite and os.path.lexists(self.output) and self.is_made(state):
            raise HyrfError(
                f"{self.output}: this was made of other photos or with other settings; name another, or replace it "
                "with `overwrite=True`"
            )

    def is_made(self, state: State) -> bool:
        """Whether all that is there of the output is what was made before, as a work folder's record says."""
        top = f"{EXPORTED}/{self.output.name}"
        files = state.files("export").items()
        there = [(self.output / name[len(top) :].lstrip("/"), made) for name, made in files if name.startswith(top)]
        there = [(path, made) for path, made in there if os.path.lexists(path)]
        return bool(there) and all(digest(path) == made for path, made in there)

    def _check_options(self) -> None:
        source = self.source
        if not self._is_model:
            check_request(find_file_kind(self.output, other_endings=(".hyrf",)), self.output)
        elif source.kind == "model":
            raise HyrfError(f"{source.path}: this is a .hyrf file already; 'hyrfpack compress' makes it smaller")
        if source.kind in ("model", "splats"):
            asked = {
                "minutes": self.minutes,
                "a target size": self.target_bytes,
                "a number of Gaussians": self.max_gaussians,
                "a preset": None if self.preset == "auto" else self.preset,
            }
            for name, value in asked.items():
                if value is not None:
                    raise HyrfError(f"{source.path}: {name} can be asked for with photos only; leave it out")
        if self.target_bytes is not None and self.max_gaussians is not None:
            raise HyrfError(
                "a target size and a number of Gaussians each decide how large the model is; give one of them "
                "(`target_bytes` or `max_gaussians`)"
            )
        self._check_target()
        if source.kind == "photos" and not list_photos(source.path):
            raise HyrfDataError(f"{source.path}: there is no photo in this folder; name one that has some")

    def _check_target(self) -> None:
        """Refuse a target size that no file of these photos can have. Photos without poses are not read for it."""
        if self.target_bytes is None:
            return
        if self.source.scene is None:
            check_target_bytes(self.target_bytes)
        else:
            check_target(self.source.scene, TrainConfig(preset=self.preset, target_bytes=self.target_bytes))

    def _check_places(self) -> None:
        """Refuse places where nothing may or can be written, whatever is there."""
        for outputs in self.source.outputs(overwrite=True):
            self._check_output(outputs, overwrite=True)
            outputs.folder(self.work, [NAME])
        work, output = (Path(os.path.realpath(path)) for path in (self.work, self.output))
        if self.source.kind == "photos" and work.is_relative_to(os.path.realpath(self.source.path)):
            raise HyrfError(f"{self.work}: the work folder would lie among the photos; name another with `work`")
        if output.is_relative_to(work) or work.is_relative_to(output):
            raise HyrfError(
                f"{self.output}: the output and the work folder {self.work} lie in each other; name another folder "
                "with `work`"
            )

    def _check_output(self, outputs: Outputs, *, overwrite: bool) -> None:
        if self._is_model:
            outputs.file(self.output, ".hyrf")
        elif self.makes_folder:
            outputs.folder(self.output, [])
            model = self.source.path if self.source.kind == "model" else self.work / PACKED
            check_folder(self.output, [model], [self.source.scene], overwrite=overwrite, is_gallery=False)
        else:
            check_place(self.output, outputs)

    @property
    def _is_model(self) -> bool:
        return self.output.name.lower().endswith(".hyrf")
