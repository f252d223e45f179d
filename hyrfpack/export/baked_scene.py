"""Bake of a whole scene: the choice of the degree, the fit of colours, the selection of splats, and the background."""

from __future__ import annotations

import copy
import logging
import math
from dataclasses import dataclass, field, replace

import numpy as np

from hyrfpack.choices import CONSISTENT_EXPOSURE, LOCAL_EXPOSURE, SPLAT_EXPOSURES
from hyrfpack.config.export import ExportConfig
from hyrfpack.export.background import make_background_splats, render_background_picture
from hyrfpack.export.bake import keep_mask
from hyrfpack.export.bake_parts import PartsVisibility, bake_parts, compute_parts_visibility
from hyrfpack.export.degree import choose_degree
from hyrfpack.export.kinds import HTML_PAGE, POSITION_KINDS, includes_background, make_selection_mask
from hyrfpack.export.source import Source
from hyrfpack.model import BACKGROUND_RADIUS, Frame, HybridModel
from hyrfpack.model.merged import map_parts, parts_of, scene_of
from hyrfpack.progress import Progress, part_of_progress
from hyrfpack.splats.splats import Splats, concatenate
from hyrfpack.splats.table import FileKind

_LOG = logging.getLogger(__name__)

# In sizes of the scene. The scene of `hyrfpack demo` loses 0.2 dB at 9.1, 1.0 dB at 5.6 and 2.2 dB at 3.6.
MIN_BACKGROUND_RADIUS = 6

# Splats, with the picture of their background or None.
SplatsWithBackground = tuple[Splats, np.ndarray | None]


@dataclass(frozen=True)
class BakedScene:
    """A scene baked to splats.

    Attributes:
        source: the model with the exposure of the splats, and its cameras.
        splats: the splats, those of the background last.
        index: (n,) indices of the model's Gaussians that all splats but those of the background stand for.
        background_count: number of splats that represent the background.
        picture: (H, 2H, 3) picture of the background, for kinds of files that hold one, else None.
        sphere: whether the background is included.
        degree: degree of the harmonics.
        chosen_by: score of each degree in dB, if the degree was chosen.
        exposure: exposure of the splats; None for a model without an exposure map.
        by_exposure: splats of each exposure, to be compared; empty if there is nothing to compare.
    """

    source: Source
    splats: Splats
    index: np.ndarray
    background_count: int
    picture: np.ndarray | None
    sphere: bool
    degree: int
    chosen_by: dict[int, float] = field(default_factory=dict)
    exposure: str | None = None
    by_exposure: dict[str, SplatsWithBackground] = field(default_factory=dict)


def bake_scene(source: Source, kind: FileKind, config: ExportConfig, progress: Progress) -> BakedScene:
    """Bake a model to the splats that a file of a kind needs.

    Args:
        source: the model with its cameras.
        kind: kind of the file.
        config: settings of the export.
        progress: called with `TaskEvent`s.

    Raises:
        HyrfError: the settings leave no Gaussian.
    """
    by_exposure = {LOCAL_EXPOSURE: source, CONSISTENT_EXPOSURE: _remove_exposure_map(source)}
    loaded = by_exposure[config.exposure]
    degree, chosen_by, visibility = _decide_degree(loaded, kind, config, part_of_progress(progress, 0.0, 0.7))
    fit_progress = part_of_progress(progress, 0.7 if chosen_by else 0.5, 0.8)
    baked = _bake_at(loaded, kind, config, degree, visibility, fit_progress)
    has_map = any(part.exposure is not None for part in parts_of(source.all_parts))
    baked = replace(baked, chosen_by=chosen_by, exposure=config.exposure if has_map else None)
    if not has_map or config.crop is not None or not source.measured_views or kind in POSITION_KINDS:
        return baked
    (other_exposure,) = set(SPLAT_EXPOSURES) - {config.exposure}
    _LOG.info(f"fitting colours of {other_exposure} exposure for comparison")
    other_progress = part_of_progress(progress, 0.8, 1.0)
    other_baked = _bake_at(by_exposure[other_exposure], kind, config, degree, visibility, other_progress)
    baked_by_exposure = {config.exposure: baked, other_exposure: other_baked}
    return replace(
        baked, by_exposure={exposure: (each.splats, each.picture) for exposure, each in baked_by_exposure.items()}
    )


def _decide_degree(
    loaded: Source, kind: FileKind, config: ExportConfig, progress: Progress
) -> tuple[int, dict[int, float], PartsVisibility]:
    """Return the degree of the harmonics, the scores if it was chosen by these, and what the cameras see."""
    camera_text = f"{len(loaded.fit_cameras)} " + (
        "cameras"
        if loaded.cameras
        else "viewpoints around the scene, because the file stores no cameras (name photos with `data`)"
    )
    highest = kind.max_degree if config.degree is None else min(config.degree, kind.max_degree)
    if config.degree is not None and config.degree > highest:
        _LOG.info(f"{kind.ending} stores harmonics up to degree {highest}; higher ones are left out")
    degree, chosen_by = highest, dict[int, float]()
    is_chosen = config.degree is None and highest > 0
    if is_chosen:
        _LOG.info(f"choosing the degree of the spherical harmonics at {camera_text}")
        visibility = compute_parts_visibility(
            loaded.all_parts, loaded.fit_cameras, part_of_progress(progress, 0.0, 0.43)
        )
        degree, chosen_by = choose_degree(
            loaded.all_parts, loaded.fit_cameras, highest, visibility, part_of_progress(progress, 0.43, 1.0)
        )
        scores = ", ".join(f"{score:.2f}" for score in chosen_by.values())
        _LOG.info(f"chosen degree {degree}: {scores} dB against the model for degrees 0 to {highest}")
    _LOG.info(f"fitting colours of degree {degree} at {camera_text}")
    if not is_chosen:
        visibility = compute_parts_visibility(
            loaded.all_parts, loaded.fit_cameras, part_of_progress(progress, 0.0, 0.71)
        )
    return degree, chosen_by, visibility


def _bake_at(
    loaded: Source,
    kind: FileKind,
    config: ExportConfig,
    degree: int,
    visibility: PartsVisibility,
    progress: Progress,
) -> BakedScene:
    """Bake a model at a degree, select splats, and add the background."""
    splats = bake_parts(loaded.all_parts, loaded.fit_cameras, (degree,), visibility, progress)[degree]
    sphere = includes_background(loaded, kind, config)
    keep_masks = [keep_mask(part, views) for part, views in zip(parts_of(loaded.all_parts), visibility, strict=True)]
    selected = make_selection_mask(splats.positions, splats.opacities, config.crop, config.min_opacity)
    index = np.flatnonzero(np.concatenate(keep_masks))[selected]
    splats, picture, background_count = splats if selected.all() else splats[selected], None, 0
    if sphere and kind is HTML_PAGE:
        picture = render_background_picture(loaded.model, cameras=loaded.fit_cameras, visibility=visibility[0])
    elif sphere:
        distant = make_background_splats(loaded.model, loaded.fit_cameras, kind.max_scale, visibility[0])
        _warn_of_near_background(loaded.model.config.frame, distant, kind)
        splats, background_count = concatenate((splats, distant)), len(distant)
    return BakedScene(loaded, splats, index, background_count, picture, sphere, degree)


def _warn_of_near_background(frame: Frame, distant: Splats, kind: FileKind) -> None:
    """Log a warning if the largest scale of a format brings the background so near that views from aside show it."""
    nearest = np.linalg.norm(distant.positions - frame.center, axis=1).min(initial=math.inf) / frame.scale
    if nearest < MIN_BACKGROUND_RADIUS:
        _LOG.warning(
            f"{kind.ending} has scales of at most {kind.max_scale:.3g} units, so that the background is drawn at "
            f"{nearest:.2g} times the size of the scene in place of {BACKGROUND_RADIUS:.0f}; scale the scene down, or "
            "choose another format"
        )


def _remove_exposure_map(loaded: Source) -> Source:
    """Return a copy without the exposure map, for renders and bakes of consistent exposure; parameters are shared."""

    def without_map(part: HybridModel) -> HybridModel:
        changed = copy.copy(part)
        changed.exposure = None
        return changed

    all_parts = map_parts(without_map, loaded.all_parts)
    return replace(loaded, model=scene_of(all_parts), all_parts=all_parts)
