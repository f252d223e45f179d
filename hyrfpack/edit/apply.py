"""Apply actions to a scene, one after the other."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from hyrfpack.cameras.capture import (
    MISMATCH_REMEDY,
    PSNR_BEFORE_EDIT,
    PSNR_BEFORE_KEY,
    Capture,
    has_mean_exposure,
    place_photos,
)
from hyrfpack.cameras.paths import estimate_up
from hyrfpack.cameras.placement import Placement, unit_vector
from hyrfpack.config.edit import Action, Background, Center, Crop, EstimateUp, Move, Refit, Remove, Up, Upright
from hyrfpack.edit.refit import refit_region, score_region
from hyrfpack.edit.report import ActionReport
from hyrfpack.edit.select import keep_mask
from hyrfpack.edit.state import EditState
from hyrfpack.edit.transform import move_provenance, placement_of, replace_config
from hyrfpack.errors import HyrfDataError, HyrfError
from hyrfpack.format.container import Container
from hyrfpack.format.metadata import read_metadata
from hyrfpack.format.part_names import open_parts
from hyrfpack.format.parts import decode_parts
from hyrfpack.format.sections import PART_NAMES, SECTION_CONTENTS
from hyrfpack.format.shared import read_provenance
from hyrfpack.model import HybridModel
from hyrfpack.model.merged import MergedModel, map_parts, parts_of
from hyrfpack.progress import Progress
from hyrfpack.render import render_view
from hyrfpack.scene import Camera, Scene
from hyrfpack.splats.placement import upright_rotation

_LOG = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class EditedPart:
    """One model of the edited file: a part of a merged file, or the only model.

    Attributes:
        name: name of the part; "" for the only model of a file.
        profile: profile of its file before the edit.
        provenance: the provenance of the edited file.
        before, after: the model before the first action and after the last one.
    """

    name: str
    profile: str
    provenance: dict
    before: HybridModel
    after: HybridModel

    @property
    def keeps_gaussians(self) -> bool:
        """Return whether no number of the Gaussians has changed."""
        before, after = (model.gaussians.parameters() for model in (self.before, self.after))
        return all(torch.equal(old, new) for old, new in zip(before, after, strict=True))

    @property
    def keeps_appearance(self) -> bool:
        """Return whether the model renders as before, apart from its place in the world."""
        before, after = self.before.config, self.after.config
        keeps_background = before.background == after.background and before.solid == after.solid
        return keeps_background and self.keeps_gaussians


@dataclass(frozen=True, eq=False)
class Edit:
    """A scene before and after its actions.

    Attributes:
        path: the file that is edited; a copy, if it is a part of a merged file.
        source: the file as messages name it.
        before, after: the scene before the first action and after the last one.
        reports: what each action has done.
        parts: the models of the file in order, without those whose last Gaussian an action has removed.
        data: photos of the scene in the coordinates of the file, or None.
    """

    path: Path
    source: Path
    before: EditState
    after: EditState
    reports: list[ActionReport]
    parts: list[EditedPart]
    data: Scene | None

    @property
    def profile(self) -> str:
        """Return the profile of the first model."""
        return self.parts[0].profile

    def render(self, camera: Camera) -> tuple[Tensor, Tensor]:
        """Return renders (H, W, 3) of both scenes in [0, 1] from one camera, given in coordinates before the edit."""
        views = ((self.before.model, camera), (self.after.model, self.after.placement.move_camera(camera)))
        before, after = (render_view(model, view).rgb.clamp(0, 1) for model, view in views)
        return before, after


def open_scene(path: Path, source: Path, data: Scene | None, progress: Progress) -> Edit:
    """Read the scene of a file as an edit without actions.

    Args:
        path: a file of one model, or a merged file.
        source: the file as messages name it.
        data: photos of the scene, or None.
        progress: called with `TaskEvent`s by the actions.

    Raises:
        HyrfError: the file cannot be read, or holds no Gaussian.
        HyrfDataError: the photos do not belong to the model, or to the first one of a merged file.
    """
    with Container.open(path, SECTION_CONTENTS) as container:
        files = open_parts(container) if PART_NAMES in container.entries else [("", container)]
        model, metadata = decode_parts(container), [read_metadata(part) for _, part in files]
        provenances = [read_provenance(part) for _, part in files]
    if not len(model):
        raise HyrfError(f"{source}: there is no Gaussian in it, so there is nothing to edit", fix="train it again")
    parts = [
        EditedPart(name, facts.profile, provenance, part, part)
        for (name, _), facts, provenance, part in zip(files, metadata, provenances, parts_of(model), strict=True)
    ]
    captures = {
        part.name: Capture({"config": facts.config, "provenance": part.provenance})
        for part, facts in zip(parts, metadata, strict=True)
    }
    scene = parts[0]
    capture = captures[scene.name]
    data = place_photos(capture.facts, data)
    if mismatch := Capture(capture.facts, data).mismatch:
        raise HyrfDataError(mismatch, fix=MISMATCH_REMEDY)
    state = EditState(
        source,
        captures,
        model,
        capture.cameras,
        capture.viewpoint.center,
        capture.viewpoint.up,
        [] if data is None else list(data.train),
        Placement(),
        progress,
        held_out=[] if data is None else list(data.test),
        has_gains=scene.before.exposure is not None or has_mean_exposure(scene.provenance),
    )
    return Edit(path, source, state, state, [], parts, data)


def apply_actions(edit: Edit, actions: Sequence[Action]) -> Edit:
    """Apply actions to an opened scene.

    Raises:
        HyrfError: no Gaussian is left, or an action needs photos or cameras that there are not.
    """
    state, reports = edit.before, []
    for action in actions:
        state, report = _apply_action(action, state)
        reports.append(report)
    names = state.model.names if isinstance(state.model, MergedModel) else ("",)
    sources = {part.name: part for part in edit.parts}
    parts = []
    for name, after in zip(names, parts_of(state.model), strict=True):
        part, placement = sources[name], state.placement
        provenance = part.provenance if placement.is_identity else move_provenance(placement, part.provenance)
        edited = replace(part, after=after, provenance=provenance)
        if "psnr" in provenance and not edited.keeps_appearance:
            edited = replace(edited, provenance={**provenance, PSNR_BEFORE_KEY: PSNR_BEFORE_EDIT})
        parts.append(edited)
    if state.has_chosen_up:
        viewpoint = state.capture.viewpoint
        camera = state.placement.move_camera(viewpoint.camera)
        turned = replace(viewpoint, center=state.center, up=state.up, camera=camera)
        parts[0] = replace(parts[0], provenance={**parts[0].provenance, "viewpoint": turned.to_json()})
    return replace(edit, after=state, reports=reports, parts=parts)


def _apply_action(action: Action, state: EditState) -> tuple[EditState, ActionReport]:
    """Apply one action; return the scene after the action, and the report about the action."""
    count = len(state.model)
    report = ActionReport(str(action), count, count)
    if isinstance(action, EstimateUp):
        up, basis = estimate_up(state.photo_cameras("from which up could be estimated"))
        x, y, z = (up.round(4) + 0.0).tolist()  # adding 0.0 turns -0.0 into 0.0
        return replace(state, up=up, has_chosen_up=True), replace(
            report, action=f"{Up((x, y, z))}, estimated from {basis}"
        )
    if isinstance(action, Up):
        return replace(state, up=unit_vector(action.direction), has_chosen_up=True), report
    if isinstance(action, Background):
        changed = partial(replace_config, background=False, solid=action.color)
        return replace(state, model=map_parts(changed, state.model)), report
    if isinstance(action, Refit):
        return _refit(action, state, report)
    if (step := _action_placement(action, state)) is not None:
        return state.move(step), report
    keep = keep_mask(action, state)
    if not keep.any():
        positions = state.world_positions()
        low, high = (corner.round(4).tolist() for corner in (positions.min(axis=0), positions.max(axis=0)))
        where = f"; all centres lie between {low} and {high}" if isinstance(action, Crop | Remove) else ""
        raise HyrfError(f"'{action}' would remove every Gaussian{where}", fix="choose another region or limit")
    after = _keep_gaussians(keep, state)
    return after, replace(report, gaussians_after=len(after.model))


def _keep_gaussians(keep: np.ndarray, state: EditState) -> EditState:
    """Return the scene with only the Gaussians in a mask (N,). Parts of a merged file without any are left out."""
    kept = map_parts(
        lambda part: part.requires_grad_(False), state.model.subset(torch.from_numpy(np.flatnonzero(keep)))
    )
    if not isinstance(kept, MergedModel):
        return replace(state, model=kept)
    remaining = kept.without_emptied_parts(parts_of(state.model))
    for name in kept.names:
        if name not in remaining.names:
            _LOG.info(f"part '{name}' has no Gaussian left and is left out")
    if remaining.names[0] == kept.names[0]:
        return replace(state, model=remaining)
    _LOG.info(f"the file now has the background, the viewpoint and the cameras of part '{remaining.names[0]}'")
    capture, placement = state.captures[remaining.names[0]], state.placement
    return replace(
        state,
        model=remaining,
        cameras=[placement.move_camera(camera) for camera in capture.cameras],
        center=placement.move_point(capture.viewpoint.center),
        up=state.up if state.has_chosen_up else placement.move_direction(capture.viewpoint.up),
        has_scene=False,
    )


def _refit(action: Refit, state: EditState, report: ActionReport) -> tuple[EditState, ActionReport]:
    """Train the Gaussians of a region; return the scene after the training, and the completed report."""
    if isinstance(state.model, MergedModel):
        raise HyrfError(
            "a region of a merged file cannot be trained, because photos show only one of its models",
            fix="take the part out with `part`, train its region, and merge again",
        )
    if not state.photos:
        raise HyrfError("a region is trained on photos, but no photos are given", fix="name the photos with `data`")
    is_selected = keep_mask(action.region, state)
    if not is_selected.any():
        raise HyrfError(
            f"'{action}' would train nothing, because its region holds no Gaussian", fix="change the region"
        )
    model = refit_region(
        state.model, is_selected, state.photos, action.steps, has_gains=state.has_gains, progress=state.progress
    )
    scores = score_region((state.model, model), is_selected, state.held_out)
    report = replace(report, gaussians_trained=int(is_selected.sum()))
    if scores is not None:
        report = replace(report, region_psnr_before=scores[0], region_psnr_after=scores[1])
    return replace(state, model=model), report


def _action_placement(action: Action, state: EditState) -> Placement | None:
    """Return the map of world positions that an action applies; None if the action moves nothing."""
    if isinstance(action, Move):
        return placement_of(action)
    if isinstance(action, Upright):
        return Placement(rotation=upright_rotation(unit_vector(state.up), np.eye(3)["xyz".index(action.axis)]))
    if isinstance(action, Center):
        return Placement.translation(-state.center)
    return None
