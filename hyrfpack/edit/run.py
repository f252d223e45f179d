"""Apply actions to a file, write the result, and measure how much renders change."""

from __future__ import annotations

import statistics
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from hyrfpack.checks import check_type
from hyrfpack.compress import CompressionReport
from hyrfpack.config.edit import Action, CropMasks, EditLimits, Refit, Remove
from hyrfpack.context import RunContext
from hyrfpack.edit.apply import Edit, apply_actions, open_scene
from hyrfpack.edit.merge import extract_part
from hyrfpack.edit.report import EditReport
from hyrfpack.edit.write import check_limits, write_edit
from hyrfpack.evaluate import evaluate_model
from hyrfpack.evaluate.figures import draw_comparison
from hyrfpack.evaluate.metrics import psnr
from hyrfpack.format.parts import load_model_or_parts
from hyrfpack.format.run_folder import find_model
from hyrfpack.outputs import Outputs, StrPath
from hyrfpack.progress import Progress, TaskEvent, part_of_progress
from hyrfpack.render.files import save_picture
from hyrfpack.scene import Scene, evenly_spaced

MAX_COMPARED_VIEWS = 8
PICTURE_ENDINGS = (".png", ".jpg")


def edit_model(
    source: StrPath,
    target: StrPath,
    actions: Sequence[Action],
    *,
    part: str | None = None,
    profile: str | None = None,
    limits: EditLimits = EditLimits(),  # noqa: B008 - frozen
    data: Scene | None = None,
    picture: StrPath | None = None,
    overwrite: bool = True,
    context: RunContext = RunContext(),  # noqa: B008 - frozen
) -> EditReport:
    """Apply actions to a `.hyrf` file, one after the other, and write the result to another file.

    Moves and backgrounds are exact: they change the file's metadata alone. Where Gaussians are removed, a file of
    profile "compact" or "paper" is quantised again, as by `compress_model`. All parts of a merged file are edited in
    the world that they share, and parts that are left with no Gaussian are left out.

    Args:
        source: a file of any profile, or the folder of a run.
        target: the file to write. It may not be `source`.
        actions: actions of `hyrfpack.config.edit`, in order, at least one unless `part` or a limit is given. Each sees
            the result of the one before it, so positions after a move are new ones.
        part: the part of a merged file that is taken out and edited; None edits all parts together.
        profile: profile of the file to write; None keeps that of `source`, or takes "compact" for a limit.
        limits: largest size or largest loss of the file.
        data: photos of the scene. Held-out photos are scored before and after. Training photos decide what a floater
            is, and `Refit` trains on them.
        picture: a .png or .jpg file to write: the scene before and after, side by side.
        overwrite: replace existing files. If False, an existing file is an error.
        context: progress. Edits run on the CPU.

    Raises:
        HyrfError: a file cannot be read or written, no Gaussian would be left, `part` names none of its parts, an
            action cannot be applied to a merged file, or no file meets a limit.
        TypeError: an element of `actions` is not an action.
        ValueError: there is nothing to do.

    Example:
        >>> import hyrfpack
        >>> from hyrfpack.config.edit import Center, CropSphere
        >>> report = hyrfpack.edit_model("bonsai.hyrf", "table.hyrf", [Center(), CropSphere((0, 0, 0), 0.5)])
        >>> len(report.actions), report.profile
        (2, 'compact')
    """
    path = _check_request(source, actions, data, part, limits)
    outputs = Outputs(path, folders=_mask_folders(actions), scene=data, overwrite=overwrite)
    outputs.file(target, ".hyrf")
    if picture is not None:
        outputs.file(picture, *PICTURE_ENDINGS)
    with tempfile.TemporaryDirectory() as folder, context.open_progress("edit") as progress:
        opened = open_scene(extract_part(path, part, folder), path, data, part_of_progress(progress, 0, 0.3))
        check_limits(opened, profile, limits)
        edit = apply_actions(opened, actions)
        writing = replace(context, device="cpu", progress=part_of_progress(progress, 0.3, 0.8))
        written = write_edit(edit, target, profile, limits, overwrite, writing)
        edit = replace(edit, after=replace(edit.after, model=load_model_or_parts(written.file)))
        report = _measure_changes(edit, part_of_progress(progress, 0.8, 1))
        if picture is not None:
            _save_comparison(picture, edit, overwrite)
    found = written.found if isinstance(written, CompressionReport) else ""
    return replace(report, file=written.file, profile=written.profile, bytes_after=written.bytes_after, found=found)


def plan_edit(
    source: StrPath,
    actions: Sequence[Action],
    *,
    part: str | None = None,
    data: Scene | None = None,
    picture: StrPath | None = None,
    overwrite: bool = True,
    context: RunContext = RunContext(),  # noqa: B008 - frozen
) -> EditReport:
    """Report what `edit_model` would change, and write no model.

    Renders are compared before the result is quantised.

    Args:
        source: a file of any profile, or the folder of a run.
        actions: as for `edit_model`.
        part: as for `edit_model`.
        data: photos of the scene. Held-out ones are scored before and after.
        picture: as for `edit_model`.
        overwrite: replace an existing picture. If False, it is an error.
        context: progress.

    Raises:
        HyrfError: as `edit_model`.
        TypeError: as `edit_model`.
        ValueError: as `edit_model`.

    Example:
        >>> import hyrfpack
        >>> from hyrfpack.config.edit import MinOpacity
        >>> report = hyrfpack.plan_edit("bonsai.hyrf", [MinOpacity(0.05)])
        >>> report.actions[0].gaussians_after <= report.actions[0].gaussians_before
        True
    """
    path = _check_request(source, actions, data, part)
    if picture is not None:
        Outputs(path, folders=_mask_folders(actions), scene=data, overwrite=overwrite).file(picture, *PICTURE_ENDINGS)
    with tempfile.TemporaryDirectory() as folder, context.open_progress("edit") as progress:
        opened = open_scene(extract_part(path, part, folder), path, data, part_of_progress(progress, 0, 0.5))
        edit = apply_actions(opened, actions)
        report = _measure_changes(edit, part_of_progress(progress, 0.5, 1))
        if picture is not None:
            _save_comparison(picture, edit, overwrite)
    return report


def _check_request(
    source: StrPath,
    actions: Sequence[Action],
    data: Scene | None,
    part: str | None,
    limits: EditLimits = EditLimits(),  # noqa: B008 - frozen
) -> Path:
    """Return the path of the file to edit, after a check of the arguments.

    Raises:
        HyrfError: there is no file.
        TypeError, ValueError: the arguments are not valid.
    """
    check_type("limits", limits, EditLimits)
    if not actions and part is None and limits == EditLimits():
        raise ValueError("there are no actions; give at least one")
    for action in actions:
        if not isinstance(action, Action):
            raise TypeError(f"{action!r} is not an action of hyrfpack.config.edit")
    if data is not None:
        check_type("data", data, Scene)
    return find_model(source)


def _mask_folders(actions: Sequence[Action]) -> list[str]:
    """Return the folders of masks that actions read, those of a region or an inverted crop, too."""
    folders = []
    for action in actions:
        region = action.region if isinstance(action, Refit) else action
        crop = region.crop if isinstance(region, Remove) else region
        if isinstance(crop, CropMasks):
            folders.append(crop.folder)
    return folders


def _measure_changes(edit: Edit, progress: Progress) -> EditReport:
    """Compare renders of both scenes, and score both on held-out photos."""
    cameras = evenly_spaced(edit.before.cameras, MAX_COMPARED_VIEWS)
    changes = []
    for number, camera in enumerate(cameras):
        progress(TaskEvent("comparing renders", 0.3 * number / len(cameras)))
        changes.append(psnr(*edit.render(camera)))
    report = EditReport(
        file="",
        profile=edit.profile,
        bytes_before=edit.path.stat().st_size,
        bytes_after=0,
        actions=edit.reports,
        views=len(cameras),
        psnr_change=statistics.fmean(changes),
        psnr_change_worst=min(changes),
    )
    views = [] if edit.data is None else edit.data.test
    if not views:
        return report
    moved = [edit.after.placement.move_view(view) for view in views]
    before = evaluate_model(edit.before.model, views, progress=part_of_progress(progress, 0.3, 0.65))
    after = evaluate_model(edit.after.model, moved, progress=part_of_progress(progress, 0.65, 1))
    return replace(
        report, psnr_before=before.psnr, psnr_after=after.psnr, ssim_before=before.ssim, ssim_after=after.ssim
    )


def _save_comparison(path: StrPath, edit: Edit, overwrite: bool) -> None:
    """Write a picture of the scene before and after the edit, and their difference, from the first camera."""
    before, after = edit.render(edit.before.cameras[0])
    save_picture(path, draw_comparison(before, after, labels=("before", "after")), overwrite=overwrite)
