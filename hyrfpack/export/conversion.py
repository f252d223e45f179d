"""Conversion of splats between the formats of other programs, with a measurement of the loss."""

from __future__ import annotations

import logging
import os
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from statistics import fmean

import numpy as np

from hyrfpack.atomic import write_atomic
from hyrfpack.cameras.paths import Viewpoint
from hyrfpack.checks import check_type
from hyrfpack.config.export import ConvertConfig
from hyrfpack.context import RunContext
from hyrfpack.counts import format_count
from hyrfpack.errors import HyrfError, suggest_command
from hyrfpack.export.kinds import (
    STREAMED_SOG_FOLDER,
    check_package,
    check_spz_version,
    find_kind_by_ending,
    select_splats,
)
from hyrfpack.export.measure import MIN_ROUNDED_PSNR_DB, measure_splats_psnr
from hyrfpack.outputs import Outputs
from hyrfpack.progress import Progress, TaskEvent, part_of_progress
from hyrfpack.splats.draw import Drawable
from hyrfpack.splats.files import READABLE_ENDINGS, bytes_on_disk, read_splats
from hyrfpack.splats.formats.hints import Hints
from hyrfpack.splats.names import find_sog_folder, is_splats
from hyrfpack.splats.splats import Splats
from hyrfpack.splats.table import ENDINGS_WITH_ORIGIN, FORMATS, SplatFormat
from hyrfpack.splats.viewpoints import WeightedSplats, check_not_empty, sample_viewpoints

_LOG = logging.getLogger(__name__)

MEASURED_VIEWS = 12
MEASURED_SIZE_PIXELS = 400
# Smaller Gaussians are points in pictures of the whole scene, so that it does not show if their scales are clamped.
MIN_VISIBLE_SCALE_RADII = 1e-3


@dataclass(frozen=True)
class ConversionReport:
    """The result of a conversion of splats.

    Attributes:
        file: path of the written file.
        bytes_before, bytes_after: sizes on disk of the source and of the file.
        gaussians_before, gaussians_after: numbers of Gaussians in the source and in the file.
        degree_before, degree_after: degrees of their spherical harmonics.
        views: number of viewpoints at which the loss was measured.
        psnr: mean PSNR over the views, in dB, of the file's pictures against the source's, both over black. The file is
            read back from its bytes. If the source is cropped, only the Gaussians in the box are compared.
        psnr_worst: PSNR in dB of the worst view.
    """

    file: str
    bytes_before: int
    bytes_after: int
    gaussians_before: int
    gaussians_after: int
    degree_before: int
    degree_after: int
    views: int
    psnr: float
    psnr_worst: float

    def to_dict(self) -> dict:
        """Return the fields as plain numbers and strings that JSON can hold."""
        return asdict(self)


def convert_splats(
    source: str | os.PathLike[str],
    target: str | os.PathLike[str],
    config: ConvertConfig | None = None,
    *,
    overwrite: bool = True,
    context: RunContext = RunContext(),  # noqa: B008 - frozen
) -> ConversionReport:
    """Convert splats between the formats of other programs, in their own axes and units, and measure the loss.

    A warning is logged for each property of the splats that the format cannot hold, and if its rounding leaves less
    than MIN_ROUNDED_PSNR_DB.

    Args:
        source: .ply (plain or compressed), .splat, .spz, .sog, or the folder of an unbundled SOG.
        target: the file to write; its ending names the format: .ply, .splat, .spz, .glb, .usda, .usdc, .usdz or .sog.
        config: what to keep, and how to write it; None for the defaults.
        overwrite: replace a file at `target`. If False, an existing file is an error. A file that appears during the
            conversion is kept, and the result gets a free name in its folder, which the report contains.
        context: how progress is shown and the call is stopped.

    Raises:
        HyrfDataError: the source cannot be read, or holds no Gaussian that is visible.
        HyrfError: the target is not a format of splats or cannot be written, or the options leave no Gaussian.

    Example:
        >>> import hyrfpack
        >>> result = hyrfpack.convert_splats("bonsai.ply", "bonsai.splat")
        >>> result.degree_after, result.bytes_after == 32 * result.gaussians_after, result.psnr > 20
        (0, True, True)
    """
    kind = find_target_format(source, target)
    config = ConvertConfig() if config is None else config
    check_type("config", config, ConvertConfig)
    check_spz_version(kind, target, config)
    check_package(kind, target)
    Outputs(source, folders=[find_sog_folder(source)], overwrite=overwrite).file(target)
    with context.open_progress("convert") as progress:
        return _convert(source, target, kind, config, overwrite, progress)


def _convert(
    source: str | os.PathLike[str],
    target: str | os.PathLike[str],
    kind: SplatFormat,
    config: ConvertConfig,
    overwrite: bool,
    progress: Progress,
) -> ConversionReport:
    """Read, select, write and measure splats."""
    progress(TaskEvent(f"reading {Path(source).name}", 0.0))
    splats = read_splats(source)
    check_not_empty(splats, str(source))
    cropped = splats if config.crop is None else select_splats(splats, config.crop)
    selected = select_splats(cropped, None, config.min_opacity)
    max_degree = kind.max_degree if config.degree is None else min(kind.max_degree, config.degree)
    selected = selected.with_degree(min(selected.degree, max_degree))
    weighted = WeightedSplats.from_splats(cropped, str(source))
    _check_limits(kind, splats, selected, weighted.radius)
    camera = Viewpoint.from_frame(weighted.frame.center, weighted.frame.scale).camera
    hints = Hints(camera=camera, spz_version=config.spz_version)
    progress(TaskEvent(f"writing {format_count(len(selected), 'Gaussian')} as {kind.ending}", 0.2))
    data = kind.encode(selected, hints)
    progress(TaskEvent("reading the file back", 0.5))
    decoded = kind.decode(data, str(target))
    psnr = _measure_psnr(cropped, decoded, weighted, part_of_progress(progress, 0.6, 0.9))
    if fmean(psnr) < MIN_ROUNDED_PSNR_DB and not kind.stores_origin:
        # `_check_limits` has already warned if the format cannot store `antialiased`.
        comparable = replace(decoded, antialiased=selected.antialiased)
        rounding = _measure_psnr(selected, comparable, weighted, part_of_progress(progress, 0.9, 1.0))
        _warn_of_rounding(kind, fmean(rounding))
    written_path = write_atomic(target, data, overwrite=overwrite)
    return ConversionReport(
        file=str(written_path),
        bytes_before=bytes_on_disk(source),
        bytes_after=len(data),
        gaussians_before=len(splats),
        gaussians_after=len(decoded),
        degree_before=splats.degree,
        degree_after=decoded.degree,
        views=len(psnr),
        psnr=fmean(psnr),
        psnr_worst=min(psnr),
    )


def find_target_format(source: str | os.PathLike[str], target: str | os.PathLike[str]) -> SplatFormat:
    """Find the format of splats that the ending of `target` names.

    Raises:
        HyrfError: the ending names no such format, or the source is not a file of splats. The message names the
            command to use instead, if there is one.
    """
    if not is_splats(source):
        if Path(source).suffix.lower() == ".hyrf":
            raise HyrfError(
                f"{source}: this is a model, not splats",
                fix=f"write it with {suggest_command('export', source, '-o', target)}",
            )
        if (Path(source) / STREAMED_SOG_FOLDER.ending).is_file():
            raise HyrfError(
                f"{source}: this is a Streamed SOG, which has a SOG for each of its parts and levels",
                fix="name one of the folders in it, such as 0_0",
            )
        raise HyrfError(
            f"{source}: this is not a file of splats",
            fix=f"give a file that ends in {', '.join(READABLE_ENDINGS)}, or the folder of a SOG",
        )
    if Path(target).suffix.lower() == ".hyrf":
        raise HyrfError(
            f"{target}: splats are imported as a model, not converted",
            fix=f"run {suggest_command('import', source, '-o', target)}",
        )
    kind = find_kind_by_ending(target)
    if not isinstance(kind, SplatFormat):
        problem = (
            f"{kind.ending} is not a format of splats" if kind else "the file extension does not name a known format"
        )
        raise HyrfError(f"{target}: {problem}", fix=f"use one of {', '.join(FORMATS)}")
    return kind


def _check_limits(kind: SplatFormat, splats: Splats, selected: Splats, radius: float) -> None:
    """Raise HyrfError for positions that the format cannot hold, and log a warning for each other loss.

    Args:
        kind: the format.
        splats: the splats of the source.
        selected: those that are written.
        radius: half the size of the scene, world units.
    """
    reach = float(np.abs(selected.positions).max())
    if reach > kind.max_coordinate:
        raise HyrfError(
            f"the splats reach {reach:,.0f} units from the origin, but {kind.ending} is limited to "
            f"{kind.max_coordinate:,}",
            fix="choose another format, or leave out the far splats with `crop`",
        )
    if splats.degree > kind.max_degree:
        _LOG.warning(
            f"{kind.ending} stores harmonics up to degree {kind.max_degree}; higher ones, up to degree "
            f"{splats.degree}, are lost"
        )
    largest, smallest = selected.scales.max(axis=1), selected.scales.min(axis=1)
    _warn_of_clamped_scales(kind, largest > kind.max_scale, "larger", kind.max_scale)
    if kind.min_scale > MIN_VISIBLE_SCALE_RADII * radius:
        _warn_of_clamped_scales(kind, smallest < kind.min_scale, "smaller", kind.min_scale)
    if splats.antialiased and not kind.stores_antialiased:
        alternatives = " or ".join(row.ending for row in FORMATS.values() if row.stores_antialiased)
        _LOG.warning(
            f"{kind.ending} cannot store that the splats are antialiased: set it in the program that draws the file, "
            f"or choose {alternatives}"
        )


def _warn_of_clamped_scales(kind: SplatFormat, is_clamped: np.ndarray, than: str, limit: float) -> None:
    """Log a warning if the scales of some Gaussians are clamped to a limit of the format; `is_clamped` is (N,) bool."""
    if is_clamped.any():
        _LOG.warning(
            f"scales of {is_clamped.sum():,} of {len(is_clamped):,} Gaussians are {than} than {limit:.3g} units, the "
            f"limit of {kind.ending}, and are clamped to it: choose another format, or change the scene's unit "
            f"({suggest_command('import')}, {suggest_command('edit')} with `scale`, {suggest_command('export')})"
        )


def _warn_of_rounding(kind: SplatFormat, psnr: float) -> None:
    """Log a warning if the rounding of a format, without what was left out on purpose, leaves a low PSNR in dB."""
    if psnr < MIN_ROUNDED_PSNR_DB:
        _LOG.warning(
            f"{kind.ending} leaves {psnr:.1f} dB, because its numbers are too coarse for this scene; choose another "
            f"format ({', '.join(ENDINGS_WITH_ORIGIN)})"
        )


def _measure_psnr(reference: Splats, converted: Splats, weighted: WeightedSplats, progress: Progress) -> list[float]:
    """Measure the PSNR in dB of the pictures of `converted` against those of `reference`, for each view."""
    reference_drawable, converted_drawable = (
        Drawable.from_splats(splats, weighted.frame) for splats in (reference, converted)
    )
    progress(TaskEvent("choosing viewpoints", 0.0))
    cameras = sample_viewpoints(weighted, reference_drawable, MEASURED_VIEWS, MEASURED_SIZE_PIXELS, seed=0)
    scores = []
    for number, camera in enumerate(cameras):
        progress(TaskEvent(f"comparing view {number + 1}/{len(cameras)}", 0.3 + 0.7 * number / len(cameras)))
        scores.append(measure_splats_psnr(reference_drawable, converted_drawable, camera))
    return scores
