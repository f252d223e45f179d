"""Scores of a model against photos it has not seen."""

from __future__ import annotations

import os
import statistics
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import nullcontext
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np
import torch

from hyrfpack.checks import check_type
from hyrfpack.choices import AS_PHOTOGRAPHED, CONSISTENT_EXPOSURE
from hyrfpack.device import upload
from hyrfpack.errors import HyrfError
from hyrfpack.evaluate.exposure import corrected
from hyrfpack.evaluate.figures import comparison
from hyrfpack.evaluate.lpips import LPIPS
from hyrfpack.evaluate.metrics import psnr, ssim, to_8bit
from hyrfpack.lock import exclusive_folder
from hyrfpack.model import HybridModel
from hyrfpack.parallel.ranks import SINGLE_PROCESS, Ranks
from hyrfpack.progress import Report, no_report
from hyrfpack.render import RenderSettings, apply_exposure_map, render
from hyrfpack.render.files import save_picture, unique_stems
from hyrfpack.scene import Camera, View, evenly_spaced
from hyrfpack.splats.draw import Drawable, draw

PICTURES = 6  # of photo, render and error beside each other that are written, unless told otherwise
NO_LPIPS = (
    "no weights: LPIPS needs the trained network of the lpips package; "
    'pass a file made by torch.save(lpips.LPIPS(net="alex").state_dict(), FILE)'
)


@dataclass(frozen=True)
class ViewScore:
    """One held-out view, as in `Evaluation`."""

    name: str
    psnr: float
    psnr_consistent: float | None
    psnr_corrected: float
    ssim: float
    lpips: float | None


@dataclass(frozen=True)
class Evaluation:
    """Scores on held-out views; the first five are means over `views`.

    Attributes:
        psnr: dB, pooled over each picture's pixels and channels, then averaged over views; of renders as photographed,
            which is what `hyrfpack.render` shows, unless `settings` ask for the consistent exposure.
        psnr_consistent: of renders at the model's one consistent exposure; None of a model without an exposure map, and
            of splats.
        psnr_corrected: of renders brought to the colours of the very photo that they are scored against, see
            `hyrfpack.evaluate.exposure.corrected`.
        ssim: 11x11 Gaussian window, sigma 1.5; of the renders of `psnr`.
        lpips: perceptual distance, or None.
        lpips_reason: why lpips is None, or which network made it.
        gaussians: how many the model has.
        seconds_per_frame: median time to render a view, everything warm and what does not depend on the view decoded
            beforehand.
        views: scores of each view.
        skipped: names of views whose mask leaves no pixel to score.
    """

    psnr: float
    psnr_consistent: float | None
    psnr_corrected: float
    ssim: float
    lpips: float | None
    lpips_reason: str
    gaussians: int
    seconds_per_frame: float
    views: list[ViewScore] = field(default_factory=list)
    skipped: list[str] = field(default_factory=list)

    def to_dict(self) -> dict:
        """Plain numbers, strings, lists and dictionaries, ready for JSON."""
        return asdict(self)


@torch.no_grad()
def evaluate(
    model: HybridModel | Drawable,
    views: Sequence[View],
    *,
    lpips_weights: str | os.PathLike[str] | None = None,
    settings: RenderSettings = RenderSettings(),  # noqa: B008 - frozen
    pictures: str | os.PathLike[str] | None = None,
    picture_count: int = PICTURES,
    overwrite: bool = True,
    report: Report = no_report,
    warn: Callable[[str], None] | None = None,
    ranks: Ranks = SINGLE_PROCESS,
) -> Evaluation:
    """Render held-out views and score them against their photos.

    Renders are clamped and rounded to 8 bits first, as they would be saved. Photos with transparency are laid over
    the model's solid colour; splats have none, and are shown over black like the photos. Masked pixels do not count.

    Args:
        model: what to score, or splats ready to be drawn (`hyrfpack.splats.draw.Drawable`).
        views: photos to compare with, not used in training.
        lpips_weights: see `hyrfpack.evaluate.lpips`; without it lpips is None.
        settings: how to render, and at which exposure.
        pictures: folder for photo | render | error pictures of `picture_count` views spread over `views`.
        overwrite: replace files in `pictures`; without it, one that is there is an error.
        report: told of each view before it is scored, and the share of the work that is done. Each of several
            processes reports its own share.
        warn: told of each picture that cannot be written, while scoring continues; without it that is an error.
        ranks: processes that share the views, each of which gets all scores.

    Raises:
        HyrfError: there is no view to score, a file cannot be read or written, or another call is at work in the
            folder `pictures`.
        TypeError: the model, a view or the settings are something else.

    Example:
        >>> import hyrfpack
        >>> scores = hyrfpack.evaluate(hyrfpack.load("bonsai.hyrf"), hyrfpack.load_scene("photos/bonsai").test)
        >>> len(scores.views), scores.psnr > 10, scores.lpips is None
        (2, True, True)
    """
    if not isinstance(model, Drawable):
        check_type("model", model, HybridModel)
    check_type("settings", settings, RenderSettings)
    for view in views if isinstance(views, Sequence) else [views]:
        check_type("each of the views", view, View)
    if not views:
        raise HyrfError("there is no view to score; name a split that has photos or a smaller `test_every`")
    perceptual = None if lpips_weights is None else LPIPS.load(lpips_weights)
    if isinstance(model, Drawable):
        solid, device, count = np.zeros(3, np.float32), model.device, len(model.positions)
    else:
        solid, device = np.array(model.config.solid, dtype=np.float32), model.gaussians.positions.device
        count = len(model)
    drawn = picture_names(views, picture_count)

    def scored() -> list[tuple[int, ViewScore | None, float]]:
        """Place, score (None where the mask leaves nothing) and seconds of each view that is this rank's."""
        draw_colors = _color_renderer(model, settings)
        draw_colors(views[0].camera)  # compiles kernels and fills caches
        scores: list[tuple[int, ViewScore | None, float]] = []
        own = ranks.share(list(enumerate(views)))
        for done, (number, view) in enumerate(own):
            report(f"scoring photo {done + 1} of {len(own)}", done / len(own))
            photo = view.load()
            reference, mask = upload(photo, solid, device)
            if mask is not None and not mask.any():
                scores.append((number, None, 0.0))
                continue
            started = _now(device)
            rgb, consistent = draw_colors(view.camera)
            seconds = _now(device) - started
            image = to_8bit(rgb)
            distance = None
            if perceptual is not None:
                seen = image if mask is None else torch.where(mask[..., None], image, reference)
                distance = perceptual(seen, reference)
            score = ViewScore(
                name=view.name,
                psnr=psnr(image, reference, mask),
                psnr_consistent=None if consistent is None else psnr(to_8bit(consistent), reference, mask),
                psnr_corrected=psnr(corrected(image, reference, mask), reference, mask),
                ssim=ssim(image, reference, mask),
                lpips=distance,
            )
            scores.append((number, score, seconds))
            if pictures is not None and number in drawn:
                sheet = comparison(reference, image, mask, _caption(score))
                try:
                    save_picture(Path(pictures, drawn[number]), sheet, overwrite=overwrite, rename=False)
                except HyrfError as error:
                    if warn is None:
                        raise
                    warn(str(error))
        report(f"{len(own)} photos are scored", 1.0)
        return scores

    with nullcontext() if pictures is None else exclusive_folder(pictures, ranks=ranks):
        rows_of_ranks = ranks.all_gather(ranks.run_on_all(scored))
        told = sorted((row for rows in rows_of_ranks for row in rows), key=lambda row: row[0])
    scores = [score for _, score, _ in told if score is not None]
    if not scores:
        raise HyrfError("the masks of all views leave no pixel to score; check that white means 'use this pixel'")
    return Evaluation(
        psnr=statistics.fmean(score.psnr for score in scores),
        psnr_consistent=_mean(score.psnr_consistent for score in scores),
        psnr_corrected=statistics.fmean(score.psnr_corrected for score in scores),
        ssim=statistics.fmean(score.ssim for score in scores),
        lpips=_mean(score.lpips for score in scores),
        lpips_reason=NO_LPIPS if perceptual is None else f"network {perceptual.name}",
        gaussians=count,
        seconds_per_frame=statistics.median(seconds for _, score, seconds in told if score is not None),
        views=scores,
        skipped=[views[number].name for number, score, _ in told if score is None],
    )


def _color_renderer(
    model: HybridModel | Drawable, settings: RenderSettings
) -> Callable[[Camera], tuple[torch.Tensor, torch.Tensor | None]]:
    """Return a function that renders a camera: (H, W, 3) as `settings` ask, and (H, W, 3) at the consistent exposure.

    The second is None of a model without an exposure map and of splats. What does not depend on the view is decoded
    once.
    """
    if isinstance(model, Drawable):
        return lambda camera: (draw(model, camera, settings).rgb, None)
    decoded, at_one_exposure = model.decode(), replace(settings, exposure=CONSISTENT_EXPOSURE)

    def draw_colors(camera: Camera) -> tuple[torch.Tensor, torch.Tensor | None]:
        rgb = render(model, camera, at_one_exposure, decoded=decoded).rgb
        if model.exposure is None:
            return rgb, None
        return apply_exposure_map(model, camera, rgb) if settings.exposure == AS_PHOTOGRAPHED else rgb, rgb

    return draw_colors


def _mean(values: Iterable[float | None]) -> float | None:
    """The mean of those that are there, None of none."""
    there = [value for value in values if value is not None]
    return statistics.fmean(there) if there else None


def picture_names(views: Sequence[View], count: int = PICTURES) -> dict[int, str]:
    """What `evaluate` writes into its folder of pictures: the views' places in the list, and names of files."""
    names = unique_stems([view.name for view in views])
    return {place: f"{names[place]}.png" for place in evenly_spaced(range(len(views)), count)}


def _caption(score: ViewScore) -> str:
    perceptual = "" if score.lpips is None else f"   LPIPS {score.lpips:.3f}"
    return f"{score.name}   {score.psnr:.2f} dB   SSIM {score.ssim:.3f}{perceptual}"


def _now(device: torch.device) -> float:
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter()
