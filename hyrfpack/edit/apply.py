"""Apply actions to a scene in turn."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from hyrfpack.cameras.capture import Capture, has_mean_exposure
from hyrfpack.cameras.paths import estimate_up
from hyrfpack.config.edit import Action, Background, Center, EstimateUp, Move, Refit, Up, Upright
from hyrfpack.edit.refit import refit, score_region
from hyrfpack.edit.report import ActionReport
from hyrfpack.edit.select import keep_mask
from hyrfpack.edit.state import EditState
from hyrfpack.edit.transform import Placement, replace_config, unit_vector
from hyrfpack.errors import HyrfError
from hyrfpack.format.codec import load_with_provenance
from hyrfpack.format.info import describe_file
from hyrfpack.progress import Progress
from hyrfpack.render import render_view
from hyrfpack.scene import Camera, Scene
from hyrfpack.splats.placement import upright_rotation


@dataclass(frozen=True, eq=False)
class Edit:
    """A scene before and after its actions.

    Attributes:
        path: the file that is edited.
        profile: its profile.
        capture: the cameras and the viewpoint that the file keeps.
        before, after: the scene before the first action and after the last one.
        reports: what each action has done.
        provenance: the provenance of the edited file.
    """

    path: Path
    profile: str
    capture: Capture
    before: EditState
    after: EditState
    reports: list[ActionReport]
    provenance: dict

    @property
    def keeps_gaussians(self) -> bool:
        """Return whether all numbers of the Gaussians are as before."""
        before, after = (state.model.gaussians.parameters() for state in (self.before, self.after))
        return all(torch.equal(old, new) for old, new in zip(before, after, strict=True))

    def render(self, camera: Camera) -> tuple[Tensor, Tensor]:
        """Return renders (H, W, 3) of both scenes in [0, 1] from one camera, given in coordinates before the edit."""
        views = ((self.before.model, camera), (self.after.model, self.after.placement.move_camera(camera)))
        before, after = (render_view(model, view).rgb.clamp(0, 1) for model, view in views)
        return before, after


def open_scene(path: Path, data: Scene | None, progress: Progress) -> Edit:
    """Read the scene of a file, to which no action has been applied.

    Args:
        path: a file of one model.
        data: photos of the scene, or None.
        progress: called with `TaskEvent`s by the actions.

    Raises:
        HyrfError: the file cannot be read, or holds no Gaussian.
    """
    model, provenance = load_with_provenance(path)
    facts = describe_file(path)
    if not len(model):
        raise HyrfError(f"{path}: there is no Gaussian in it, so there is nothing to edit", fix="train it again")
    capture = Capture(facts)
    state = EditState(
        model,
        capture.cameras,
        capture.viewpoint.center,
        capture.viewpoint.up,
        [] if data is None else list(data.train),
        Placement(),
        progress,
        held_out=[] if data is None else list(data.test),
        has_gains=model.exposure is not None or has_mean_exposure(provenance),
    )
    return Edit(path, facts["profile"], capture, state, state, [], provenance)


def apply_actions(edit: Edit, actions: Sequence[Action]) -> Edit:
    """Apply actions to an opened scene.

    Raises:
        HyrfError: no Gaussian is left, or an action needs photos or cameras that there are not.
    """
    state, reports = edit.before, []
    if any(isinstance(action, EstimateUp) for action in actions) and edit.capture.is_synthetic and not state.photos:
        raise HyrfError(
            f"{edit.path}: it keeps no cameras, from which up could be estimated",
            fix="state the direction, or name `data`",
        )
    for action in actions:
        state, report = _apply_action(action, state)
        reports.append(report)
    provenance = edit.provenance if state.placement.is_identity else state.placement.move_provenance(edit.provenance)
    if any(isinstance(action, Up | EstimateUp) for action in actions):
        viewpoint = edit.capture.viewpoint
        camera = state.placement.move_camera(viewpoint.camera)
        turned = replace(viewpoint, center=state.center, up=state.up, camera=camera)
        provenance = {**provenance, "viewpoint": turned.to_json()}
    return replace(edit, after=state, reports=reports, provenance=provenance)


def _apply_action(action: Action, state: EditState) -> tuple[EditState, ActionReport]:
    """Apply one action; return the scene after it, and what was done."""
    count = len(state.model)
    report = ActionReport(str(action), count, count)
    if isinstance(action, EstimateUp):
        up, basis = estimate_up([view.camera for view in state.photos] or state.cameras)
        x, y, z = (up.round(4) + 0.0).tolist()  # adding 0.0 turns -0.0 into 0.0
        return replace(state, up=up), replace(report, action=f"{Up((x, y, z))}, estimated from {basis}")
    if isinstance(action, Up):
        return replace(state, up=unit_vector(action.direction)), report
    if isinstance(action, Background):
        return replace(state, model=replace_config(state.model, background=False, solid=action.color)), report
    if isinstance(action, Refit):
        return _refit(action, state, report)
    if (step := _find_move(action, state)) is not None:
        return state.move(step), report
    keep = keep_mask(action, state)
    if not keep.any():
        positions = state.world_positions()
        low, high = (corner.round(4).tolist() for corner in (positions.min(axis=0), positions.max(axis=0)))
        raise HyrfError(
            f"'{action}' would leave no Gaussian; their centres lie between {low} and {high}",
            fix="change its numbers",
        )
    kept = state.model.subset(torch.from_numpy(np.flatnonzero(keep)))
    after = replace(state, model=kept.requires_grad_(False))
    return after, replace(report, gaussians_after=len(after.model))


def _refit(action: Refit, state: EditState, report: ActionReport) -> tuple[EditState, ActionReport]:
    """Train the Gaussians of a region; return the scene after it, and the scores of the region on held-out photos."""
    if not state.photos:
        raise HyrfError("a region is trained on photos, and there are none", fix="name the photos with `data`")
    is_selected = keep_mask(action.region, state)
    if not is_selected.any():
        raise HyrfError(f"'{action}' trains nothing, as no Gaussian lies there", fix="change its region")
    model = refit(
        state.model, is_selected, state.photos, action.steps, has_gains=state.has_gains, progress=state.progress
    )
    scores = score_region((state.model, model), is_selected, state.held_out)
    report = replace(report, gaussians_trained=int(is_selected.sum()))
    if scores is not None:
        report = replace(report, region_psnr_before=scores[0], region_psnr_after=scores[1])
    return replace(state, model=model), report


def _find_move(action: Action, state: EditState) -> Placement | None:
    """Return the map of world positions that an action applies, None if it moves nothing."""
    if isinstance(action, Move):
        return Placement.of(action)
    if isinstance(action, Upright):
        return Placement(rotation=upright_rotation(unit_vector(state.up), np.eye(3)["xyz".index(action.axis)]))
    if isinstance(action, Center):
        return Placement.translation(-state.center)
    return None
