"""The arguments of `make`, checked before any work."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from hyrfpack.config.export import ExportConfig
from hyrfpack.config.make import MakeConfig
from hyrfpack.config.train import TrainConfig
from hyrfpack.data.folder import list_photos
from hyrfpack.errors import HyrfDataError, HyrfError, suggest_command
from hyrfpack.export.folder import check_export_folder
from hyrfpack.export.kinds import (
    EXPORT_ENDINGS,
    PLAYER_FOLDER,
    TRANSFORMS_JSON,
    check_export_target,
    check_request,
    find_file_kind,
)
from hyrfpack.format.min_file_size import check_target_bytes
from hyrfpack.format.run_folder import WORK_RECORD_FILE
from hyrfpack.make.source import LoadSettings, Source
from hyrfpack.make.stages import EXPORT_FOLDER, PACKED_MODEL
from hyrfpack.make.state import WorkFolderState, file_digest
from hyrfpack.outputs import Outputs
from hyrfpack.train.setup import check_target

_PHOTO_SETTINGS = (
    "minutes", "target_bytes", "max_gaussians", "preset", "matching", "images", "max_size", "test_every"
)  # fmt: skip
_SCENE_STAGES = ("training", "compression", "scoring", "export")
_STAGES_OF_SOURCE = {"model": _SCENE_STAGES[-1:], "splats": ("import", "export"), "scene": _SCENE_STAGES}


def default_work_folder(output: Path) -> Path:
    """Return the default work folder of an output, which lies beside it. Raises HyrfError: the output has no name."""
    absolute = output if output.name.strip(".") else Path(os.path.realpath(output))
    if not absolute.name:
        raise HyrfError(f"{output}: this is the root folder", fix="choose a folder or a file in it")
    return absolute.with_name(f"{absolute.stem}.work")


@dataclass(frozen=True)
class Request:
    """The arguments of `make`, with the inspected source.

    An output "." or ".." is replaced by its full path. The other attributes are those of `make_scene`.

    Attributes:
        source: the inspected source.
        output: path of the output.
        work: the work folder.
        load_settings: settings with which photos are read.
        config: settings of the call.
        device: device for training and packing.
        overwrite: replace an existing output.
        is_observed: whether an observer watches the training.
    """

    source: Source
    output: Path
    work: Path
    load_settings: LoadSettings
    config: MakeConfig
    device: torch.device
    overwrite: bool
    is_observed: bool

    def __post_init__(self) -> None:
        if not self.output.name.strip("."):  # the product in the work folder gets the name of the output
            object.__setattr__(self, "output", Path(os.path.realpath(self.output)))

    @property
    def stages(self) -> list[str]:
        """Return the names of the stages to run, in order."""
        names = list(_STAGES_OF_SOURCE.get(self.source.kind, ("poses", *_SCENE_STAGES)))
        if self.config.minutes is not None:
            names.insert(names.index("training"), "measurement")
        return names

    @property
    def is_output_folder(self) -> bool:
        """Return whether the output is a folder."""
        return not self._is_model and find_file_kind(self.output) is PLAYER_FOLDER

    def check(self) -> None:
        """Check the request. Raises HyrfError: it is impossible, or the output may not or cannot be written."""
        self._check_options()
        self._check_paths()
        if not self.overwrite and not self.is_output_unchanged(WorkFolderState(self.work)):
            self._check_output(self.source.output_rules(overwrite=False), overwrite=False)

    def check_replacing(self, state: WorkFolderState, stage: str, inputs: dict[str, Any]) -> None:
        """Check an existing output before a stage runs again with these inputs.

        Raises:
            HyrfError: an earlier call wrote the output, and it may not be replaced.
        """
        if not self.overwrite and os.path.lexists(self.output) and self.is_output_unchanged(state):
            if state.has_lost_files(stage, inputs):
                raise HyrfError(
                    f"{self.output}: an earlier call wrote this output, but the product of its {stage} stage in "
                    f"{self.work} is missing or changed",
                    fix="make the scene again with `overwrite=True`, or name another output",
                )
            raise HyrfError(
                f"{self.output}: an earlier call wrote this output from another source or with other settings",
                fix="name another output, or replace this one with `overwrite=True`",
            )

    def is_output_unchanged(self, state: WorkFolderState) -> bool:
        """Return whether the output exists and its files match the record of the work folder."""
        top = f"{EXPORT_FOLDER}/{self.output.name}"
        recorded = {
            self.output / name[len(top) :].lstrip("/"): digest
            for name, digest in state.files("export").items()
            if name.startswith(top)
        }
        existing = {path: digest for path, digest in recorded.items() if os.path.lexists(path)}
        return bool(existing) and all(file_digest(path) == digest for path, digest in existing.items())

    def _check_options(self) -> None:
        """Reject options that exclude each other or do not fit the source."""
        self._check_output_format()
        self._check_settings_fit_source()
        if self.config.minutes is not None and self.config.quality is not None:
            raise HyrfError(
                "a time limit and a quality each decide the number of training steps",
                fix="give one of them (`minutes` or `quality`)",
            )
        if self.config.target_bytes is not None and self.config.max_gaussians is not None:
            raise HyrfError(
                "a target size and a number of Gaussians each decide how large the model is",
                fix="give one of them (`target_bytes` or `max_gaussians`)",
            )
        self._check_target()
        source = self.source
        if source.kind == "photos" and not list_photos(source.path):
            raise HyrfDataError(
                f"{source.path}: there are no photos in this folder", fix="name a folder that holds some"
            )
        if source.scene is None and self.config.test_every == 1:  # photos with poses are checked when they are read
            raise HyrfDataError(
                f"{source.path}: each photo would be held out, and none is left to train on",
                fix="hold out fewer with `test_every` (0 holds out none)",
            )

    def _check_output_format(self) -> None:
        """Reject an output format that cannot be written from the source."""
        if not self._is_model:
            endings = (".hyrf", *(ending for ending in EXPORT_ENDINGS if ending != TRANSFORMS_JSON.ending))
            kind = find_file_kind(self.output, endings=endings)
            if kind is TRANSFORMS_JSON:  # its paths of photos would be relative to the work folder
                raise HyrfError(
                    f"{self.output}: this format holds only the cameras of the photos",
                    fix="name another format; for the cameras of a finished model, use "
                    f"{suggest_command('export', 'MODEL', '-o', self.output)} with `data`",
                )
            check_request(kind, self.output, ExportConfig())
        elif self.source.kind == "model":
            raise HyrfError(
                f"{self.source.path}: this is a .hyrf file already", fix="make it smaller with 'hyrfpack compress'"
            )

    def _check_settings_fit_source(self) -> None:
        """Reject settings that have no effect on this kind of source."""
        source = self.source
        if source.kind in ("model", "splats"):
            given = [name for name in _PHOTO_SETTINGS if getattr(self.config, name) != getattr(MakeConfig, name)]
            given += ["observer"] if self.is_observed else []
            if given:
                raise HyrfError(
                    f"{source.path}: this is not a set of photos, but settings for photos were given",
                    fix="leave out " + " and ".join(f"`{name}`" for name in given),
                )
        if source.kind == "model":
            for name in ("quality", "seed"):
                if getattr(self.config, name) != getattr(MakeConfig, name):
                    raise HyrfError(f"{source.path}: a model is exported as it is", fix=f"leave out `{name}`")

    def _check_target(self) -> None:
        """Reject a target size that no file of these photos can have; photos without poses get a weaker check."""
        if self.config.target_bytes is None:
            return
        if self.source.scene is None:
            check_target_bytes(self.config.target_bytes)
        else:
            config = TrainConfig(preset=self.config.preset, target_bytes=self.config.target_bytes)
            check_target(self.source.scene, config)

    def _check_paths(self) -> None:
        """Reject an output or a work folder that may not be written, whether or not it exists."""
        outputs = self.source.output_rules(overwrite=True)
        self._check_output(outputs, overwrite=True)
        outputs.folder(self.work, [WORK_RECORD_FILE])
        work, output = (Path(os.path.realpath(path)) for path in (self.work, self.output))
        if self.source.kind == "photos" and work.is_relative_to(os.path.realpath(self.source.path)):
            raise HyrfError(
                f"{self.work}: the work folder would lie among the photos", fix="name another folder with `work`"
            )
        if output.is_relative_to(work) or work.is_relative_to(output):
            raise HyrfError(
                f"{self.output}: this output and the work folder {self.work} may not contain each other",
                fix="name another folder with `work`",
            )

    def _check_output(self, outputs: Outputs, *, overwrite: bool) -> None:
        """Check the output by the rules of the source."""
        if self._is_model:
            outputs.file(self.output, ".hyrf")
        elif self.is_output_folder:
            model = self.source.path if self.source.kind == "model" else self.work / PACKED_MODEL
            # This check comes first, because the next one would take the poster of an existing player for a photo.
            check_export_folder(self.output, [model], [self.source.scene], overwrite=overwrite, is_gallery=False)
            outputs.folder(self.output, [])
        else:
            check_export_target(self.output, outputs)

    @property
    def _is_model(self) -> bool:
        return self.output.name.lower().endswith(".hyrf")
