"""Write an edited scene, within limits on its size or loss."""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from hyrfpack.compress import compress_model
from hyrfpack.compress.run import check_request
from hyrfpack.config.compress import CompressConfig
from hyrfpack.config.edit import EditLimits
from hyrfpack.context import RunContext
from hyrfpack.edit.apply import Edit
from hyrfpack.edit.masked_views import mask_view
from hyrfpack.errors import HyrfError, HyrfSizeError
from hyrfpack.format.codec import packed_provenance, save_model, write_model
from hyrfpack.format.container import Container
from hyrfpack.format.info import FileReport
from hyrfpack.format.min_file_size import check_target_bytes
from hyrfpack.format.rewrite import with_metadata
from hyrfpack.outputs import StrPath
from hyrfpack.scene import Scene, View

# A pixel counts as unchanged by an edit if no channel differs by more. Gaussians that are hardly seen change pixels by
# less, cuts and removed objects by more.
MAX_UNCHANGED_DIFFERENCE = 8 / 255


def choose_compression(edit: Edit, profile: str | None, limits: EditLimits, data: Scene | None) -> CompressConfig:
    """Return the settings of the file to write, after a check that they suit the scene before its actions.

    Args:
        edit: the opened scene.
        profile: the profile; None for that of the source, or "compact" with limits.
        limits: largest size or largest loss of the file.
        data: photos of the scene, or None.

    Raises:
        HyrfError: the limits exclude each other or the profile, need photos, or no file can be that small.
    """
    is_limited = limits != EditLimits()
    config = CompressConfig(
        profile=profile or ("compact" if is_limited else edit.profile),
        target_bytes=limits.target_bytes,
        max_psnr_drop=limits.max_psnr_drop,
    )
    check_request(config, data if is_limited else None)
    if limits.target_bytes is not None:
        model = edit.before.model
        check_target_bytes(limits.target_bytes, packed_provenance(edit.provenance, model), model.exposure)
    return config


def write_edit(
    edit: Edit, target: StrPath, config: CompressConfig, data: Scene | None, overwrite: bool, context: RunContext
) -> FileReport:
    """Write an edited scene. If only its metadata differ from those of the source, all numbers are copied.

    Raises:
        HyrfError: the file cannot be written, or none is within the limits.
    """
    model = edit.after.model
    if edit.keeps_gaussians and config.profile == edit.profile and config.max_psnr_drop is None:
        with Container.open(edit.path) as container:
            copy = with_metadata(container, model.config, edit.provenance)
        if config.target_bytes is None or len(copy) <= config.target_bytes:
            return write_model(copy, target, overwrite=overwrite)
    photos = None if data is None or config.max_psnr_drop is None else _unchanged_photos(edit, data)
    with tempfile.TemporaryDirectory() as folder:
        edited = Path(folder, "edited.hyrf")
        save_model(model, edited, "raw", edit.provenance)
        try:
            return compress_model(edited, target, config, data=photos, overwrite=overwrite, context=context)
        except HyrfSizeError as error:
            raise HyrfSizeError(
                f"{edit.path}: after the edit {error.problem}",
                fix="use a larger `target_bytes`, or keep fewer `gaussians`",
                min_bytes=error.min_bytes,
            ) from error


def _unchanged_photos(edit: Edit, data: Scene) -> Scene:
    """Return the photos in the coordinates after an edit; of the held-out ones only pixels that it left as they were.

    Photos also show what an edit has removed. An error there would hide the error that compression adds.

    Raises:
        HyrfError: the edit changes every pixel.
    """
    held_out: list[View] = []
    for view in data.test or data.train:
        before, after = edit.render(view.camera)
        unchanged: np.ndarray = ((after - before).abs().amax(-1) <= MAX_UNCHANGED_DIFFERENCE).numpy()
        if unchanged.any():
            held_out.append(mask_view(edit.after.placement.move_view(view), unchanged))
    if not held_out:
        raise HyrfError(
            "the edit changes every pixel of the held-out photos, so no loss of PSNR can be measured there",
            fix="use `target_bytes` instead of `max_psnr_drop`",
        )
    return replace(data, train=[edit.after.placement.move_view(view) for view in data.train], test=held_out)
