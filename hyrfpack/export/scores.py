"""Scores of an export: the loss of the written file, and of splats of each exposure, in its report."""

from __future__ import annotations

import logging
import math
from dataclasses import replace

from hyrfpack.choices import CONSISTENT_EXPOSURE, SPLAT_EXPOSURES
from hyrfpack.counts import format_count
from hyrfpack.export.baked_scene import BakedScene, SplatsWithBackground
from hyrfpack.export.measure import PsnrScores, measure_psnr
from hyrfpack.export.report import ExportReport
from hyrfpack.export.source import Source
from hyrfpack.measure.psnr import mse_from_psnr
from hyrfpack.progress import Progress, part_of_progress
from hyrfpack.splats.table import FORMATS, FileKind

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
    cost = _estimate_cost_db(baked_scores, file_scores, loaded.photo_mse)
    if cost > MIN_REPORTED_COST_DB:
        _warn_of_cost(cost, loaded, kind)
    return replace(
        result,
        views=file_scores.views,
        views_fitted=loaded.fits_measured_views,
        psnr_baked=baked_scores.model,
        psnr=file_scores.model,
        photos_model=scores["model"].photos,
        photos_file=file_scores.photos,
    )


def _warn_of_cost(cost: float, loaded: Source, kind: FileKind) -> None:
    """Log a warning that a format loses `cost` dB, and what to do about it."""
    if loaded.model.config.antialiased and not kind.stores_antialiased:
        alternatives = " or ".join(row.ending for row in FORMATS.values() if row.stores_antialiased)
        _LOG.warning(
            f"{kind.ending} cannot store that the model is antialiased: set it in the program that draws the file, or "
            f"choose {alternatives}"
        )
        return
    where = "" if loaded.cameras else " at generated viewpoints"
    _LOG.warning(
        f"{kind.ending} costs {cost:.1f} dB{where}, because its numbers are too coarse for this scene; choose another "
        "format, or scale the scene"
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


def _estimate_cost_db(baked_scores: PsnrScores, file_scores: PsnrScores, model_mse: float) -> float:
    """Return the loss of PSNR in dB against photos that a format causes, measured or, without photos, estimated.

    The estimate assumes that the errors of the format are independent of those of the model, so that squared errors
    add up. Rounding errors far below the model's own error then cost almost nothing.

    Args:
        baked_scores, file_scores: scores of the baked splats and of the file as read back.
        model_mse: mean squared error of the model's pictures against its photos.
    """
    if baked_scores.photos is not None and file_scores.photos is not None:
        return baked_scores.photos - file_scores.photos
    file_mse, baked_mse = (mse_from_psnr(scores.model) for scores in (file_scores, baked_scores))
    return 10 * math.log10((model_mse + file_mse) / (model_mse + baked_mse))
