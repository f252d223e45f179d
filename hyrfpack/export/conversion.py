"""Converting splats between the formats of other programs, and measuring what was lost."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import fmean

import numpy as np

from hyrfpack.atomic import write_atomic
from hyrfpack.cameras.paths import Viewpoint
from hyrfpack.errors import HyrfDataError, HyrfError
from hyrfpack.export.kinds import check_request, chosen
from hyrfpack.export.measure import psnr_of_splats
from hyrfpack.outputs import Outputs
from hyrfpack.progress import Report, no_report, report_part
from hyrfpack.splats.draw import Drawable
from hyrfpack.splats.files import READABLE_ENDINGS, read_splats
from hyrfpack.splats.formats.hints import Hints
from hyrfpack.splats.names import bytes_on_disk, is_splats, sog_folder
from hyrfpack.splats.splats import Splats
from hyrfpack.splats.table import FORMATS, SplatFormat
from hyrfpack.splats.viewpoints import WeightedSplats, sample_viewpoints

MEASURED_VIEWS, MEASURED_SIZE_PIXELS = 12, 400


@dataclass(frozen=True)
class ConversionReport:
    """What a conversion of splats came to.

    Attributes:
        file: what was written.
        bytes_before, bytes_after: on disk, of the source and of the file.
        gaussians_before, gaussians_after: in the source and in the file.
        degree_before, degree_after: of their spherical harmonics.
        views: viewpoints that the loss was measured at.
        psnr: dB, mean over the views, of the file's pictures, as read back from its bytes, against the source's, both
            over black. Of a cropped source, what lies in the box alone is compared.
        psnr_worst: dB, of the view with the least.
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
        """Plain numbers and strings, ready for JSON."""
        return asdict(self)


def convert(
    source: str | os.PathLike[str],
    target: str | os.PathLike[str],
    *,
    degree: int | None = None,
    crop: Sequence[float] | None = None,
    min_opacity: float = 0.0,
    overwrite: bool = True,
    say: Callable[[str], None] = lambda sentence: None,
    report: Report = no_report,
) -> ConversionReport:
    """Convert splats from one format of other programs to another, in their own axes and units, and measure the loss.

    Args:
        source: .ply (plain or compressed), .splat, .spz, .sog, or the folder of a SOG that is not bundled.
        target: the file to write; its ending names the format: .ply, .splat, .spz, .glb, .usda, .usdc, .usdz or .sog.
        degree: highest degree of the spherical harmonics to keep, 0 to 3; None keeps all that the format can hold.
        crop: (min x, min y, min z, max x, max y, max z) in world units; Gaussians whose centres lie outside are left
            out. Infinite numbers leave a side open.
        min_opacity: fainter Gaussians are left out.
        overwrite: replace a file at `target`. Without it, one that is there is an error, and one that appears in the
            meantime is kept: the result gets a free name beside it, which the report names.
        say: told what the format cannot hold.
        report: called with what is being done and the share of the work that is done, 0 to 1.

    Raises:
        HyrfDataError: the source cannot be read, or shows nothing.
        HyrfError: the target is no format of splats or cannot be written, or the options leave no Gaussian.

    Example:
        >>> import hyrfpack
        >>> result = hyrfpack.convert("bonsai.ply", "bonsai.splat")
        >>> result.degree_after, result.bytes_after == 32 * result.gaussians_after, result.psnr > 20
        (0, True, True)
    """
    form = format_of(source, target)
    check_request(form, target, degree, crop, min_opacity)
    Outputs(source, folder=sog_folder(source), overwrite=overwrite).file(target)
    report(f"reading {Path(source).name}", 0.0)
    splats = read_splats(source)
    if not len(splats):
        raise HyrfDataError(f"{source}: there is no Gaussian in it, so there is nothing to convert; name another file")
    whole = splats if crop is None else chosen(splats, crop)
    kept = chosen(whole, None, min_opacity)
    kept = kept.with_degree(min(kept.degree, form.max_degree, kept.degree if degree is None else degree))
    _tell_of_limits(form, splats, kept, say)
    weighted = WeightedSplats.from_splats(whole, str(source))
    hints = Hints(camera=Viewpoint.from_frame(weighted.frame.center, weighted.frame.scale).camera)
    report(f"writing {len(kept):,} Gaussians as {form.ending}", 0.2)
    data = form.encode(kept, hints)
    report("reading them back", 0.5)
    after = form.decode(data, str(target))
    psnr = _measure(whole, after, weighted, report_part(report, 0.6, 1.0))
    written = write_atomic(target, data, overwrite=overwrite)
    return ConversionReport(
        file=str(written),
        bytes_before=bytes_on_disk(source),
        bytes_after=len(data),
        gaussians_before=len(splats),
        gaussians_after=len(after),
        degree_before=splats.degree,
        degree_after=after.degree,
        views=len(psnr),
        psnr=fmean(psnr),
        psnr_worst=min(psnr),
    )


def format_of(source: str | os.PathLike[str], target: str | os.PathLike[str]) -> SplatFormat:
    """Return the format of splats that the ending of `target` names.

    Raises:
        HyrfError: it names none, or the source is no file of splats; another command may be the one for them.
    """
    if not is_splats(source):
        if Path(source).suffix.lower() == ".hyrf":
            raise HyrfError(
                f"{source}: this is a model, not splats; write it with 'hyrfpack export {source} -o {target}'"
            )
        raise HyrfError(
            f"{source}: this is no file of splats; name one of {', '.join(READABLE_ENDINGS)}, or the folder of a SOG"
        )
    name = Path(target).name.lower()
    if name.endswith(".hyrf"):
        raise HyrfError(f"{target}: a model is learnt from splats; run 'hyrfpack import {source} -o {target}'")
    if name.endswith(".compressed.ply"):
        raise HyrfError(f"{target}: compressed PLY is read, not written; name a .sog or .spz file, which are smaller")
    form = FORMATS.get(Path(name).suffix)
    if form is None:
        raise HyrfError(f"{target}: the ending names the format; end it in one of {', '.join(FORMATS)}")
    return form


def _tell_of_limits(form: SplatFormat, splats: Splats, kept: Splats, say: Callable[[str], None]) -> None:
    """Refuse positions that the format cannot hold, and say what else it cannot."""
    reach = float(np.abs(kept.positions).max())
    if reach > form.max_coordinate:
        raise HyrfError(
            f"the splats reach {reach:,.0f} units from the origin, and {form.ending} {form.max_coordinate:,}; "
            "name another format, or leave the far ones out with `crop`"
        )
    if splats.degree > form.max_degree:
        say(
            f"{form.ending} holds no harmonics above degree {form.max_degree}; those of degree {splats.degree} are lost"
        )
    if splats.antialiased and not form.stores_antialiased:
        able = " or ".join(row.ending for row in FORMATS.values() if row.stores_antialiased)
        say(f"{form.ending} cannot tell that the splats are antialiased: set it where they are drawn, or choose {able}")


def _measure(before: Splats, after: Splats, weighted: WeightedSplats, report: Report) -> list[float]:
    """PSNR of the pictures of `after` against those of `before`, by view."""
    original, converted = (Drawable.from_splats(splats, weighted.frame) for splats in (before, after))
    report("choosing viewpoints to compare at", 0.0)
    cameras = sample_viewpoints(weighted, original, MEASURED_VIEWS, MEASURED_SIZE_PIXELS, seed=0)
    scores = []
    for number, camera in enumerate(cameras):
        report(f"comparing view {number + 1} of {len(cameras)}", 0.3 + 0.7 * number / len(cameras))
        scores.append(psnr_of_splats(original, converted, camera))
    return scores
