"""Distillation: a file of 3D Gaussians becomes a hybrid model, taught by the file's own pictures."""

from __future__ import annotations

import dataclasses
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch

from hyrfpack import format as hyrf_format
from hyrfpack.atomic import write_atomic
from hyrfpack.cameras.between import small_camera, views_between
from hyrfpack.cameras.paths import Viewpoint
from hyrfpack.checks import check_float, check_int, check_type
from hyrfpack.compress.calibrate import calibrated
from hyrfpack.compress.packer import Packer
from hyrfpack.data import PictureCache
from hyrfpack.distill.start import initial_model
from hyrfpack.distill.teacher import light_of, likeness, teaching_scene
from hyrfpack.distill.views import Weighted, viewpoints
from hyrfpack.errors import HyrfDataError
from hyrfpack.format.codec import decode_model
from hyrfpack.model import HybridModel
from hyrfpack.outputs import Outputs
from hyrfpack.scene import Camera, Scene, evenly_spaced
from hyrfpack.splats.draw import Drawable
from hyrfpack.splats.files import read_splats
from hyrfpack.splats.splats import Splats
from hyrfpack.train.config import LARGEST_SEED, DensityConfig, LearningRates, TrainConfig
from hyrfpack.train.progress import ProgressLine
from hyrfpack.train.trainer import Trainer

DECIDING = 3  # viewpoints to decide by, for each that is held out: means of few of them differ by a dB
TEST_EVERY = 8  # of given cameras, one in so many is held out
LIT_FROM = 64  # views at which it is measured what each Gaussian gives to pictures
UNSEEN = 0.01  # of all light, what the faintest Gaussians together may send: they are left out
REGRESSED, LEAST_REGRESSED = 250, 0.2  # steps from which on the first regression is whole, and its least share
PACKED = 0.8  # of what packing may add, to ask for
LEAST_ADDED = 0.25  # of the error before packing, that packing may add in any case
HOPELESS = 0.5  # of the error allowed, that it may add where that is passed already
TRIALS = 5  # files that are made so
# Warm: small steps from a model that is nearly right.
RATES = LearningRates(
    positions=(2e-6, 2e-7),
    fields=(3e-4, 3e-5),
    color_logits=(3e-3, 3e-4),
    scale_logits=(3e-3, 3e-4),
    opacity_logits=(6e-3, 6e-4),
)


@dataclass(frozen=True)
class DistillConfig:
    """What decides the outcome of a distillation, besides the splats.

    Attributes:
        steps: optimiser steps of fitting to the original's pictures, one each.
        psnr: dB of held-out pictures against the original's that the file is made for: higher takes more bytes.
        size: pixels of the longer side of pictures.
        train_views, test_views: how many viewpoints are made up, to teach (at most) and to score.
        seed: of viewpoints, first weights and order; 0 to LARGEST_SEED.
    """

    steps: int = 500
    psnr: float = 37.0
    size: int = 400
    train_views: int = 240
    test_views: int = 16
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("steps", "size", "train_views", "test_views"):
            check_int(name, getattr(self, name), 1)
        check_float("psnr", self.psnr, 10, 60)
        check_int("seed", self.seed, 0, LARGEST_SEED)


@dataclass(frozen=True)
class DistillReport:
    """What a distillation came to.

    Attributes:
        gaussians_before, gaussians_after: of the original and of the file.
        degree: of the original's spherical harmonics.
        views: held-out viewpoints that the scores are of.
        psnr: dB, mean over these views, of the decoded file's pictures against the original's, over black.
        psnr_worst: of the view with the least.
        psnr_unpacked: mean, of the model before it was packed.
        psnr_asked: of `DistillConfig`.
        bytes_source: of the original as it was given; None when it was no file.
        bytes_ply: of the original as PLY in INRIA's layout, without the header: 4 (17 + 3 (K - 1)) for each Gaussian.
        bytes_after: of the `.hyrf` file.
        seconds: that it took.
    """

    gaussians_before: int
    gaussians_after: int
    degree: int
    views: int
    psnr: float
    psnr_worst: float
    psnr_unpacked: float
    psnr_asked: float
    bytes_source: int | None
    bytes_ply: int
    bytes_after: int
    seconds: float

    def to_dict(self) -> dict:
        """Plain numbers, ready for JSON."""
        return asdict(self)


def distill(
    source: str | os.PathLike[str],
    target: str | os.PathLike[str],
    config: DistillConfig = DistillConfig(),
    *,
    cameras: Sequence[Camera] | None = None,
    say: Callable[[str], None] = lambda sentence: None,
    quiet: bool = True,
) -> DistillReport:
    """Make a `.hyrf` file from a file of 3D Gaussians; see `distill_splats`, and `read_splats` for what is read.

    Raises:
        HyrfDataError: the source cannot be read, or there is nothing to be seen in it.
        HyrfError: the target cannot be written.
        TypeError: the settings or a camera are something else.

    Example:
        >>> import hyrfpack
        >>> quick = hyrfpack.DistillConfig(steps=4, psnr=15, size=32, train_views=6, test_views=2)
        >>> report = hyrfpack.distill("bonsai.ply", "again.hyrf", quick)
        >>> report.bytes_after < report.bytes_source
        True
    """
    check_type("config", config, DistillConfig)
    for camera in cameras or ():
        check_type("each of the cameras", camera, Camera)
    Outputs(source, overwrite=True).file(target)
    splats = read_splats(source)
    report = distill_splats(splats, target, config, name=str(source), cameras=cameras, say=say, quiet=quiet)
    return dataclasses.replace(report, bytes_source=_bytes_at(Path(source)))


def distill_splats(
    splats: Splats,
    target: str | os.PathLike[str],
    config: DistillConfig = DistillConfig(),
    *,
    name: str = "the splats",
    cameras: Sequence[Camera] | None = None,
    say: Callable[[str], None] = lambda sentence: None,
    quiet: bool = True,
) -> DistillReport:
    """Turn splats into a hybrid model that looks like them, and pack it (profile compact).

    Without cameras viewpoints are made up (`viewpoints`). The faintest Gaussians, as seen from there, are left out;
    the fields are fitted to the others' shapes and colours (`initial_model`), the whole is fitted to pictures of the
    original. Same splats and settings, same bytes.

    Args:
        splats: in any units, anywhere.
        target: the `.hyrf` file.
        name: what messages call the splats.
        cameras: that pictures shall hold at, made smaller where larger than `config.size`; one in TEST_EVERY is held
            out.
        say: told what is going on.
        quiet: show no progress line.

    Raises:
        HyrfDataError: no view shows any of the splats.
        HyrfError: the file cannot be written.
    """
    started = time.perf_counter()
    Outputs(overwrite=True).file(target)
    weighted = Weighted.of(splats, name)
    original = Drawable.of(splats, weighted.frame)
    train, deciding, test = _cameras(weighted, original, config, cameras)
    say(
        f"{len(splats):,} Gaussians, harmonics of degree {splats.degree}; {len(train)} viewpoints "
        f"{'made up' if cameras is None else 'given'} to teach with, {len(test)} held out"
    )

    light = light_of(original, evenly_spaced(train, LIT_FROM)).numpy()
    kept = _lit(light)
    if not len(kept):
        raise HyrfDataError(f"{name}: no view shows anything of the Gaussians; give others with --cameras")
    say(f"{len(splats) - len(kept):,} Gaussians are hardly seen and left out; fitting the fields to the others")
    share = min(1.0, max(LEAST_REGRESSED, config.steps / REGRESSED))
    lit = Drawable.of(splats[kept], weighted.frame), torch.from_numpy(light[kept])
    model = initial_model(*lit, train, config.seed, share)
    scene, cache = teaching_scene(name, original, train, test), PictureCache()
    _fit_to_pictures(model, scene, config, cache, quiet)

    unpacked = _mean(likeness(model, original, test))
    say(f"{unpacked:.2f} dB before packing")
    imported = f"{len(splats):,} Gaussians of degree {splats.degree} from {Path(name).name}, without photos"
    provenance = {"steps": config.steps, "seed": config.seed, "psnr": unpacked, "choices": {"imported": imported}}
    provenance["viewpoint"] = Viewpoint.of(train).to_json()
    _pack(model, target, train, deciding, original, provenance, config, say)
    decoded = hyrf_format.load(target)
    scores = likeness(decoded, original, test)
    if _below(_mean(scores), config.psnr):
        say(_shortfall(_mean(scores), unpacked, config, made_up=cameras is None))
    return DistillReport(
        gaussians_before=len(splats),
        gaussians_after=len(decoded),
        degree=splats.degree,
        views=len(test),
        psnr=_mean(scores),
        psnr_worst=min(scores),
        psnr_unpacked=unpacked,
        psnr_asked=config.psnr,
        bytes_source=None,
        bytes_ply=4 * len(splats) * (17 + 3 * (splats.harmonics.shape[1] - 1)),
        bytes_after=Path(target).stat().st_size,
        seconds=time.perf_counter() - started,
    )


def _cameras(
    weighted: Weighted, drawable: Drawable, config: DistillConfig, cameras: Sequence[Camera] | None
) -> tuple[list[Camera], list[Camera], list[Camera]]:
    """To teach with, to decide by, and held out; of fewer than two given ones, the same. None decides and scores."""
    if cameras is None:
        # More pictures than steps are not looked at.
        taught = min(config.train_views, max(LIT_FROM, config.steps))
        # Seeds that no other config.seed leads to.
        seeds = 2 * config.seed, 2 * (LARGEST_SEED + 1) + config.seed, 2 * config.seed + 1
        train, deciding, test = (
            viewpoints(weighted, drawable, count, config.size, seed)
            for count, seed in zip((taught, DECIDING * config.test_views, config.test_views), seeds, strict=True)
        )
        return train, deciding, test
    fitting = [small_camera(camera, config.size) for camera in cameras]
    test = fitting[::TEST_EVERY]
    train = [camera for number, camera in enumerate(fitting) if number % TEST_EVERY] or test
    return train, views_between(evenly_spaced(train, config.test_views), config.seed), test


def _lit(light: np.ndarray) -> np.ndarray:
    """Indices (n,), ascending, of the Gaussians without the faintest that together send UNSEEN of the light (N,)."""
    order = np.argsort(light, kind="stable")
    sums = np.cumsum(light[order].astype(np.float64))
    return np.sort(order[(sums > UNSEEN * sums[-1]) & (light[order] > 0)]) if len(order) else order


def _fit_to_pictures(model: HybridModel, scene: Scene, config: DistillConfig, cache: PictureCache, quiet: bool) -> None:
    # No density control: every Gaussian has its place, and packing leaves out those that pictures do not miss.
    settings = TrainConfig(steps=config.steps, seed=config.seed, learning_rates=RATES, density=DensityConfig(stop=0.0))
    trainer = Trainer(scene, settings, cache, model=model)
    with ProgressLine(config.steps, 0, quiet) as line:
        trainer.run(report=lambda t, loss, mse: line.update(t.step, loss, mse, len(t.model)))


def _pack(
    model: HybridModel,
    target: str | os.PathLike[str],
    cameras: Sequence[Camera],
    views: Sequence[Camera],
    original: Drawable,
    provenance: dict,
    config: DistillConfig,
    say: Callable[[str], None],
) -> None:
    """Write a model as small as the quality asked for allows, as `views` tell that it has not learnt from."""
    allowed, error = _mse(config.psnr), _mse(_mean(likeness(model, original, views)))
    room = max(allowed - error, min(LEAST_ADDED * error, HOPELESS * allowed))
    say(f"measuring what each number does to pictures, at {len(cameras)} cameras and between them")
    wanted = PACKED * room
    sensitivity, originals = calibrated(model, cameras, wanted)
    packer = Packer(model, provenance, sensitivity, scene=None, finetune_steps=0, prune=True, say=say)
    trial = packer.settled(wanted, originals)
    for _ in range(TRIALS):
        off = _mse(_mean(likeness(decode_model(trial.data), original, views))) - error
        if off <= room:
            break
        wanted *= max(PACKED * room / off, 1 / 16)
        say(f"packing adds {off:.2g} to the error instead of {room:.2g}: finer, for {wanted:.2g}")
        trial = packer.attempt(wanted)
    write_atomic(target, trial.data)  # only now: an interrupt leaves what was there before


def _below(reached: float, asked: float) -> bool:
    """Whether a PSNR is less than was asked for, as it is told."""
    return round(reached, 1) < asked


def _shortfall(reached: float, unpacked: float, config: DistillConfig, *, made_up: bool) -> str:
    """What to do about a file that is less like the original than was asked for."""
    told = (
        f"asked for {config.psnr:g} dB and reached {reached:.1f} at held-out viewpoints, {unpacked:.1f} before packing"
    )
    if not _below(unpacked, config.psnr):
        return f"{told}: ask for more than you need with --psnr"
    where = ", or name with --cameras from where it will be looked at" if made_up else ""
    return f"{told}: learn longer, as with --steps {max(DistillConfig.steps, 2 * config.steps)}{where}"


def _mse(psnr: float) -> float:
    return 10 ** (-psnr / 10)


def _bytes_at(path: Path) -> int:
    """Of a file, or of all files in a folder (that of a loose SOG's meta.json, too)."""
    folder = path.parent if path.name == "meta.json" else path
    if folder.is_dir():
        return sum(file.stat().st_size for file in folder.iterdir() if file.is_file())
    return path.stat().st_size


def _mean(values: Sequence[float]) -> float:
    return float(np.mean(values))
