"""Make a model of splats: choose viewpoints, leave out what no view shows, and render references."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from hyrfpack.cameras.view_sampling import sample_views, shrink_camera
from hyrfpack.config.imports import ImportConfig
from hyrfpack.config.settings import LARGEST_SEED
from hyrfpack.counts import format_count
from hyrfpack.errors import HyrfDataError
from hyrfpack.imports.exact_model import exact_model
from hyrfpack.imports.reference import ReferenceViews, mean_sent_light
from hyrfpack.model import HybridModel
from hyrfpack.progress import Progress, TaskEvent, ignore_progress
from hyrfpack.scene import Camera, evenly_spaced
from hyrfpack.splats.draw import Drawable
from hyrfpack.splats.splats import Splats, clamp_harmonics
from hyrfpack.splats.viewpoints import WeightedSplats, has_enclosed_places, sample_viewpoints

_LOG = logging.getLogger(__name__)

# Compression is decided on more views than sampled ones are scored on, because the mean PSNR of few views is off by up
# to 1 dB.
VALIDATION_VIEWS_PER_TEST_VIEW = 3
TEST_EVERY = 8
LIGHT_MEASUREMENT_VIEWS = 64
# The faintest Gaussians that together send less than this share of all light are left out. Compression prunes others
# as the target PSNR allows.
FAINT_LIGHT_SHARE = 1e-4
MIN_SHOWN_GAUSSIANS_SHARE = 0.01  # Given cameras that show fewer of the Gaussians belong to another scene.


@dataclass(frozen=True)
class PreparedModel:
    """A model of splats, before compression, with reference renders of the splats.

    Attributes:
        model: the model.
        cameras: viewpoints at which compression measures how numbers affect renders.
        validation: reference renders on which the compression is decided.
        test: held-out reference renders, for scores.
    """

    model: HybridModel
    cameras: list[Camera]
    validation: ReferenceViews
    test: ReferenceViews


def prepare_model(
    splats: Splats,
    config: ImportConfig = ImportConfig(),  # noqa: B008 - frozen
    *,
    name: str = "the splats",
    cameras: Sequence[Camera] | None = None,
    device: torch.device = torch.device("cpu"),  # noqa: B008 - a constant
    progress: Progress = ignore_progress,
) -> PreparedModel:
    """Make a model of splats, and reference renders. Arguments and errors are those of `import_loaded_splats`.

    Example:
        >>> from hyrfpack.splats.files import read_splats
        >>> quick = ImportConfig(size=16, views=2, test_views=2)
        >>> len(prepare_model(read_splats("bonsai.ply"), quick).model) > 0
        True
    """
    progress(TaskEvent("choosing viewpoints", 0.0))
    splats = clamp_harmonics(splats, name)
    weighted = WeightedSplats.from_splats(splats, name)
    original = Drawable.from_splats(splats, weighted.frame, device, name)
    chosen, validation, test = _choose_cameras(weighted, original, config, cameras)
    how = "sampled" if cameras is None else "given"
    _LOG.info(
        f"{format_count(len(splats), 'Gaussian')}, harmonics of degree {splats.degree}; "
        f"{format_count(len(chosen), f'{how} viewpoint')}, {len(test)} held out"
    )
    progress(TaskEvent("measuring which Gaussians are visible", 0.2))
    light = mean_sent_light(original, evenly_spaced(chosen, LIGHT_MEASUREMENT_VIEWS))
    kept = torch.from_numpy(_indices_without_faint(light.cpu().numpy())).to(device)
    if not len(kept):
        raise HyrfDataError(f"{name}: no view shows anything of the Gaussians", fix="give others with `cameras`")
    if cameras is not None and len(kept) < MIN_SHOWN_GAUSSIANS_SHARE * len(splats):
        raise HyrfDataError(
            f"{name}: the given viewpoints show only {len(kept):,} of {format_count(len(splats), 'Gaussian')}, as if "
            "they belonged to another scene",
            fix="give those of the original's training photos with `cameras`, or give none",
        )
    left_out = len(splats) - len(kept)
    _LOG.info(f"{format_count(left_out, 'Gaussian is', 'Gaussians are')} hardly visible and not kept")
    model = exact_model(original[kept])
    progress(TaskEvent("rendering held-out views", 0.6))
    validation_views, test_views = (ReferenceViews.from_splats(original, views) for views in (validation, test))
    return PreparedModel(model, chosen, validation_views, test_views)


def _choose_cameras(
    weighted: WeightedSplats, drawable: Drawable, config: ImportConfig, cameras: Sequence[Camera] | None
) -> tuple[list[Camera], list[Camera], list[Camera]]:
    """Return the cameras to measure at, those of validation and those of tests; the last two have none in common.

    A single given camera is used for both measuring and testing.
    """
    if cameras is None:
        # The three seeds differ from each other and from those of any other config.seed.
        seeds = 2 * config.seed, 2 * (LARGEST_SEED + 1) + config.seed, 2 * config.seed + 1
        inside = has_enclosed_places(weighted, drawable)
        measured, validation, test = (
            sample_viewpoints(weighted, drawable, count, config.size, seed, inside)
            for count, seed in zip(
                (config.views, VALIDATION_VIEWS_PER_TEST_VIEW * config.test_views, config.test_views),
                seeds,
                strict=True,
            )
        )
        return measured, validation, test
    shrunk = [shrink_camera(camera, config.size) for camera in cameras]
    test = shrunk[::TEST_EVERY]
    measured = [camera for number, camera in enumerate(shrunk) if number % TEST_EVERY] or test
    validation = sample_views(measured, VALIDATION_VIEWS_PER_TEST_VIEW * config.test_views, config.seed)[1]
    return measured, validation, test


def _indices_without_faint(light: np.ndarray) -> np.ndarray:
    """Return ascending indices (n,) of all Gaussians but the faintest, given the light (N,) that each sends.

    The faintest are those that together send FAINT_LIGHT_SHARE of all light, or none.
    """
    order = np.argsort(light, kind="stable")
    sums = np.cumsum(light[order].astype(np.float64))
    return np.sort(order[(sums > FAINT_LIGHT_SHARE * sums[-1]) & (light[order] > 0)]) if len(order) else order
