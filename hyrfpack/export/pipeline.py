"""The export of a model: bake, select Gaussians, write the file, read it back and measure the loss."""

from __future__ import annotations

import copy
import logging
import math
import os
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from hyrfpack.atomic import write_atomic
from hyrfpack.checks import check_choice, check_type
from hyrfpack.choices import CONSISTENT_EXPOSURE, DEFAULT_SPZ_VERSION, LOCAL_EXPOSURE, SPLAT_EXPOSURES
from hyrfpack.errors import HyrfError
from hyrfpack.export.background import background_picture, background_splats
from hyrfpack.export.bake import CameraVisibility, bake, compute_visibility
from hyrfpack.export.cameras import encode_transforms, write_colmap
from hyrfpack.export.degree import choose_degree
from hyrfpack.export.folder import export_player
from hyrfpack.export.kinds import (
    COLMAP_FOLDER,
    HTML_PAGE,
    PLAYER_FOLDER,
    POINT_FILES,
    TRANSFORMS_JSON,
    check_model,
    check_place,
    check_request,
    find_file_kind,
    select_splats,
)
from hyrfpack.export.measure import PsnrScores, measure_psnr
from hyrfpack.export.pages import encode_baked_page, write_native_page
from hyrfpack.export.points import encode_points
from hyrfpack.export.report import ExportReport
from hyrfpack.export.source import Source
from hyrfpack.format import find_model
from hyrfpack.lock import exclusive_folder
from hyrfpack.outputs import Outputs
from hyrfpack.progress import Report, no_report, report_part
from hyrfpack.scene import Scene
from hyrfpack.splats.formats.hints import Hints
from hyrfpack.splats.splats import Splats, concatenate
from hyrfpack.splats.table import FORMATS, FileKind, SplatFormat
from hyrfpack.web.html import decode_splats_page

_LOG = logging.getLogger(__name__)

MIN_REPORTED_COST_DB = 1.0


def export_model(
    source: str | os.PathLike[str],
    target: str | os.PathLike[str],
    *,
    degree: int | None = None,
    data: Scene | None = None,
    crop: Sequence[float] | None = None,
    min_opacity: float = 0.0,
    background: bool = True,
    spz_version: int = DEFAULT_SPZ_VERSION,
    baked: bool = False,
    exposure: str = LOCAL_EXPOSURE,
    colmap: bool = False,
    overwrite: bool = True,
    report: Report = no_report,
) -> ExportReport:
    """Write a `.hyrf` model in a format of other programs, in its own axes and units, and measure the loss.

    The ending of `target` names the format:

    - .ply, .splat, .spz, .glb, .usda, .usdc, .usdz, .sog: 3D Gaussians with spherical harmonics;
    - .html: a self-contained page that shows the scene in any browser, with the `.hyrf` file inside;
    - no ending: a folder with a player and the file, for a web server (see `hyrfpack.export_player`);
    - .points.ply, .points.glb: the Gaussians' centres as coloured points, and the cameras as frusta;
    - .json: the cameras as a transforms.json.

    The loss is not measured for a cropped scene, nor for an output of only points, only cameras or the model itself.

    Args:
        source: the model, a `.hyrf` file or the folder of a run.
        target: the file or the folder to write.
        degree: degree of the spherical harmonics, 0 to 3; ".splat" has 0. None chooses the lowest degree that scores
            about as well as the best at validation cameras. The result is not measured at these.
        data: photos of the scene. Colours are fitted at the training cameras, and the held-out photos score the result.
            Without photos, the cameras that the file keeps are used, or else rings of cameras around the scene.
        crop: (min x, min y, min z, max x, max y, max z) in world units; Gaussians whose centres lie outside, and the
            background, are left out. Infinite numbers leave a side open.
        min_opacity: Gaussians with a lower opacity are left out.
        background: whether to export the model's background.
        spz_version: version of ".spz" files, 4 or 3 (for programs that do not read 4), see `Hints`.
        baked: write splats into a page instead of the model.
        exposure: exposure of baked splats. "local" exposes their colours like the photos that see them, by the model's
            exposure map, so that the splats look as photographed; "consistent" ignores the map. Both are the same for
            a model without a map.
        colmap: write cameras and points into a folder, as a COLMAP model.
        overwrite: replace existing files. If False, an existing file is an error. A file that appears during the export
            is kept: a single file gets a free name in its folder, which the report contains; in a folder it is an
            error.
        report: called with the current activity and the share of the work that is done, 0 to 1.

    Raises:
        HyrfError: a file cannot be read or written, the options contradict each other, or another call is writing into
            the folder.
        TypeError: `data` is not a Scene.
        ValueError: `exposure` is neither "local" nor "consistent".

    Example:
        >>> import hyrfpack
        >>> report = hyrfpack.export_model("bonsai.hyrf", "bonsai.spz", degree=1, background=False)
        >>> report.degree, report.bytes > 0, report.psnr > 10
        (1, True, True)
    """
    if data is not None:
        check_type("data", data, Scene)
    check_choice("exposure", exposure, SPLAT_EXPOSURES)
    kind = find_file_kind(target, colmap)
    check_request(kind, target, degree, crop, min_opacity, background, baked, exposure)
    source = find_model(source)
    if kind is PLAYER_FOLDER:
        return export_player(source, target, data=data, overwrite=overwrite)
    if kind is COLMAP_FOLDER:
        check_place(target, Outputs(source, scene=data, overwrite=True), colmap)
    with exclusive_folder(target) if kind is COLMAP_FOLDER else nullcontext():
        check_place(target, Outputs(source, scene=data, overwrite=overwrite), colmap)
        return _export_checked(
            source, target, kind, degree=degree, data=data, crop=crop, min_opacity=min_opacity, background=background,
            spz_version=spz_version, baked=baked, exposure=exposure, overwrite=overwrite, report=report,
        )  # fmt: skip


def _export_checked(
    source: str | os.PathLike[str],
    target: str | os.PathLike[str],
    kind: FileKind,
    *,
    degree: int | None,
    data: Scene | None,
    crop: Sequence[float] | None,
    min_opacity: float,
    background: bool,
    spz_version: int,
    baked: bool,
    exposure: str,
    overwrite: bool,
    report: Report,
) -> ExportReport:
    """Export after the request has been checked; if the output is a folder, the caller has locked it."""
    loaded = Source.read(source, data)
    if kind is HTML_PAGE and not baked:
        return write_native_page(loaded, source, target, overwrite)
    if kind in (TRANSFORMS_JSON, COLMAP_FOLDER) and (loaded.has_coarse_cameras or not loaded.cameras):
        kept = "only coarse cameras" if loaded.has_coarse_cameras else "no cameras"
        raise HyrfError(
            f"{source}: it keeps {kept}",
            fix="export the cameras from the file that training wrote, or give the photos with `data`",
        )
    if kind is TRANSFORMS_JSON:
        return _export_cameras(loaded, target, overwrite)
    points = kind in (COLMAP_FOLDER, *POINT_FILES)
    sphere = background and crop is None and loaded.model.config.background and not points
    check_model(loaded, kind, crop, min_opacity, sphere)
    by_exposure = {LOCAL_EXPOSURE: loaded, CONSISTENT_EXPOSURE: _without_exposure_map(loaded)}
    photographed, loaded = loaded, by_exposure[exposure]
    compares_exposures = photographed.model.exposure is not None and crop is None and bool(loaded.measured_views)
    places = f"{len(loaded.fit_cameras)} " + (
        "cameras"
        if loaded.cameras
        else "viewpoints around the scene, because the file stores no cameras (name photos with `data`)"
    )
    highest = kind.max_degree if degree is None else min(degree, kind.max_degree)
    chosen_by: dict[int, float] = {}
    visibility = None
    bake_starts = 0.35 if degree is None and highest else 0.0
    if degree is None and highest:
        _LOG.info(f"choosing the degree of the spherical harmonics at {places}")
        visibility = compute_visibility(loaded.model, loaded.fit_cameras, report_part(report, 0.0, 0.15))
        degree, chosen_by = choose_degree(
            loaded.model, loaded.fit_cameras, highest, visibility, report_part(report, 0.15, bake_starts)
        )
        _LOG.info(f"chosen degree {degree}: {_format_scores(chosen_by)} against the model for degrees 0 to {highest}")
    else:
        degree = highest
    _LOG.info(f"fitting colours of degree {degree} at {places}")
    visibility = visibility or compute_visibility(loaded.model, loaded.fit_cameras, report_part(report, 0.0, 0.25))
    bake_as = partial(
        _bake_scene, degree=degree, visibility=visibility, crop=crop, min_opacity=min_opacity, kind=kind, sphere=sphere
    )
    splats, count, picture = bake_as(loaded, report=report_part(report, bake_starts or 0.25, 0.4))
    if points:
        return _export_points(loaded, kind, target, splats, overwrite)
    exposures: ShownSplats = {}
    if compares_exposures:
        (other,) = set(SPLAT_EXPOSURES) - {exposure}
        _LOG.info(f"fitting colours of {other} exposure for comparison")
        rival, _, rival_picture = bake_as(by_exposure[other], report=report_part(report, 0.4, 0.5))
        exposures = {exposure: (splats, picture), other: (rival, rival_picture)}
    del bake_as, visibility  # to free memory, because they are large for many Gaussians and cameras
    _LOG.info(f"writing {len(splats) - count:,} Gaussians{' and the background' if sphere else ''}")
    report(f"writing {len(splats) - count:,} Gaussians", 0.5)
    if isinstance(kind, SplatFormat):
        packed, shown = _pack_splats(loaded, splats, Path(target), kind, spz_version)
    else:
        packed, shown = _pack_page(loaded, splats, picture, Path(target))
    written = write_atomic(target, packed, overwrite=overwrite)
    result = ExportReport(
        str(written),
        len(packed),
        len(splats),
        background=count,
        degree=degree,
        chosen_by=chosen_by,
        exposure=None if photographed.model.exposure is None else exposure,
    )
    del packed
    if crop is not None:
        _LOG.info("quality is not measured, because a part of the scene was cropped")
        return result
    measured = _add_scores(result, loaded, shown, kind, sphere, report_part(report, 0.65, 0.85 if exposures else 1.0))
    if not exposures:
        return measured
    return _add_exposure_scores(measured, photographed, exposures, sphere, report_part(report, 0.85, 1.0))


def _without_exposure_map(loaded: Source) -> Source:
    """Return a copy without the exposure map, for renders and bakes of consistent exposure; parameters are shared."""
    model = copy.copy(loaded.model)
    model.exposure = None
    return replace(loaded, model=model)


def _bake_scene(
    loaded: Source,
    *,
    degree: int,
    visibility: Sequence[CameraVisibility],
    crop: Sequence[float] | None,
    min_opacity: float,
    kind: FileKind,
    sphere: bool,
    report: Report,
) -> tuple[Splats, int, np.ndarray | None]:
    """Bake a model with its background.

    Returns:
        The splats, the number of those at their end that represent the background, and the picture of the background
        for kinds of files that hold one, else None.
    """
    splats = select_splats(
        bake(loaded.model, loaded.fit_cameras, (degree,), visibility, report)[degree], crop, min_opacity
    )
    if not sphere:
        return splats, 0, None
    if kind is HTML_PAGE:
        return splats, 0, background_picture(loaded.model, cameras=loaded.fit_cameras, visibility=visibility)
    distant = background_splats(loaded.model, loaded.fit_cameras, kind.max_scale, visibility)
    return concatenate((splats, distant)), len(distant), None


# Splats by name, each with the picture of its background or None: "baked" before writing, "file" as read back.
ShownSplats = dict[str, tuple[Splats, np.ndarray | None]]


def _pack_page(loaded: Source, splats: Splats, picture: np.ndarray | None, target: Path) -> tuple[bytes, ShownSplats]:
    """Encode a page of splats, and return its bytes with the splats before and after encoding."""
    data = encode_baked_page(loaded, splats, picture, target.stem)
    return data, {"baked": (splats, picture), "file": decode_splats_page(data, str(target))}


def _pack_splats(
    loaded: Source, splats: Splats, target: Path, splat_format: SplatFormat, spz_version: int
) -> tuple[bytes, ShownSplats]:
    """Encode a file of splats, and return its bytes with the splats before and after encoding."""
    first = loaded.cameras[0][1] if loaded.cameras else None
    data = splat_format.encode(splats, Hints(loaded.up, first, spz_version))
    return data, {"baked": (splats, None), "file": (splat_format.decode(data, str(target)), None)}


def _add_scores(
    result: ExportReport, loaded: Source, shown: ShownSplats, kind: FileKind, sphere: bool, report: Report
) -> ExportReport:
    """Measure the loss, and return the result with the PSNR fields filled in."""
    if not loaded.measured_views:
        _LOG.info("quality is not measured, because no photo is held out")
        return result
    _LOG.info(f"measuring at {len(loaded.measured_views)} views")
    scores = measure_psnr(loaded.model, shown, loaded.measured_views, sphere=sphere, report=report)
    if not scores:
        _LOG.warning("quality is not measured, because the masks leave no pixel of the held-out photos")
        return result
    file, before = scores["file"], scores["baked"]
    cost = _estimate_cost_db(before, file, loaded.photo_mse)
    if cost > MIN_REPORTED_COST_DB:
        where = (
            "" if loaded.cameras else " at generated viewpoints (name photos with `data` for a measurement at theirs)"
        )
        if loaded.model.config.antialiased and not kind.stores_antialiased:
            alternatives = " or ".join(
                splat_format.ending for splat_format in FORMATS.values() if splat_format.stores_antialiased
            )
            _LOG.warning(
                f"{kind.ending} cannot store that the model is antialiased: set it in the program that draws the "
                f"file, or choose {alternatives}"
            )
        else:
            _LOG.warning(
                f"{kind.ending} costs {cost:.1f} dB{where}: it is too coarse for this scene, perhaps for its unit of "
                "length; choose another format"
            )
    return replace(
        result,
        views=file.views,
        psnr_baked=before.model,
        psnr=file.model,
        photos_model=scores["model"].photos,
        photos_file=file.photos,
    )


def _add_exposure_scores(
    result: ExportReport, loaded: Source, exposures: ShownSplats, sphere: bool, report: Report
) -> ExportReport:
    """Add the scores of splats of both exposures, against the model as photographed and against photos."""
    scores = measure_psnr(loaded.model, exposures, loaded.measured_views, sphere=sphere, report=report)
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


def _export_cameras(loaded: Source, target: str | os.PathLike[str], overwrite: bool) -> ExportReport:
    data = encode_transforms(loaded.cameras)
    written = write_atomic(target, data, overwrite=overwrite)
    return ExportReport(str(written), len(data), cameras=len(loaded.cameras))


def _export_points(
    loaded: Source, kind: FileKind, target: str | os.PathLike[str], splats: Splats, overwrite: bool
) -> ExportReport:
    """Write the centres of splats as points, and the cameras."""
    if kind is COLMAP_FOLDER:
        write_colmap(loaded.cameras, target, splats, overwrite=overwrite)
        size = sum(table.stat().st_size for table in Path(target, "sparse", "0").glob("*.bin"))
        return ExportReport(str(target), size, cameras=len(loaded.cameras))
    data = encode_points(
        splats, [camera for _, camera in loaded.cameras], "glb" if kind.ending.endswith("glb") else "ply", loaded.up
    )
    written = write_atomic(target, data, overwrite=overwrite)
    return ExportReport(str(written), len(data), len(splats), cameras=len(loaded.cameras))


def _format_scores(scores: dict[int, float]) -> str:
    return ", ".join(f"{score:.2f}" for score in scores.values()) + " dB"
