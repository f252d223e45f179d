"""Apply actions to a file in turn, write the result, and measure what it changes in renders."""

from __future__ import annotations

import statistics
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from hyrfpack.cameras.capture import Capture
from hyrfpack.cameras.paths import estimate_up
from hyrfpack.checks import check_type
from hyrfpack.compress import compress_model
from hyrfpack.config.compress import CompressConfig
from hyrfpack.config.edit import Action, Background, Center, EstimateUp, Move, Up, Upright
from hyrfpack.context import RunContext
from hyrfpack.edit.merge import take_part
from hyrfpack.edit.select import keep_mask
from hyrfpack.edit.state import EditState
from hyrfpack.edit.transform import Placement, replace_config, unit_vector
from hyrfpack.errors import HyrfError
from hyrfpack.evaluate import evaluate_model
from hyrfpack.evaluate.figures import draw_comparison
from hyrfpack.evaluate.metrics import psnr
from hyrfpack.format.codec import load_model, load_with_provenance, save_model
from hyrfpack.format.info import FileReport, describe_file
from hyrfpack.format.rewrite import rewrite_metadata
from hyrfpack.format.run_folder import find_model
from hyrfpack.outputs import Outputs, StrPath
from hyrfpack.progress import Progress, TaskEvent, part_of_progress
from hyrfpack.render import render_view
from hyrfpack.render.files import save_picture
from hyrfpack.scene import Camera, Scene, evenly_spaced
from hyrfpack.splats.placement import upright_rotation

MAX_COMPARED_VIEWS = 8
PICTURE_ENDINGS = (".png", ".jpg")


@dataclass(frozen=True)
class ActionReport:
    """What one action has done.

    Attributes:
        action: the action in words.
        gaussians_before, gaussians_after: number of Gaussians before and after it.
    """

    action: str
    gaussians_before: int
    gaussians_after: int


@dataclass(frozen=True)
class EditReport:
    """What an edit has changed, or would change.

    Attributes:
        file: the path that was written; "" for a plan.
        profile: profile of the file.
        bytes_before, bytes_after: bytes of both files; `bytes_after` is 0 for a plan.
        actions: what each action has done.
        views: number of cameras at which renders were compared.
        psnr_change, psnr_change_worst: PSNR in dB of the edited scene's renders against those of the original, mean and
            lowest. It says how much of the pictures has changed, whether this was wanted or not.
        psnr_before, psnr_after, ssim_before, ssim_after: scores on held-out photos; None without photos.
    """

    file: str
    profile: str
    bytes_before: int
    bytes_after: int
    actions: list[ActionReport]
    views: int
    psnr_change: float
    psnr_change_worst: float
    psnr_before: float | None = None
    psnr_after: float | None = None
    ssim_before: float | None = None
    ssim_after: float | None = None

    def to_dict(self) -> dict:
        """Return the report as numbers, strings, lists and dictionaries for JSON."""
        return asdict(self)


def edit_model(
    source: StrPath,
    target: StrPath,
    actions: Sequence[Action],
    *,
    part: str | None = None,
    profile: str | None = None,
    data: Scene | None = None,
    picture: StrPath | None = None,
    overwrite: bool = True,
    context: RunContext = RunContext(),  # noqa: B008 - frozen
) -> EditReport:
    """Apply actions to a `.hyrf` file in turn, and write the result to another file.

    Moves and backgrounds are exact: they change the file's metadata alone. Where Gaussians are removed, a file of
    profile "compact" or "paper" is quantised again, as by `compress_model`.

    Args:
        source: a file of any profile, or the folder of a run.
        target: the file to write. It may not be `source`.
        actions: actions of `hyrfpack.config.edit`, in order, at least one unless `part` is given. Each sees the result
            of the one before it, so positions after a move are new ones.
        part: the part of a merged file that is taken out and edited.
        profile: profile of the file to write; None keeps that of `source`.
        data: photos of the scene. Held-out ones are scored before and after, others decide what a floater is.
        picture: a .png or .jpg file to write: the scene before and after, side by side.
        overwrite: replace existing files. If False, an existing file is an error.
        context: progress. Edits run on the CPU.

    Raises:
        HyrfError: a file cannot be read or written, no Gaussian would be left, or `part` is missing for a merged file
            or names none of its parts.
        TypeError: `actions` has something else than actions.
        ValueError: there are no actions.

    Example:
        >>> import hyrfpack
        >>> from hyrfpack.config.edit import Center, CropSphere
        >>> report = hyrfpack.edit_model("bonsai.hyrf", "table.hyrf", [Center(), CropSphere((0, 0, 0), 0.5)])
        >>> len(report.actions), report.profile
        (2, 'compact')
    """
    path = _check_request(source, actions, data, part)
    outputs = Outputs(path, scene=data, overwrite=overwrite)
    outputs.file(target, ".hyrf")
    if picture is not None:
        outputs.file(picture, *PICTURE_ENDINGS)
    with tempfile.TemporaryDirectory() as folder, context.open_progress("edit") as progress:
        path = take_part(path, part, folder)
        compression = CompressConfig(profile=profile or describe_file(path)["profile"])
        edit = _apply(path, actions, data, part_of_progress(progress, 0, 0.3))
        written = _write(
            edit,
            target,
            compression,
            overwrite,
            replace(context, device="cpu", progress=part_of_progress(progress, 0.3, 0.8)),
        )
        edit = replace(edit, after=replace(edit.after, model=load_model(written.file)))
        report = _measure(edit, data, part_of_progress(progress, 0.8, 1))
        if picture is not None:
            _save_comparison(picture, edit, overwrite)
    return replace(report, file=written.file, profile=written.profile, bytes_after=written.bytes_after)


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
        Outputs(path, scene=data, overwrite=overwrite).file(picture, *PICTURE_ENDINGS)
    with tempfile.TemporaryDirectory() as folder, context.open_progress("edit") as progress:
        path = take_part(path, part, folder)
        edit = _apply(path, actions, data, part_of_progress(progress, 0, 0.5))
        report = _measure(edit, data, part_of_progress(progress, 0.5, 1))
        if picture is not None:
            _save_comparison(picture, edit, overwrite)
    return report


def _check_request(source: StrPath, actions: Sequence[Action], data: Scene | None, part: str | None) -> Path:
    """Return the path of the file to edit, after a check of the arguments.

    Raises:
        HyrfError: there is no file.
        TypeError, ValueError: the arguments are not valid.
    """
    if not actions and part is None:
        raise ValueError("there are no actions; give at least one")
    for action in actions:
        if not isinstance(action, Action):
            raise TypeError(f"{action!r} is no action of hyrfpack.config.edit")
    if data is not None:
        check_type("data", data, Scene)
    return find_model(source)


def _apply(path: Path, actions: Sequence[Action], data: Scene | None, progress: Progress) -> _Edit:
    """Apply the actions to a file, and return both scenes.

    Raises:
        HyrfError: the file cannot be read, or no Gaussian is left.
    """
    model, provenance = load_with_provenance(path)
    facts = describe_file(path)
    if not len(model):
        raise HyrfError(f"{path}: there is no Gaussian in it, so there is nothing to edit", fix="train it again")
    capture = Capture(facts)
    if capture.is_synthetic and not data and any(isinstance(action, EstimateUp) for action in actions):
        raise HyrfError(
            f"{path}: it keeps no cameras, from which up could be estimated", fix="state the direction, or name `data`"
        )
    viewpoint = capture.viewpoint
    photos = [] if data is None else list(data.train)
    before = EditState(model, capture.cameras, viewpoint.center, viewpoint.up, photos, Placement(), progress)
    after, reports = before, []
    for action in actions:
        count = len(after.model)
        after, description = _apply_action(action, after)
        reports.append(ActionReport(description, count, len(after.model)))
    if not after.placement.is_identity:
        provenance = after.placement.move_provenance(provenance)
    if any(isinstance(action, Up | EstimateUp) for action in actions):
        camera = after.placement.move_camera(viewpoint.camera)
        turned = replace(viewpoint, center=after.center, up=after.up, camera=camera)
        provenance = {**provenance, "viewpoint": turned.to_json()}
    return _Edit(path, facts["profile"], before, after, reports, provenance)


def _apply_action(action: Action, state: EditState) -> tuple[EditState, str]:
    """Apply one action; return the scene after it, and what was done in words."""
    if isinstance(action, EstimateUp):
        up, basis = estimate_up([view.camera for view in state.photos] or state.cameras)
        x, y, z = (up.round(4) + 0.0).tolist()  # adding 0.0 turns -0.0 into 0.0
        return replace(state, up=up), f"{Up((x, y, z))}, estimated from {basis}"
    if isinstance(action, Up):
        return replace(state, up=unit_vector(action.direction)), str(action)
    if isinstance(action, Background):
        return replace(state, model=replace_config(state.model, background=False, solid=action.color)), str(action)
    if (step := _find_move(action, state)) is not None:
        return state.move(step), str(action)
    keep = keep_mask(action, state)
    if not keep.any():
        positions = state.world_positions()
        low, high = (corner.round(4).tolist() for corner in (positions.min(axis=0), positions.max(axis=0)))
        raise HyrfError(
            f"'{action}' would leave no Gaussian; their centres lie between {low} and {high}",
            fix="change its numbers",
        )
    kept = state.model.subset(torch.from_numpy(np.flatnonzero(keep)))
    return replace(state, model=kept.requires_grad_(False)), str(action)


def _find_move(action: Action, state: EditState) -> Placement | None:
    """Return the map of world positions that an action applies, None if it moves nothing."""
    if isinstance(action, Move):
        return Placement.of(action)
    if isinstance(action, Upright):
        return Placement(rotation=upright_rotation(unit_vector(state.up), np.eye(3)["xyz".index(action.axis)]))
    if isinstance(action, Center):
        return Placement.translation(-state.center)
    return None


def _write(
    edit: _Edit, target: StrPath, compression: CompressConfig, overwrite: bool, context: RunContext
) -> FileReport:
    """Write the edited scene. If only its metadata differ from those of the source, all numbers are copied."""
    model = edit.after.model
    if edit.keeps_gaussians and compression.profile == edit.profile:
        return rewrite_metadata(edit.path, target, model.config, edit.provenance, overwrite=overwrite)
    with tempfile.TemporaryDirectory() as folder:
        edited = Path(folder, "edited.hyrf")
        save_model(model, edited, "raw", edit.provenance)
        return compress_model(edited, target, compression, overwrite=overwrite, context=context)


def _measure(edit: _Edit, data: Scene | None, progress: Progress) -> EditReport:
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
    if data is None or not data.test:
        return report
    moved = [edit.after.placement.move_view(view) for view in data.test]
    before = evaluate_model(edit.before.model, data.test, progress=part_of_progress(progress, 0.3, 0.65))
    after = evaluate_model(edit.after.model, moved, progress=part_of_progress(progress, 0.65, 1))
    return replace(
        report, psnr_before=before.psnr, psnr_after=after.psnr, ssim_before=before.ssim, ssim_after=after.ssim
    )


def _save_comparison(path: StrPath, edit: _Edit, overwrite: bool) -> None:
    """Write a picture of the scene before and after the edit, and their difference, from the first camera."""
    before, after = edit.render(edit.before.cameras[0])
    save_picture(path, draw_comparison(before, after, labels=("before", "after")), overwrite=overwrite)


@dataclass(frozen=True, eq=False)
class _Edit:
    """A scene before and after its actions.

    Attributes:
        path: the file that is edited.
        profile: its profile.
        before, after: the scene before the first action and after the last one.
        reports: what each action has done.
        provenance: the provenance of the edited file.
    """

    path: Path
    profile: str
    before: EditState
    after: EditState
    reports: list[ActionReport]
    provenance: dict

    @property
    def keeps_gaussians(self) -> bool:
        """Return whether no action has removed a Gaussian."""
        return len(self.after.model) == len(self.before.model)

    def render(self, camera: Camera) -> tuple[Tensor, Tensor]:
        """Return renders (H, W, 3) of both scenes in [0, 1] from one camera, given in coordinates before the edit."""
        views = ((self.before.model, camera), (self.after.model, self.after.placement.move_camera(camera)))
        before, after = (render_view(model, view).rgb.clamp(0, 1) for model, view in views)
        return before, after
