"""Scores of an export: the loss of the written file, and of splats of each exposure, in its report."""

from __future__ import annotations

import logging
from dataclasses import replace

from hyrfpack.choices import CONSISTENT_EXPOSURE, SPLAT_EXPOSURES
from hyrfpack.counts import format_count
from hyrfpack.export.baked_scene import BakedScene, SplatsWithBackground
from hyrfpack.export.measure import MIN_ROUNDED_PSNR_DB, PsnrScores, measure_psnr
from hyrfpack.export.report import ExportReport
from hyrfpack.export.source import Source
from hyrfpack.progress import Progress, part_of_progress
from hyrfpack.splats.table import ENDINGS_WITH_ORIGIN, FORMATS, FileKind

_LOG = logging.getLogger(__name__)

MIN_REPORTED_COST_DB = 1.0


def measure_export(
    result: ExportReport,
    loaded: Source,
    baked: BakedScene,
    decoded: SplatsWithBackground,
    kind: FileKind,
    progress: Progress,
) -> ExportReport:
    """Measure the loss of an export, and return its report with the PSNR fields filled in.

    Args:
        result: the report without scores.
        loaded: the model as photographed, with its cameras.
        baked: the scene that was written.
        decoded: the splats as read back from the file.
        kind: kind of the file.
        progress: called with `TaskEvent`s.
    """
    if not loaded.measured_views:
        _LOG.info("quality is not measured, because no photo is held out")
        return result
    _LOG.info(f"measuring at {format_count(len(loaded.measured_views), 'view')}")
    file_share = 0.57 if baked.by_exposure else 1.0
    result = _add_file_scores(result, baked, decoded, kind, part_of_progress(progress, 0.0, file_share))
    if not baked.by_exposure:
        return result
    return _add_exposure_scores(result, loaded, baked, part_of_progress(progress, file_share, 1.0))


def _add_file_scores(
    result: ExportReport, baked: BakedScene, decoded: SplatsWithBackground, kind: FileKind, progress: Progress
) -> ExportReport:
    """Add the scores of the baked splats and of the file, and log a warning if the format costs much."""
    loaded, candidates = baked.source, {"baked": (baked.splats, baked.picture), "file": decoded}
    scores = measure_psnr(loaded.all_parts, candidates, loaded.measured_views, sphere=baked.sphere, progress=progress)
    if not scores:
        _LOG.warning("quality is not measured, because the masks leave no pixel of the held-out photos")
        return result
    file_scores, baked_scores = scores["file"], scores["baked"]
    if loss := _describe_loss(baked_scores, file_scores):
        _warn_of_loss(loss, loaded, kind)
    return replace(
        result,
        views=file_scores.views,
        views_fitted=loaded.fits_measured_views,
        psnr_baked=baked_scores.model,
        psnr=file_scores.model,
        photos_model=scores["model"].photos,
        photos_file=file_scores.photos,
    )


def _warn_of_loss(loss: str, loaded: Source, kind: FileKind) -> None:
    """Log a warning that a format causes a loss, as `_describe_loss` says it, and what to do about it."""
    if loaded.model.config.antialiased and not kind.stores_antialiased:
        alternatives = " or ".join(row.ending for row in FORMATS.values() if row.stores_antialiased)
        _LOG.warning(
            f"{kind.ending} cannot store that the model is antialiased: set it in the program that draws the file, or "
            f"choose {alternatives}"
        )
        return
    where = "" if loaded.cameras else " at generated viewpoints"
    _LOG.warning(
        f"{kind.ending} {loss}{where}, because its numbers are too coarse for this scene; choose another format "
        f"({', '.join(ENDINGS_WITH_ORIGIN)}), move the scene to the origin, or scale the scene"
    )


def _add_exposure_scores(result: ExportReport, loaded: Source, baked: BakedScene, progress: Progress) -> ExportReport:
    """Add the scores of splats of both exposures, against the model as photographed and against photos."""
    scores = measure_psnr(
        loaded.all_parts,
        baked.by_exposure,
        loaded.measured_views,
        sphere=baked.sphere,
        consistent=(CONSISTENT_EXPOSURE,),
        progress=progress,
    )
    by_exposure = {name: scores[name] for name in SPLAT_EXPOSURES if name in scores}
    return replace(
        result,
        psnr_by_exposure={name: score.model for name, score in by_exposure.items()},
        photos_by_exposure={name: score.photos for name, score in by_exposure.items() if score.photos is not None},
    )


def _describe_loss(baked_scores: PsnrScores, file_scores: PsnrScores) -> str | None:
    """Say what a format loses, against photos or else against the model; None if that hardly shows.

    Args:
        baked_scores, file_scores: scores of the baked splats and of the file as read back.
    """
    if baked_scores.photos is not None and file_scores.photos is not None:
        cost = baked_scores.photos - file_scores.photos
        return f"costs {cost:.1f} dB" if cost > MIN_REPORTED_COST_DB else None
    # A low PSNR that the baked splats have already is not the format's fault.
    is_low = file_scores.model < min(MIN_ROUNDED_PSNR_DB, baked_scores.model - MIN_REPORTED_COST_DB)
    return f"leaves {file_scores.model:.1f} dB" if is_low else None
