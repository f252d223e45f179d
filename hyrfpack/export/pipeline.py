"""Exporting a model: bake, choose, write, read back, measure."""

from __future__ import annotations

import copy
import math
import os
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from hyrfpack.atomic import write_atomic
from hyrfpack.checks import check_choice, check_type
from hyrfpack.choices import CONSISTENT_EXPOSURE, LOCAL_EXPOSURE, SPLAT_EXPOSURES
from hyrfpack.errors import HyrfError
from hyrfpack.export.background import background_picture, background_splats
from hyrfpack.export.bake import Sight, bake, sights_of
from hyrfpack.export.cameras import encode_transforms, write_colmap
from hyrfpack.export.degree import choose_degree
from hyrfpack.export.folder import player
from hyrfpack.export.kinds import (
    COLMAP,
    PAGE,
    PLAYER,
    POINTS,
    TRANSFORMS,
    check_model,
    check_place,
    check_request,
    chosen,
    kind_of,
)
from hyrfpack.export.measure import Likeness, likeness
from hyrfpack.export.pages import baked_page, write_native_page
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
from hyrfpack.web.html import decode_page

COARSE = 1.0  # dB of PSNR against photos that a format may cost before something is said about it

Say = Callable[[str], None]


def export(
    source: str | os.PathLike[str],
    target: str | os.PathLike[str],
    *,
    degree: int | None = None,
    data: Scene | None = None,
    crop: Sequence[float] | None = None,
    min_opacity: float = 0.0,
    background: bool = True,
    spz_version: int = 3,
    baked: bool = False,
    exposure: str = LOCAL_EXPOSURE,
    colmap: bool = False,
    overwrite: bool = True,
    say: Say = lambda sentence: None,
    report: Report = no_report,
) -> ExportReport:
    """Write a `.hyrf` model as what other programs read, in its own axes and units, and measure what was lost.

    The ending of `target` names the format:

    - .ply, .splat, .spz, .glb, .usda, .usdc, .usdz, .sog: 3D Gaussians with spherical harmonics;
    - .html: a page that shows the scene in any browser, by itself, with the `.hyrf` file inside; no ending: a folder
      with a player and the file, for a web server (see `hyrfpack.export.player`);
    - .points.ply, .points.glb: the Gaussians' centres as coloured points, and the cameras as frusta;
    - .json: the cameras as a transforms.json.

    Nothing is measured where a part of the scene was cropped, only points or cameras were written, or the model itself.

    Args:
        source: the model, a `.hyrf` file or the folder of a run.
        target: the file, or the folder, to write.
        degree: of the spherical harmonics, 0 to 3; ".splat" has 0. None for the lowest one that looks as good as any
            at cameras that are kept back for the purpose, and are not those that the result is measured at.
        data: photos of the scene: colours are fitted where they were taken from, the held-out ones are scored. Without
            them the cameras that the file keeps serve, or else rings of them around the scene.
        crop: (min x, min y, min z, max x, max y, max z) in world units; Gaussians whose centres lie outside, and the
            background, are left out. Infinite numbers leave a side open.
        min_opacity: fainter Gaussians are left out.
        background: whether the model's background goes along.
        spz_version: of ".spz", 3 (which all programs read) or 4.
        baked: a page holds splats instead of the model.
        exposure: of splats that are baked from a model with an exposure map. "local" exposes their colours as the
            photos that see them are, so that the splats look as photographed; "consistent" leaves the map out. The
            same for a model without a map.
        colmap: write cameras and points into a folder, as a COLMAP model.
        overwrite: replace files that are there. Without it, they are an error. One that appears in the meantime is
            kept, too: a single file gets a free name beside it, which the report tells; in a folder it is an error.
        say: told what is going on.
        report: called with what is being done and the share of the work that is done, 0 to 1.

    Raises:
        HyrfError: a file cannot be read or written, the options do not go together, or another call is at work in the
            folder.
        TypeError: `data` is no Scene.
        ValueError: `exposure` is no such word.

    Example:
        >>> import hyrfpack
        >>> report = hyrfpack.export("bonsai.hyrf", "bonsai.spz", degree=1, background=False)
        >>> report.degree, report.bytes > 0, report.psnr > 10
        (1, True, True)
    """
    if data is not None:
        check_type("data", data, Scene)
    check_choice("exposure", exposure, SPLAT_EXPOSURES)
    kind = kind_of(target, colmap)
    check_request(kind, target, degree, crop, min_opacity, background, baked, exposure)
    source = find_model(source)
    if kind is PLAYER:
        return player(source, target, data=data, overwrite=overwrite, say=say)
    if kind is COLMAP:
        check_place(target, Outputs(source, scene=data, overwrite=True), colmap)
    with exclusive_folder(target) if kind is COLMAP else nullcontext():
        check_place(target, Outputs(source, scene=data, overwrite=overwrite), colmap)
        return _export(
            source, target, kind, degree=degree, data=data, crop=crop, min_opacity=min_opacity, background=background,
            spz_version=spz_version, baked=baked, exposure=exposure, overwrite=overwrite, say=say, report=report,
        )  # fmt: skip


def _export(
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
    say: Say,
    report: Report,
) -> ExportReport:
    """As `export`, of what has been checked; into a folder that this call holds, where the kind is one of folders."""
    read = Source.read(source, data)
    if kind is PAGE and not baked:
        return write_native_page(read, source, target, say, overwrite)
    if kind in (TRANSFORMS, COLMAP) and (read.coarse or not read.cameras):
        kept = "only coarse cameras" if read.coarse else "no cameras"
        raise HyrfError(f"{source}: it keeps {kept}; export them from the file that training wrote, or name `data`")
    if kind is TRANSFORMS:
        return _export_cameras(read, target, overwrite)
    points = kind in (COLMAP, *POINTS)
    sphere = background and crop is None and read.model.config.background and not points
    check_model(read, kind, crop, min_opacity, sphere)
    by_exposure = {LOCAL_EXPOSURE: read, CONSISTENT_EXPOSURE: _without_map(read)}
    photographed, read = read, by_exposure[exposure]
    compares_exposures = photographed.model.exposure is not None and crop is None and bool(read.measured)
    places = f"{len(read.fitted)} " + (
        "cameras" if read.cameras else "places around the scene, for the file keeps no cameras (`data` names photos)"
    )
    highest = kind.max_degree if degree is None else min(degree, kind.max_degree)
    chosen_by: dict[int, float] = {}
    sights = None
    bake_starts = 0.35 if degree is None and highest else 0.0
    if degree is None and highest:
        say(f"choosing the degree of the colours among {places}")
        sights = sights_of(read.model, read.fitted, report_part(report, 0.0, 0.15))
        degree, chosen_by = choose_degree(
            read.model, read.fitted, highest, sights, report_part(report, 0.15, bake_starts)
        )
        say(f"degree {degree} it is: {_listed(chosen_by)}, for degrees 0 to {highest} against the model")
    else:
        degree = highest
    say(f"fitting colours of degree {degree} at {places}")
    sights = sights or sights_of(read.model, read.fitted, report_part(report, 0.0, 0.25))
    bake_as = partial(
        _bake_scene, degree=degree, sights=sights, crop=crop, min_opacity=min_opacity, kind=kind, sphere=sphere
    )
    splats, count, picture = bake_as(read, report=report_part(report, bake_starts or 0.25, 0.4))
    if points:
        return _export_points(read, kind, target, splats, overwrite)
    exposures: Shown = {}
    if compares_exposures:
        (other,) = set(SPLAT_EXPOSURES) - {exposure}
        say(f"fitting colours of {other} exposure, to compare with")
        rival, _, rival_picture = bake_as(by_exposure[other], report=report_part(report, 0.4, 0.5))
        exposures = {exposure: (splats, picture), other: (rival, rival_picture)}
    del bake_as, sights  # of many Gaussians and cameras they are large
    say(f"writing {len(splats) - count:,} Gaussians{' and the background' if sphere else ''}")
    report(f"writing {len(splats) - count:,} Gaussians", 0.5)
    if isinstance(kind, SplatFormat):
        packed, shown = _pack_splats(read, splats, Path(target), kind, spz_version)
    else:
        packed, shown = _pack_page(read, splats, picture, Path(target))
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
        say("nothing is measured, for a part of the scene was cropped")
        return result
    measured = _measured(result, read, shown, kind, sphere, say, report_part(report, 0.65, 0.85 if exposures else 1.0))
    if not exposures:
        return measured
    return _with_both_exposures(measured, photographed, exposures, sphere, report_part(report, 0.85, 1.0))


def _without_map(read: Source) -> Source:
    """What renders and bakes at the model's own exposure everywhere. The parameters are shared."""
    model = copy.copy(read.model)
    model.exposure = None
    return replace(read, model=model)


def _bake_scene(
    read: Source,
    *,
    degree: int,
    sights: Sequence[Sight],
    crop: Sequence[float] | None,
    min_opacity: float,
    kind: FileKind,
    sphere: bool,
    report: Report,
) -> tuple[Splats, int, np.ndarray | None]:
    """Splats, how many of them, the last, are the background, and the picture of it for kinds that hold one."""
    splats = chosen(bake(read.model, read.fitted, (degree,), sights, report)[degree], crop, min_opacity)
    if not sphere:
        return splats, 0, None
    if kind is PAGE:
        return splats, 0, background_picture(read.model, cameras=read.fitted, sights=sights)
    behind = background_splats(read.model, read.fitted, kind.max_scale, sights)
    return concatenate((splats, behind)), len(behind), None


# Splats and the picture behind them: those that were to be written ("baked"), and those read back ("file").
Shown = dict[str, tuple[Splats, np.ndarray | None]]


def _pack_page(read: Source, splats: Splats, picture: np.ndarray | None, target: Path) -> tuple[bytes, Shown]:
    """A file's bytes, and what it shows."""
    data = baked_page(read, splats, picture, target.stem)
    return data, {"baked": (splats, picture), "file": decode_page(data, str(target))}


def _pack_splats(
    read: Source, splats: Splats, target: Path, form: SplatFormat, spz_version: int
) -> tuple[bytes, Shown]:
    """A file's bytes, and what it shows."""
    first = read.cameras[0][1] if read.cameras else None
    data = form.encode(splats, Hints(read.up, first, spz_version))
    return data, {"baked": (splats, None), "file": (form.decode(data, str(target)), None)}


def _measured(
    result: ExportReport, read: Source, shown: Shown, kind: FileKind, sphere: bool, say: Say, report: Report
) -> ExportReport:
    """The result with all PSNR filled in."""
    if not read.measured:
        say("nothing is measured, for no photo is held out")
        return result
    say(f"measuring at {len(read.measured)} views")
    scores = likeness(read.model, shown, read.measured, sphere=sphere, report=report)
    if not scores:
        say("nothing is measured, for the masks leave no pixel of the held-out photos")
        return result
    file, before = scores["file"], scores["baked"]
    cost = _cost(before, file, read.error)
    if cost > COARSE:
        seen = "" if read.cameras else ", seen from made-up viewpoints (name photos with `data` to be sure)"
        if read.model.config.antialiased and not kind.stores_antialiased:
            able = " or ".join(form.ending for form in FORMATS.values() if form.stores_antialiased)
            say(f"{kind.ending} cannot tell that the model is antialiased: say so where it is drawn, or choose {able}")
        else:
            say(
                f"{kind.ending} costs {cost:.1f} dB{seen}: it is too coarse for this scene, perhaps for its unit of "
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


def _with_both_exposures(
    result: ExportReport, read: Source, exposures: Shown, sphere: bool, report: Report
) -> ExportReport:
    """The result with the PSNR of splats of each exposure against the model as photographed, and against photos."""
    scores = likeness(read.model, exposures, read.measured, sphere=sphere, report=report)
    found = {name: scores[name] for name in SPLAT_EXPOSURES if name in scores}
    return replace(
        result,
        psnr_by_exposure={name: score.model for name, score in found.items()},
        photos_by_exposure={name: score.photos for name, score in found.items() if score.photos is not None},
    )


def _cost(before: Likeness, after: Likeness, error: float) -> float:
    """PSNR in dB against photos that a format costs: as measured, or where no photos are given, by estimate.

    What the format changes has nothing to do with what the model gets wrong, so squared errors add up: rounding that
    shows only beside the model's own pictures costs nothing.

    Args:
        before, after: what was to be written, and what is read back.
        error: mean squared error of the model's pictures against its photos.
    """
    if before.photos is not None and after.photos is not None:
        return before.photos - after.photos
    return 10 * math.log10((error + 10 ** (-after.model / 10)) / (error + 10 ** (-before.model / 10)))


def _export_cameras(read: Source, target: str | os.PathLike[str], overwrite: bool) -> ExportReport:
    data = encode_transforms(read.cameras)
    written = write_atomic(target, data, overwrite=overwrite)
    return ExportReport(str(written), len(data), cameras=len(read.cameras))


def _export_points(
    read: Source, kind: FileKind, target: str | os.PathLike[str], splats: Splats, overwrite: bool
) -> ExportReport:
    """Centres of splats, and cameras."""
    if kind is COLMAP:
        write_colmap(read.cameras, target, splats, overwrite=overwrite)
        size = sum(table.stat().st_size for table in Path(target, "sparse", "0").glob("*.bin"))
        return ExportReport(str(target), size, cameras=len(read.cameras))
    data = encode_points(
        splats, [camera for _, camera in read.cameras], "glb" if kind.ending.endswith("glb") else "ply", read.up
    )
    written = write_atomic(target, data, overwrite=overwrite)
    return ExportReport(str(written), len(data), len(splats), cameras=len(read.cameras))


def _listed(scores: dict[int, float]) -> str:
    return ", ".join(f"{score:.2f}" for score in scores.values()) + " dB"
