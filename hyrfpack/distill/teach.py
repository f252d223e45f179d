"""A hybrid model learns what splats look like: viewpoints, regression, pictures."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from hyrfpack.cameras.view_sampling import sample_views, shrink_camera
from hyrfpack.data import PictureCache
from hyrfpack.distill.config import DistillConfig
from hyrfpack.distill.start import initial_model
from hyrfpack.distill.teacher import Sample, light_of, teaching_scene
from hyrfpack.errors import HyrfDataError
from hyrfpack.evaluate.metrics import decibels
from hyrfpack.model import HybridModel
from hyrfpack.progress import Report, no_report, report_part
from hyrfpack.scene import Camera, Scene, evenly_spaced
from hyrfpack.splats.draw import Drawable
from hyrfpack.splats.splats import Splats
from hyrfpack.splats.viewpoints import WeightedSplats, has_enclosed_places, sample_viewpoints
from hyrfpack.train.config import LARGEST_SEED, DensityConfig, LearningRates, TrainConfig
from hyrfpack.train.trainer import Trainer

DECIDING = 3  # viewpoints to decide by, for each that is held out: means of few of them differ by a dB
TEST_EVERY = 8  # of given cameras, one in so many is held out
LIT_FROM = 64  # views at which it is measured what each Gaussian gives to pictures
UNSEEN = 0.01  # of all light, what the faintest Gaussians together may send: they are left out
REGRESSED, LEAST_REGRESSED = 250, 0.2  # steps from which on the first regression is whole, and its least share
# Warm: small steps from a model that is nearly right.
RATES = LearningRates(
    positions=(2e-6, 2e-7),
    fields=(3e-4, 3e-5),
    color_logits=(3e-3, 3e-4),
    scale_logits=(3e-3, 3e-4),
    opacity_logits=(6e-3, 6e-4),
)


@dataclass(frozen=True)
class Taught:
    """A model that has learnt what splats look like, before it is packed.

    Attributes:
        model: the model.
        train: where they were looked at from to teach it.
        deciding, test: what they look like where files are looked at from to decide how fine they need be, and where
            scores are of.
    """

    model: HybridModel
    train: list[Camera]
    deciding: Sample
    test: Sample


def teach(
    splats: Splats,
    config: DistillConfig = DistillConfig(),  # noqa: B008 - frozen
    *,
    name: str = "the splats",
    cameras: Sequence[Camera] | None = None,
    device: torch.device = torch.device("cpu"),  # noqa: B008 - a constant
    say: Callable[[str], None] = lambda sentence: None,
    report: Report = no_report,
) -> Taught:
    """Make a hybrid model that looks like splats. Arguments and errors as of `distill_splats`.

    Example:
        >>> from hyrfpack.splats.files import read_splats
        >>> quick = DistillConfig(steps=1, size=16, train_views=2, test_views=2)
        >>> len(teach(read_splats("bonsai.ply"), quick).model) > 0
        True
    """
    report("choosing viewpoints", 0.0)
    weighted = WeightedSplats.from_splats(splats, name)
    original = Drawable.from_splats(splats, weighted.frame, device)
    train, deciding, test = _cameras(weighted, original, config, cameras)
    say(
        f"{len(splats):,} Gaussians, harmonics of degree {splats.degree}; {len(train)} viewpoints "
        f"{'made up' if cameras is None else 'given'} to teach with, {len(test)} held out"
    )
    report("looking which Gaussians are seen", 0.05)
    light = light_of(original, evenly_spaced(train, LIT_FROM))
    kept = torch.from_numpy(_lit(light.cpu().numpy())).to(device)
    if not len(kept):
        raise HyrfDataError(f"{name}: no view shows anything of the Gaussians; give others with `cameras`")
    say(f"{len(splats) - len(kept):,} Gaussians are hardly seen and left out; fitting the fields to the others")
    share = min(1.0, max(LEAST_REGRESSED, config.steps / REGRESSED))
    model = initial_model(original[kept], light[kept], train, config.seed, share, report_part(report, 0.1, 0.4))
    scene, cache = teaching_scene(name, original, train, test), PictureCache()
    _fit_to_pictures(model, scene, config, cache, report_part(report, 0.4, 0.98))
    report("drawing the held-out views", 0.98)
    return Taught(model, train, *(Sample.of(original, cameras) for cameras in (deciding, test)))


def _cameras(
    weighted: WeightedSplats, drawable: Drawable, config: DistillConfig, cameras: Sequence[Camera] | None
) -> tuple[list[Camera], list[Camera], list[Camera]]:
    """To teach with, to decide by, and held out; of fewer than two given ones, the same. None decides and scores."""
    if cameras is None:
        # More pictures than steps are not looked at.
        taught = min(config.train_views, max(LIT_FROM, config.steps))
        # Seeds that no other config.seed leads to.
        seeds = 2 * config.seed, 2 * (LARGEST_SEED + 1) + config.seed, 2 * config.seed + 1
        inside = has_enclosed_places(weighted, drawable)
        train, deciding, test = (
            sample_viewpoints(weighted, drawable, count, config.size, seed, inside)
            for count, seed in zip((taught, DECIDING * config.test_views, config.test_views), seeds, strict=True)
        )
        return train, deciding, test
    fitting = [shrink_camera(camera, config.size) for camera in cameras]
    test = fitting[::TEST_EVERY]
    train = [camera for number, camera in enumerate(fitting) if number % TEST_EVERY] or test
    return train, sample_views(train, config.test_views, config.seed)[1], test


def _lit(light: np.ndarray) -> np.ndarray:
    """Indices (n,), ascending, of the Gaussians without the faintest that together send UNSEEN of the light (N,)."""
    order = np.argsort(light, kind="stable")
    sums = np.cumsum(light[order].astype(np.float64))
    return np.sort(order[(sums > UNSEEN * sums[-1]) & (light[order] > 0)]) if len(order) else order


def _fit_to_pictures(
    model: HybridModel, scene: Scene, config: DistillConfig, cache: PictureCache, report: Report
) -> None:
    # No density control: every Gaussian has its place, and packing leaves out those that pictures do not miss.
    settings = TrainConfig(
        steps=config.steps,
        seed=config.seed,
        learning_rates=RATES,
        density=DensityConfig(stop=0.0),
        precision="float32",  # what is left to learn is smaller than what a GPU rounds away otherwise
    )
    trainer = Trainer(scene, settings, cache, model.gaussians.positions.device, model)

    def stepped(trainer: Trainer, loss: float, mse: float) -> None:
        doing = f"training, step {trainer.step:,} of {config.steps:,}, PSNR {decibels(mse):.1f} dB"
        report(doing, trainer.step / config.steps)

    trainer.run(report=stepped)
