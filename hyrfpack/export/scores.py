"""Scores of an export: the loss of the written file, and of splats of each exposure, in its report."""

from __future__ import annotations

import logging
import math
from dataclasses import replace

from hyrfpack.choices import SPLAT_EXPOSURES
from hyrfpack.counts import format_count
from hyrfpack.export.baked_scene import BakedScene, ShownSplats
from hyrfpack.export.measure import PsnrScores, measure_psnr
from hyrfpack.export.report import ExportReport
from hyrfpack.export.source import Source
from hyrfpack.progress import Progress, part_of_progress
from hyrfpack.splats.table import FORMATS, FileKind

_LOG = logging.getLogger(__name__)

MIN_REPORTED_COST_DB = 1.0


def measure_export(
    result: ExportReport, loaded: Source, baked: BakedScene, written: ShownSplats, kind: FileKind, progress: Progress
) -> ExportReport:
    """Measure the loss of an export, and return its report with the PSNR fields filled in.

    Args:
        result: the report without scores.
        loaded: the model as photographed, with its cameras.
        baked: the scene that was written.
        written: the splats as read back from the file.
        kind: kind of the file.
        progress: called with `TaskEvent`s.
    """
    if not loaded.measured_views:
        _LOG.info("quality is not measured, because no photo is held out")
        return result
    _LOG.info(f"measuring at {format_count(len(loaded.measured_views), 'view')}")
    file_share = 0.57 if baked.by_exposure else 1.0
    result = _add_file_scores(result, baked, written, kind, part_of_progress(progress, 0.0, file_share))
    if not baked.by_exposure:
        return result
    return _add_exposure_scores(result, loaded, baked, part_of_progress(progress, file_share, 1.0))


def _add_file_scores(
    result: ExportReport, baked: BakedScene, written: ShownSplats, kind: FileKind, progress: Progress
) -> ExportReport:
    """Add the scores of the baked splats and of the file, and log a warning if the format costs much."""
    loaded, shown = baked.source, {"baked": (baked.splats, baked.picture), "file": written}
    scores = measure_psnr(loaded.drawn, shown, loaded.measured_views, sphere=baked.sphere, progress=progress)
    if not scores:
        _LOG.warning("quality is not measured, because the masks leave no pixel of the held-out photos")
        return result
    file, before = scores["file"], scores["baked"]
    cost = _estimate_cost_db(before, file, loaded.photo_mse)
    if cost > MIN_REPORTED_COST_DB:
        _warn_of_cost(cost, loaded, kind)
    return replace(
        result,
        views=file.views,
        views_fitted=loaded.fits_measured_views,
        psnr_baked=before.model,
        psnr=file.model,
        photos_model=scores["model"].photos,
        photos_file=file.photos,
    )


def _warn_of_cost(cost: float, loaded: Source, kind: FileKind) -> None:
    """Log a warning that a format loses `cost` dB, and what to do about it."""
    if loaded.model.config.antialiased and not kind.stores_antialiased:
        able = " or ".join(splat_format.ending for splat_format in FORMATS.values() if splat_format.stores_antialiased)
        _LOG.warning(
            f"{kind.ending} cannot store that the model is antialiased: set it in the program that draws the file, or "
            f"choose {able}"
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
        loaded.drawn, baked.by_exposure, loaded.measured_views, sphere=baked.sphere, progress=progress
    )
    by_exposure = {name: scores[name] for name in SPLAT_EXPOSURES if name in scores}
    return replace(
        result,
        psnr_by_exposure={name: score.model for name, score in by_exposure.items()},
        photos_by_exposure={name: score.photos for name, score in by_exposure.items() if score.photos is not None},
    )


def _estimate_cost_db(before: PsnrScores, after: PsnrScores, error: float) -> float:
    """Return the loss of PSNR in dB against photos that a format causes, measured or, without photos, estimated.

    The estimate assumes that the errors of the format are independent of those of the model, so that squared errors
    add up. Rounding errors far below the model's own error then cost almost nothing.

    Args:
        before, after: scores of the baked splats and of the file as read back.
        error: mean squared error of the model's pictures against its photos.
    """
    if before.photos is not None and after.photos is not None:
        return before.photos - after.photos
    return 10 * math.log10((error + 10 ** (-after.model / 10)) / (error + 10 ** (-before.model / 10)))
