"""Write an edited scene, within limits on its size or loss."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from hyrfpack.atomic import write_atomic
from hyrfpack.compress import compress_model
from hyrfpack.compress.merged import name_part
from hyrfpack.compress.run import check_request
from hyrfpack.config.compress import CompressConfig
from hyrfpack.config.edit import EditLimits
from hyrfpack.context import RunContext
from hyrfpack.data.masked_views import mask_differing_pixels
from hyrfpack.edit.apply import Edit, EditedPart
from hyrfpack.errors import HyrfError, HyrfSizeError, named_in_errors
from hyrfpack.format.codec import encode_model, packed_provenance, save_model, write_model
from hyrfpack.format.container import Container, read_container
from hyrfpack.format.info import FileReport
from hyrfpack.format.min_file_size import check_target_bytes
from hyrfpack.format.part_names import open_parts
from hyrfpack.format.parts import encode_parts, write_merged
from hyrfpack.format.rewrite import with_metadata
from hyrfpack.format.sections import PART_NAMES, SECTION_CONTENTS
from hyrfpack.outputs import StrPath
from hyrfpack.progress import part_of_progress
from hyrfpack.scene import Scene, View


def check_limits(edit: Edit, profile: str | None, limits: EditLimits) -> None:
    """Check that the profile and the limits of the file to write suit the scene before its actions.

    Args:
        edit: the opened scene.
        profile: the profile; None for that of the source, or "compact" with limits.
        limits: largest size or largest loss of the file.

    Raises:
        HyrfError: the limits exclude each other or the profile, need photos, or no file can be that small.
    """
    for part in edit.parts:
        check_request(_choose_settings(part, profile, limits), None if limits == EditLimits() else edit.data)
    if limits.target_bytes is not None:
        for part in edit.parts:
            check_target_bytes(
                limits.target_bytes, packed_provenance(part.provenance, part.before), part.before.exposure
            )


def write_edit(
    edit: Edit,
    target: StrPath,
    profile: str | None,
    limits: EditLimits,
    overwrite: bool,
    context: RunContext,
) -> FileReport:
    """Write an edited scene. A model of which only the metadata changed keeps all its numbers.

    A merged file of which one part is left becomes a file of one model. The arguments `profile` and `limits` are those
    of `check_limits`.

    Raises:
        HyrfError: the file cannot be written, or none is within the limits.
    """
    settings = [_choose_settings(part, profile, limits) for part in edit.parts]
    copies = [_copy_numbers(edit, *pair) for pair in zip(edit.parts, settings, strict=True)]
    if limits.max_psnr_drop is None and all(copy is not None for copy in copies):
        copy = _join_models(edit, [copy for copy in copies if copy is not None])
        if limits.target_bytes is None or len(copy) <= limits.target_bytes:
            return _write_file(copy, target, overwrite)
    if limits == EditLimits() and len(copies) > 1:
        encoded = []
        with context.open_progress() as progress:
            for number, (part, config, copied) in enumerate(zip(edit.parts, settings, copies, strict=True)):
                share = part_of_progress(progress, number / len(copies), (number + 1) / len(copies))
                encoded.append(copied or _encode_part(edit, part, config, replace(context, progress=share)))
        return _write_file(_join_models(edit, encoded), target, overwrite)
    photos = None if edit.data is None or limits.max_psnr_drop is None else _unchanged_photos(edit, edit.data)
    with tempfile.TemporaryDirectory() as folder:
        edited = Path(folder, "edited.hyrf")
        write_atomic(
            edited, _join_models(edit, [encode_model(part.after, "raw", part.provenance) for part in edit.parts])
        )
        try:
            with named_in_errors(edited, str(edit.source)):
                return compress_model(edited, target, settings[0], data=photos, overwrite=overwrite, context=context)
        except HyrfSizeError as error:
            raise HyrfSizeError(
                f"{edit.source}: after the edit {error.problem}",
                fix=f"use a `target_bytes` of at least {error.min_bytes:,}, or keep fewer `gaussians`",
                min_bytes=error.min_bytes,
            ) from error


def _choose_settings(part: EditedPart, profile: str | None, limits: EditLimits) -> CompressConfig:
    """Return the settings of compression of one model."""
    return CompressConfig(
        profile=profile or (part.profile if limits == EditLimits() else "compact"),
        target_bytes=limits.target_bytes,
        max_psnr_drop=limits.max_psnr_drop,
    )


def _copy_numbers(edit: Edit, part: EditedPart, config: CompressConfig) -> bytes | None:
    """Return the bytes of a model that keeps all its numbers, with its new metadata; None if numbers change."""
    if config.profile != part.profile or not part.keeps_gaussians:
        return None
    with Container.open(edit.path, SECTION_CONTENTS) as container:
        source = dict(open_parts(container))[part.name] if part.name else container
        return with_metadata(source, part.after.config, part.provenance)


def _encode_part(edit: Edit, part: EditedPart, config: CompressConfig, context: RunContext) -> bytes:
    """Encode one part of a merged file by itself."""
    with tempfile.TemporaryDirectory() as folder:
        edited, packed = Path(folder, "edited.hyrf"), Path(folder, "packed.hyrf")
        save_model(part.after, edited, "raw", part.provenance)
        with named_in_errors(edited, name_part(edit.source, part.name)):
            compress_model(edited, packed, config, context=context)
        return packed.read_bytes()


def _join_models(edit: Edit, models: Sequence[bytes]) -> bytes:
    """Return the bytes of a file of one model, or of a merged file of all models."""
    return models[0] if len(models) == 1 else encode_parts([*zip((p.name for p in edit.parts), models, strict=True)])


def _write_file(data: bytes, target: StrPath, overwrite: bool) -> FileReport:
    """Write the bytes of a file of one model or of several."""
    write = write_merged if PART_NAMES in read_container(data, SECTION_CONTENTS).entries else write_model
    return write(data, target, overwrite=overwrite)


def _unchanged_photos(edit: Edit, data: Scene) -> Scene:
    """Return the photos in the coordinates after an edit; of the held-out ones only pixels that it left as they were.

    Photos also show what an edit has removed. An error there would hide the error that compression adds.

    Raises:
        HyrfError: the edit changes every pixel.
    """
    held_out: list[View] = []
    for view in data.test or data.train:
        masked_view = mask_differing_pixels(edit.after.placement.move_view(view), *edit.render(view.camera))
        if masked_view is not None:
            held_out.append(masked_view)
    if not held_out:
        raise HyrfError(
            "the edit changes every pixel of the held-out photos, so no loss of PSNR can be measured there",
            fix="use `target_bytes` instead of `max_psnr_drop`",
        )
    return replace(edit.after.placement.move_scene(data), test=held_out)
