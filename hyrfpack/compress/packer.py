"""Compressing a file: measure, plan, perhaps search and fine-tune, write."""

from __future__ import annotations

import dataclasses
import os
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property, partial
from itertools import count
from typing import Any, cast

import torch

from hyrfpack.cameras.capture import Capture, has_mean_exposure, quantized_provenance
from hyrfpack.checks import check_type
from hyrfpack.compress.calibrate import Originals, calibrated, foretold
from hyrfpack.compress.distortion import LIMITS, PSNR_DROP, default_distortion
from hyrfpack.compress.finetune import finetune, gains_of_photos
from hyrfpack.compress.plan import make_plan
from hyrfpack.compress.quantize import quantize
from hyrfpack.compress.search import coarsest, fullest
from hyrfpack.compress.sensitivity import Sensitivity
from hyrfpack.data import PictureCache
from hyrfpack.device import choose_own_device
from hyrfpack.errors import HyrfError, HyrfSizeError
from hyrfpack.evaluate import evaluate
from hyrfpack.format.codec import (
    DEFAULT_PROFILE,
    CompressionReport,
    decode_model,
    encode_model,
    load_with_provenance,
    repack,
    write_model,
)
from hyrfpack.format.info import describe
from hyrfpack.format.min_file_size import check_target_bytes
from hyrfpack.format.run_folder import find_model
from hyrfpack.model import HybridModel
from hyrfpack.outputs import Outputs
from hyrfpack.parallel.ranks import SINGLE_PROCESS, Ranks
from hyrfpack.progress import Report, no_report, report_part, report_round
from hyrfpack.scene import Scene, evenly_spaced

TOLERATED_DROP, DROP_VIEWS = 1.5, 8  # factor from the dB aimed at, and training photos that these are measured on
TOLERATED, MENDED = 1.2, 3  # factor from the distortion asked for, and how often another file is made beyond it
COARSER, FINER = 2.0, 16.0  # factors at most that another file differs by
TRIALS, FINETUNED_TRIALS = 9, 4  # of a search
# Shares of the whole work at which sensitivities are measured and the first file is made: alone, and of many.
ENCODING_STARTS, SEARCH_STARTS = 0.7, 0.3


@dataclass(frozen=True)
class Trial:
    """A file that was made.

    Attributes:
        data: its bytes.
        errors: what it adds to the pictures' mean squared error by section and by what is pruned, foretold.
        error: what it adds to it, where pictures were compared.
        lost: dB of PSNR, where that was measured.
    """

    data: bytes
    errors: dict[str, float]
    error: float = 0.0
    lost: float = 0.0


def compress(
    source: str | os.PathLike[str],
    target: str | os.PathLike[str],
    profile: str = DEFAULT_PROFILE,
    *,
    data: Scene | None = None,
    finetune_steps: int = 0,
    prune: bool = True,
    target_bytes: int | None = None,
    max_psnr_drop: float | None = None,
    distortion: float | None = None,
    overwrite: bool = True,
    device: str | torch.device = "auto",
    say: Callable[[str], None] = lambda sentence: None,
    report: Report = no_report,
    ranks: Ranks = SINGLE_PROCESS,
    **settings: Any,
) -> CompressionReport:
    """Pack a `.hyrf` file into a smaller one.

    Profile "compact" measures what each number does to pictures, at the cameras of `data` or those that the file
    keeps, and spends bits where they show. By itself it aims at a loss of `hyrfpack.compress.distortion.PSNR_DROP`;
    the rest is for when that is not what is wanted. "paper" and "raw" do what they always do, and take none of it.

    Args:
        source: a file of any profile, best "raw", or the folder of a run.
        target: the file to write.
        profile: "compact", "paper" or "raw".
        data: photos of the scene.
        finetune_steps: steps of fitting the quantised model to the photos of `data`; buys smaller files with time.
        prune: leave out Gaussians that cost more in bytes than they give to pictures.
        target_bytes: make the file as good as can be within so many bytes.
        max_psnr_drop: make the file as small as can be for so many dB of mean PSNR on the held-out photos of `data`.
        distortion: mean squared error that pictures may get, by estimate; instead of a search.
        overwrite: replace a file at `target`. Without it, one that is there is an error, and one that appears in the
            meantime is kept: the result gets a free name beside it, which the report names.
        device: where pictures are drawn, see `hyrfpack.device.choose_device`. On the CPU the same input gives the same
            bytes; on a GPU sums of gradients vary in their last bits, and bytes with them.
        say: told what is going on.
        report: called with what is being done and the share of the work that is done, 0 to 1.
        ranks: processes that share the photos of fine-tuning; rank 0 writes the file.
        settings: of "paper", see `hyrfpack.format.paper`; `noise` is the old word for `distortion`.

    Raises:
        HyrfError: a file cannot be read or written, the target is what is read, the options do not go together, or
            what is asked for cannot be had.
        TypeError: `data` is no Scene.

    Example:
        >>> import hyrfpack
        >>> report = hyrfpack.compress("runs/bonsai", "small.hyrf")
        >>> report.profile, report.bytes_after < report.bytes_before
        ('compact', True)
    """
    if "noise" in settings:
        warnings.warn("compress(noise=...) is now compress(distortion=...)", DeprecationWarning, stacklevel=2)
        distortion = settings.pop("noise")
    if data is not None:
        check_type("data", data, Scene)
    source = find_model(source)
    # The main process alone looks, and the others wait for it: what it has written is no reason to refuse.
    outputs = Outputs(source, scene=data, overwrite=overwrite)
    ranks.run_on_all(lambda: outputs.file(target) if ranks.is_main else None)
    if profile != "compact":
        if data is not None or finetune_steps or target_bytes or max_psnr_drop is not None or distortion:
            raise HyrfError(f"profile '{profile}' has no settings to fit to photos, sizes or losses; use 'compact'")
        repacked = ranks.run_on_all(
            lambda: repack(source, target, profile, overwrite=overwrite, **settings) if ranks.is_main else None
        )
        return cast(CompressionReport, ranks.broadcast(repacked))
    if settings:
        raise HyrfError(f"profile 'compact' has no setting '{next(iter(settings))}'")
    if data is None and (finetune_steps or max_psnr_drop is not None):
        raise HyrfError("fine-tuning and limits on PSNR need photos; name their folder with `data`")
    if sum(option is not None for option in (target_bytes, max_psnr_drop, distortion)) > 1:
        raise HyrfError("a target size and a largest loss of PSNR each decide how fine the file is; give one of them")
    if data is not None and not data.train:
        raise HyrfError(
            f"{data.path}: all photos are held out, so there is none to measure at; use a larger `test_every`"
        )
    model, provenance = load_with_provenance(source)
    kept = quantized_provenance(provenance, model.config.frame.scale)
    if target_bytes is not None:
        check_target_bytes(target_bytes, kept, model.exposure)
    model = model.to(choose_own_device(device, ranks, say))
    model.precision = "float32"  # what is looked for is smaller than what a GPU rounds away otherwise
    if len(model) == 0:
        raise HyrfError(f"{source}: there is no Gaussian in it, so there is nothing to measure; use profile 'paper'")
    cameras = Capture(describe(source), data).cameras
    say(f"measuring what each number does to pictures, at {len(cameras)} cameras and between them")
    start = distortion or default_distortion(provenance, finetune_steps)
    encoding_starts = SEARCH_STARTS if finetune_steps or target_bytes or max_psnr_drop is not None else ENCODING_STARTS
    measuring = report_part(report, 0.0, encoding_starts)
    sensitivity, originals = calibrated(model, cameras, start, prune, measuring)
    sensitivity = ranks.broadcast(sensitivity)  # on GPUs those of others differ in their last bits
    encoding = report_part(report, encoding_starts, 1.0)
    packer = Packer(model, kept, sensitivity, data, finetune_steps, prune, say, encoding, ranks=ranks)
    if target_bytes is not None:
        trial, found = packer.within_bytes(target_bytes, start)
    elif max_psnr_drop is not None:
        trial, found = packer.within_drop(max_psnr_drop, start)
    else:
        aim = PSNR_DROP if distortion is None else None
        trial = packer.attempt(start, encoding) if finetune_steps else packer.settled(start, originals, aim)
        found = ""
    written = ranks.run_on_all(lambda: write_model(trial.data, target, overwrite=overwrite) if ranks.is_main else None)
    result = cast(CompressionReport, ranks.broadcast(written))
    total = sum(trial.errors.values())
    shares = {part: error / (total or 1.0) for part, error in trial.errors.items()}
    return dataclasses.replace(
        result,
        shares=shares,
        error=trial.error or total,
        found=found,
        finetuned=finetune_steps > 0,
        sensitivity=sensitivity,
    )


@dataclass
class Packer:
    """Makes files of one model, finer and coarser; what its numbers do to pictures is measured once, before.

    Attributes:
        model: the model.
        provenance: that the files tell.
        sensitivity: of the model, see `calibrated`.
        scene: photos to fine-tune on; None where there are none.
        finetune_steps: of each file.
        prune: leave out Gaussians that cost more in bytes than they give to pictures.
        say: told what is going on.
        report: told what is being done, and the share of all files' making that is done.
        cache: of the photos.
        ranks: processes that fine-tune together.
    """

    model: HybridModel
    provenance: dict
    sensitivity: Sensitivity
    scene: Scene | None
    finetune_steps: int
    prune: bool
    say: Callable[[str], None]
    report: Report = no_report
    cache: PictureCache = field(default_factory=PictureCache)
    ranks: Ranks = SINGLE_PROCESS

    def attempt(self, distortion: float, report: Report = no_report) -> Trial:
        """A file that adds about so large a mean squared error to pictures."""
        report("planning quantisation", 0.0)
        model, steps = self.model, self.finetune_steps
        plan = make_plan(model, self.sensitivity, distortion, self.prune)
        if steps:
            assert self.scene is not None
            self.say(f"fine-tuning for {steps:,} steps")

            own_steps = -(-steps // self.ranks.size)

            def stepped(step: int, loss: float) -> None:
                report(f"fine-tuning, step {step:,} of {own_steps:,}", 0.9 * step / own_steps)

            fit = partial(finetune, gains=self._gains, cache=self.cache, report=stepped, ranks=self.ranks)
            planned, plan = fit(model, plan, self.sensitivity, self.scene.train, steps)
        else:
            planned = plan.apply(model)
        report("quantising", 0.9 if steps else 0.1)
        quantized = quantize(planned, plan, self.sensitivity, reach=0 if steps else 1)
        report("coding", 0.95 if steps else 0.6)
        data = encode_model(planned, "compact", self.provenance, quantized=quantized)
        return Trial(data, foretold(self.model, planned, quantized, self.sensitivity))

    def settled(self, wanted: float, originals: Originals, aim: float | None = None) -> Trial:
        """A file whose pictures are off by about as much as is `wanted`, and cost about `aim` dB on training photos.

        What packing adds to the error of photos is taken to be `wanted`, which it is where the two errors have nothing
        to do with each other. Those of a model that has hardly been trained have: packing shifts the colours of whole
        pictures, whose exposure the model does not hit, either. Where there are photos the loss is measured on some,
        and a file that costs more than TOLERATED_DROP times `aim` is made finer.
        """
        if self.scene is None or aim is None:
            return self._settled(wanted, originals, self.report)[0]
        trial, distortion = self._settled(wanted, originals, report_part(self.report, 0.0, 0.3))
        views = evenly_spaced(self.scene.train, DROP_VIEWS)
        try:
            before = evaluate(self.model, views, report=report_part(self.report, 0.3, 0.6)).psnr
            for number in range(MENDED):
                report = report_round(report_part(self.report, 0.6, 1.0), number)
                lost = before - evaluate(self.decoded(trial), views, report=report).psnr
                if lost <= TOLERATED_DROP * aim:
                    break
                distortion *= max(aim / lost, 1 / FINER)
                self.say(f"training photos lose {lost:.2f} instead of {aim:g} dB: finer, for {distortion:.2g}")
                trial = self.attempt(distortion)
                trial = dataclasses.replace(trial, error=originals.error(self.decoded(trial)))
        except HyrfError as error:  # a photo that cannot be read, or masks that leave nothing
            self.say(f"{error}; the loss on training photos is not measured")
        return trial

    def _settled(self, wanted: float, originals: Originals, report: Report) -> tuple[Trial, float]:
        """A file whose pictures are off by about as much as is `wanted`, and the distortion that it was made for.

        Its parts were calibrated one by one; together they may do a little more or less.
        """

        def attempt(distortion: float, number: int) -> Trial:
            trying = report_round(report, number)
            trial = self.attempt(distortion, report_part(trying, 0.0, 0.5))
            trying("comparing pictures of the file with the model's", 0.5)
            return dataclasses.replace(trial, error=originals.error(self.decoded(trial)))

        trial, distortion = attempt(wanted, 0), wanted
        for number in range(MENDED):
            off = trial.error / wanted
            if off == 0 or 1 / TOLERATED < off < TOLERATED:
                break
            distortion /= min(max(off, 1 / COARSER), FINER)
            kind = "finer" if off > 1 else "coarser"
            self.say(f"pictures are off by {trial.error:.2g} instead of {wanted:.2g}: {kind}, for {distortion:.2g}")
            other = attempt(distortion, number + 1)
            if off > 1:
                trial = other
                continue
            # Once: what no view sees has a limit, too.
            return (other, distortion) if other.error < TOLERATED * wanted else (trial, wanted)
        return trial, distortion

    def within_bytes(self, limit: int, start: float) -> tuple[Trial, str]:
        rounds = count()

        def attempt(distortion: float) -> Trial:
            trial = self.attempt(distortion, report_round(self.report, next(rounds)))
            self.say(f"distortion {distortion:.2g}: {len(trial.data):,} bytes")
            return trial

        answer = fullest(attempt, lambda trial: len(trial.data), limit, start, self._trials(), LIMITS)
        if answer is None:
            smallest = len(self.attempt(LIMITS[1]).data)
            raise HyrfSizeError(
                f"the model does not fit into {limit:,} bytes, the least is about {smallest:,}; "
                "ask for more, or train with fewer Gaussians (`max_gaussians`)",
                smallest,
            )
        distortion, trial = answer
        return trial, f"distortion {distortion:.2g} gives {len(trial.data):,} of {limit:,} bytes"

    def within_drop(self, limit: float, start: float) -> tuple[Trial, str]:
        assert self.scene is not None
        views = self.scene.test or self.scene.train
        self.report("scoring the model", 0.0)
        before = evaluate(self.model, views).psnr
        rounds = count()

        def attempt(distortion: float) -> Trial:
            report = report_round(self.report, next(rounds))
            trial = self.attempt(distortion, report_part(report, 0.0, 0.7))
            report("scoring the file", 0.7)
            lost = before - evaluate(self.decoded(trial), views).psnr
            trial = dataclasses.replace(trial, lost=lost)
            self.say(f"distortion {distortion:.2g}: {len(trial.data):,} bytes, {lost:+.3f} dB lost")
            return trial

        answer = coarsest(attempt, lambda trial: trial.lost <= limit, start, self._trials(), LIMITS)
        if answer is None:
            raise HyrfError(
                f"even the finest file loses more than {limit:g} dB of PSNR; allow more, or use profile 'raw'"
            )
        distortion, trial = answer
        return trial, f"distortion {distortion:.2g} loses {trial.lost:+.3f} of {limit:g} dB on {len(views)} photos"

    @cached_property
    def _gains(self) -> dict[str, torch.Tensor] | None:
        """Residual gains of the photos to fine-tune on; None where no per-image gains were learnt with the model."""
        assert self.scene is not None
        if self.model.exposure is None and not has_mean_exposure(self.provenance):
            return None
        return gains_of_photos(self.model, self.scene.train, self.cache)

    def decoded(self, trial: Trial) -> HybridModel:
        """What a file holds, where the model is and as precise."""
        model = decode_model(trial.data).to(self.model.gaussians.positions.device)
        model.precision = self.model.precision
        return model

    def _trials(self) -> int:
        return FINETUNED_TRIALS if self.finetune_steps else TRIALS
