"""Scores of a model against held-out photos."""

from __future__ import annotations

import os
import statistics
from collections.abc import Iterable, Sequence
from contextlib import nullcontext
from dataclasses import asdict, dataclass, field
from pathlib import Path

import torch

from hyrfpack.checks import check_type
from hyrfpack.counts import format_count
from hyrfpack.errors import HyrfError
from hyrfpack.evaluate.lpips import LPIPS
from hyrfpack.evaluate.view_scores import ViewScore, ViewScorer
from hyrfpack.lock import exclusive_folder
from hyrfpack.model import HybridModel
from hyrfpack.model.merged import MergedModel
from hyrfpack.out_of_memory import explain_out_of_memory
from hyrfpack.parallel.ranks import SINGLE_PROCESS, Ranks
from hyrfpack.progress import Progress, TaskEvent, ignore_progress
from hyrfpack.render import RenderSettings
from hyrfpack.render.files import save_picture, unique_stems
from hyrfpack.scene import View, evenly_spaced
from hyrfpack.splats.draw import Drawable

DEFAULT_PICTURE_COUNT = 6
NO_LPIPS_REASON = (
    "no weights: LPIPS needs the trained network of the lpips package; "
    'pass a file made by torch.save(lpips.LPIPS(net="alex").state_dict(), FILE)'
)


@dataclass(frozen=True)
class Evaluation:
    """Scores on held-out views; the first five are means over `views`.

    Attributes:
        psnr: PSNR in dB, from the squared error pooled over the pixels and channels of each view, averaged over views.
            Renders are at the exposure as photographed, like those of `hyrfpack.render_view`, unless `settings` ask for
            the consistent exposure.
        psnr_consistent: PSNR of renders at the model's consistent exposure; None for splats, for merged models and for
            models without an exposure map.
        psnr_corrected: PSNR of renders after an affine colour correction to the photo that they are scored against, see
            `hyrfpack.evaluate.exposure.correct_colors`.
        ssim: SSIM of the renders of `psnr`, with a Gaussian window of 11x11 pixels and sigma 1.5.
        lpips: LPIPS of the renders of `psnr`, or None without weights.
        lpips_reason: why lpips is None, or the network that computed it.
        gaussians: number of Gaussians of the model.
        seconds_per_frame: median time to render a view after warm-up, with everything that does not depend on the view
            decoded beforehand.
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
        """Return the attributes as nested dictionaries and lists, ready for JSON."""
        return asdict(self)


@explain_out_of_memory("reduce `max_size`")
@torch.no_grad()
def evaluate_model(
    model: HybridModel | MergedModel | Drawable,
    views: Sequence[View],
    *,
    lpips_weights: str | os.PathLike[str] | None = None,
    settings: RenderSettings = RenderSettings(),  # noqa: B008 - frozen
    pictures: str | os.PathLike[str] | None = None,
    picture_count: int = DEFAULT_PICTURE_COUNT,
    overwrite: bool = True,
    progress: Progress = ignore_progress,
    unwritten: list[str] | None = None,
    ranks: Ranks = SINGLE_PROCESS,
) -> Evaluation:
    """Render held-out views and score them against their photos.

    Renders are first clamped and rounded to 8 bits, as in saved pictures. Photos with transparency are composited over
    the model's solid colour. Splats have no such colour, so both renders and photos are composited over black. Masked
    pixels are ignored.

    Args:
        model: the model or merged model to score, or splats prepared for rendering (`hyrfpack.splats.draw.Drawable`).
        views: photos to compare with, which were not used in training.
        lpips_weights: path of the LPIPS weights, see `hyrfpack.evaluate.lpips`; without it lpips is None.
        settings: render settings, including the exposure.
        pictures: folder for pictures of photo | render | error.
        picture_count: number of views with a picture, spread evenly over `views`.
        overwrite: replace files in `pictures`; if False, an existing file is an error.
        progress: called with `TaskEvent`s; each of several processes reports its own share of the views.
        unwritten: gets a message for each picture that cannot be written, while scoring continues. Without it, such a
            picture is an error.
        ranks: processes that share the views; each of them gets all scores.

    Raises:
        HyrfError: there is no view to score, a file cannot be read or written, or another call is writing into the
            folder `pictures`.
        TypeError: the model, a view or the settings have the wrong type.

    Example:
        >>> import hyrfpack
        >>> model = hyrfpack.load_model("bonsai.hyrf")
        >>> scores = hyrfpack.evaluate_model(model, hyrfpack.load_scene("photos/bonsai").test)
        >>> len(scores.views), scores.psnr > 10, scores.lpips is None
        (2, True, True)
    """
    if not isinstance(model, (Drawable, MergedModel)):
        check_type("model", model, HybridModel)
    check_type("settings", settings, RenderSettings)
    for view in views if isinstance(views, Sequence) else [views]:
        check_type("each of the views", view, View)
    if not views:
        raise HyrfError(
            "there is no view to score", fix="name a split that has photos, or hold some out with `test_every`"
        )
    perceptual = None if lpips_weights is None else LPIPS.load(lpips_weights)
    pictures_to_write = picture_names(views, picture_count)

    def score_own_views() -> list[tuple[int, ViewScore | None, float]]:
        """Return index, score (None if the mask leaves no pixel) and render seconds of each view of this rank."""
        scorer = ViewScorer(model, settings, perceptual)
        scorer.warm_up(views[0].camera)
        scores: list[tuple[int, ViewScore | None, float]] = []
        own_views = ranks.share(list(enumerate(views)))
        for position, (number, view) in enumerate(own_views):
            progress(TaskEvent(f"scoring photo {position + 1}/{len(own_views)}", position / len(own_views)))
            comparison = scorer.compare(view)
            if comparison is None:
                scores.append((number, None, 0.0))
                continue
            scores.append((number, comparison.score, comparison.seconds))
            if pictures is not None and number in pictures_to_write:
                file = Path(pictures, pictures_to_write[number])
                try:
                    save_picture(file, comparison.draw(), overwrite=overwrite, rename=False)
                except HyrfError as error:
                    if unwritten is None:
                        raise
                    unwritten.append(str(error))
        progress(TaskEvent(f"scored {format_count(len(own_views), 'photo')}", 1.0))
        return scores

    with nullcontext() if pictures is None else exclusive_folder(pictures, ranks=ranks):
        rows_of_ranks = ranks.all_gather(ranks.run_on_all(score_own_views))
        all_rows = sorted((row for rows in rows_of_ranks for row in rows), key=lambda row: row[0])
    scores = [score for _, score, _ in all_rows if score is not None]
    if not scores:
        raise HyrfError("the masks of all views leave no pixel to score", fix="check that white means 'use this pixel'")
    return Evaluation(
        psnr=statistics.fmean(score.psnr for score in scores),
        psnr_consistent=_mean(score.psnr_consistent for score in scores),
        psnr_corrected=statistics.fmean(score.psnr_corrected for score in scores),
        ssim=statistics.fmean(score.ssim for score in scores),
        lpips=_mean(score.lpips for score in scores),
        lpips_reason=NO_LPIPS_REASON if perceptual is None else f"network {perceptual.name}",
        gaussians=len(model.positions) if isinstance(model, Drawable) else len(model),
        seconds_per_frame=statistics.median(seconds for _, score, seconds in all_rows if score is not None),
        views=scores,
        skipped=[views[number].name for number, score, _ in all_rows if score is None],
    )


def _mean(values: Iterable[float | None]) -> float | None:
    """Return the mean of the values that are not None, or None if there is none."""
    present = [value for value in values if value is not None]
    return statistics.fmean(present) if present else None


def picture_names(views: Sequence[View], count: int = DEFAULT_PICTURE_COUNT) -> dict[int, str]:
    """Return the names of the pictures that `evaluate_model` writes, by the index of their view."""
    names = unique_stems([view.name for view in views])
    return {index: f"{names[index]}.png" for index in evenly_spaced(range(len(views)), count)}
