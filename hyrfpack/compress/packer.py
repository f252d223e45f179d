"""Compress a file: measure sensitivities, plan, fine-tune or search if requested, and write."""

from __future__ import annotations

import dataclasses
import logging
import os
import warnings
from dataclasses import dataclass, field
from functools import cached_property, partial
from itertools import count
from typing import Any, cast

import torch

from hyrfpack.cameras.capture import Capture, has_mean_exposure, quantized_provenance
from hyrfpack.checks import check_type
from hyrfpack.compress.calibrate import measure_calibrated_sensitivity
from hyrfpack.compress.distortion import DEFAULT_PSNR_DROP_DB, DISTORTION_RANGE, default_distortion
from hyrfpack.compress.finetune import finetune, fit_residual_gains
from hyrfpack.compress.part_errors import predict_errors
from hyrfpack.compress.plan import make_plan
from hyrfpack.compress.quantize import quantize
from hyrfpack.compress.reference_renders import ReferenceRenders
from hyrfpack.compress.report import CompressionReport
from hyrfpack.compress.search import find_coarsest, find_fullest
from hyrfpack.compress.sensitivity import Sensitivity
from hyrfpack.data import PictureCache
from hyrfpack.device import choose_own_device
from hyrfpack.errors import HyrfError, HyrfSizeError
from hyrfpack.evaluate import evaluate_model
from hyrfpack.format.codec import (
    DEFAULT_PROFILE,
    decode_model,
    encode_model,
    load_with_provenance,
    repack,
    write_model,
)
from hyrfpack.format.info import FileReport, describe_file
from hyrfpack.format.min_file_size import check_target_bytes
from hyrfpack.format.run_folder import find_model
from hyrfpack.model import HybridModel
from hyrfpack.outputs import Outputs
from hyrfpack.parallel.ranks import SINGLE_PROCESS, Ranks
from hyrfpack.progress import Report, no_report, report_part, report_round
from hyrfpack.scene import Scene, evenly_spaced

_LOG = logging.getLogger(__name__)

# A file is encoded again, with a smaller distortion, if its PSNR drop on training photos is more than this multiple of
# the intended one.
PSNR_DROP_TOLERANCE_RATIO = 1.5
PSNR_DROP_VIEWS = 8
# A file is encoded again if the measured error differs by more than this ratio from the intended one.
DISTORTION_TOLERANCE_RATIO = 1.2
MAX_CORRECTIONS = 3
# The distortion changes at most by these ratios from one file to the next.
MAX_COARSENING_RATIO = 2.0
MAX_REFINING_RATIO = 16.0
# Fine-tuning takes long, so a search over fine-tuned files makes fewer trials.
SEARCH_TRIALS = 9
FINETUNED_SEARCH_TRIALS = 4
# Share of the progress at which sensitivities are measured and encoding starts, for a single file and for a search.
ENCODING_START_SHARE = 0.7
SEARCH_ENCODING_START_SHARE = 0.3


@dataclass(frozen=True)
class EncodedCandidate:
    """An encoded file of the model, and the errors of its pictures.

    Attributes:
        data: the bytes of the file.
        predicted_errors: predicted mean squared error that compression adds to pictures, by section and for PRUNED.
        measured_error: mean squared error measured on renders; 0 if it was not measured.
        psnr_drop: measured loss of PSNR in dB; 0 if it was not measured.
    """

    data: bytes
    predicted_errors: dict[str, float]
    measured_error: float = 0.0
    psnr_drop: float = 0.0


def compress_model(
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
    report: Report = no_report,
    ranks: Ranks = SINGLE_PROCESS,
    **settings: Any,
) -> CompressionReport:
    """Compress a `.hyrf` file into a smaller one.

    Profile "compact" measures how much each number of the model affects pictures and spends bits accordingly. It
    measures at the cameras of `data`, or at those stored in the file. By default it aims at a loss of
    `hyrfpack.compress.distortion.DEFAULT_PSNR_DROP_DB`. Profiles "paper" and "raw" have fixed recipes and accept none
    of `data`, `finetune_steps`, `target_bytes`, `max_psnr_drop` and `distortion`.

    Args:
        source: a file of any profile, best "raw", or the folder of a run.
        target: the file to write.
        profile: "compact", "paper" or "raw".
        data: photos of the scene.
        finetune_steps: steps of fitting the quantised model to the photos of `data`; more steps give smaller files.
        prune: leave out Gaussians whose removal saves more rate than it costs in distortion.
        target_bytes: write the best file of at most this many bytes.
        max_psnr_drop: write the smallest file that loses at most this many dB of mean PSNR on the held-out photos of
            `data`.
        distortion: estimated mean squared error that compression may add to pictures; replaces a search.
        overwrite: replace a file at `target`. If False, an existing file is an error. A file that appears in the
            meantime is kept, and the result is written beside it under a free name, which the report names.
        device: device that renders, see `hyrfpack.device.choose_device`. On the CPU the same input gives the same
            bytes. On a GPU sums of gradients vary in their last bits, and so may the bytes.
        report: called with the name of the current task and the completed share of the work, 0 to 1.
        ranks: processes that share the photos of fine-tuning; rank 0 writes the file.
        settings: settings of "paper", see `hyrfpack.format.paper`; `noise` is the deprecated name of `distortion`.

    Raises:
        HyrfError: a file cannot be read or written, the target would replace an input, the options exclude each
            other, or no file meets the limits.
        TypeError: `data` is not a Scene.

    Example:
        >>> import hyrfpack
        >>> report = hyrfpack.compress_model("runs/bonsai", "small.hyrf")
        >>> report.profile, report.bytes_after < report.bytes_before
        ('compact', True)
    """
    if "noise" in settings:
        warnings.warn("compress(noise=...) is now compress(distortion=...)", DeprecationWarning, stacklevel=2)
        distortion = settings.pop("noise")
    if data is not None:
        check_type("data", data, Scene)
    source = find_model(source)
    # Only the main process checks the target, while the others wait. They must not mistake its output for an old file.
    outputs = Outputs(source, scene=data, overwrite=overwrite)
    ranks.run_on_all(lambda: outputs.file(target) if ranks.is_main else None)
    if profile != "compact":
        if data is not None or finetune_steps or target_bytes or max_psnr_drop is not None or distortion:
            raise HyrfError(
                f"profile '{profile}' cannot be fitted to photos, a target size or a limit on the loss",
                fix="use profile 'compact'",
            )
        repacked = ranks.run_on_all(
            lambda: repack(source, target, profile, overwrite=overwrite, **settings) if ranks.is_main else None
        )
        return CompressionReport(**vars(cast(FileReport, ranks.broadcast(repacked))))
    if settings:
        raise HyrfError(f"profile 'compact' has no setting '{next(iter(settings))}'", fix="leave it out")
    if data is None and (finetune_steps or max_psnr_drop is not None):
        raise HyrfError("fine-tuning and limits on PSNR need photos", fix="name their folder with `data`")
    if sum(option is not None for option in (target_bytes, max_psnr_drop, distortion)) > 1:
        raise HyrfError(
            "a target size and a largest loss of PSNR each decide how fine the file is",
            fix="give one of them",
        )
    if data is not None and not data.train:
        raise HyrfError(
            f"{data.path}: all photos are held out, so that none is left to measure with",
            fix="use a larger `test_every`",
        )
    model, provenance = load_with_provenance(source)
    kept = quantized_provenance(provenance, model.config.frame.scale)
    if target_bytes is not None:
        check_target_bytes(target_bytes, kept, model.exposure)
    model = model.to(choose_own_device(device, ranks))
    model.precision = "float32"  # quantisation errors are smaller than the rounding of lower precisions on a GPU
    if len(model) == 0:
        raise HyrfError(
            f"{source}: there is no Gaussian in it, so there is nothing to measure",
            fix="use profile 'paper'",
        )
    cameras = Capture(describe_file(source), data).cameras
    _LOG.info(f"measuring how each stored number affects renders, at {len(cameras)} cameras and between them")
    start = distortion or default_distortion(provenance, finetune_steps)
    encoding_start = (
        SEARCH_ENCODING_START_SHARE
        if finetune_steps or target_bytes or max_psnr_drop is not None
        else ENCODING_START_SHARE
    )
    measuring_report = report_part(report, 0.0, encoding_start)
    sensitivity, references = measure_calibrated_sensitivity(model, cameras, start, prune, measuring_report)
    sensitivity = ranks.broadcast(sensitivity)  # on GPUs the other ranks' values differ in their last bits
    encoding_report = report_part(report, encoding_start, 1.0)
    packer = Packer(model, kept, sensitivity, data, finetune_steps, prune, encoding_report, ranks=ranks)
    if target_bytes is not None:
        candidate, search_result = packer.encode_within_bytes(target_bytes, start)
    elif max_psnr_drop is not None:
        candidate, search_result = packer.encode_within_psnr_drop(max_psnr_drop, start)
    else:
        target_drop = DEFAULT_PSNR_DROP_DB if distortion is None else None
        candidate = (
            packer.encode(start, encoding_report)
            if finetune_steps
            else packer.encode_to_distortion(start, references, target_drop)
        )
        search_result = ""
    written = ranks.run_on_all(
        lambda: write_model(candidate.data, target, overwrite=overwrite) if ranks.is_main else None
    )
    total = sum(candidate.predicted_errors.values())
    return CompressionReport(
        **vars(cast(FileReport, ranks.broadcast(written))),
        shares={part: error / (total or 1.0) for part, error in candidate.predicted_errors.items()},
        error=candidate.measured_error or total,
        found=search_result,
        finetuned=finetune_steps > 0,
        sensitivity=sensitivity,
    )


@dataclass
class Packer:
    """Encodes one model at different distortions, from sensitivities that were measured once.

    Attributes:
        model: the model to encode.
        provenance: provenance to store in the files.
        sensitivity: calibrated sensitivities of the model, see `measure_calibrated_sensitivity`.
        scene: photos to fine-tune on and to measure losses on; None if there are none.
        finetune_steps: steps of fine-tuning for each file; 0 for none.
        prune: leave out Gaussians whose removal saves more rate than it costs in distortion.
        report: called with the name of the current task and the completed share of encoding all files, 0 to 1.
        cache: cache of decoded photos.
        ranks: processes that fine-tune together.
    """

    model: HybridModel
    provenance: dict
    sensitivity: Sensitivity
    scene: Scene | None
    finetune_steps: int
    prune: bool
    report: Report = no_report
    cache: PictureCache = field(default_factory=PictureCache)
    ranks: Ranks = SINGLE_PROCESS

    def encode(self, distortion: float, report: Report = no_report) -> EncodedCandidate:
        """Encode a file that adds an estimated `distortion` to the mean squared error of pictures."""
        report("planning quantisation", 0.0)
        model, steps = self.model, self.finetune_steps
        plan = make_plan(model, self.sensitivity, distortion, self.prune)
        if steps:
            assert self.scene is not None
            _LOG.info(f"fine-tuning for {steps:,} steps")

            own_steps = -(-steps // self.ranks.size)

            def report_step(step: int, loss: float) -> None:
                report(f"fine-tuning, step {step}/{own_steps}", 0.9 * step / own_steps)

            fit = partial(finetune, gains=self._gains, cache=self.cache, report=report_step, ranks=self.ranks)
            planned, plan = fit(model, plan, self.sensitivity, self.scene.train, steps)
        else:
            planned = plan.apply(model)
        report("quantising", 0.9 if steps else 0.1)
        quantized = quantize(planned, plan, self.sensitivity, reach=0 if steps else 1)
        report("entropy coding", 0.95 if steps else 0.6)
        data = encode_model(planned, "compact", self.provenance, quantized=quantized)
        return EncodedCandidate(data, predict_errors(self.model, planned, quantized, self.sensitivity))

    def encode_to_distortion(
        self, target: float, references: ReferenceRenders, target_drop: float | None = None
    ) -> EncodedCandidate:
        """Encode a file whose measured error is about `target`, and limit its PSNR drop on training photos.

        The distortion adds to the model's error against photos only if the two are independent. In a model that was
        hardly trained they are not: compression shifts the colours of whole pictures, whose exposure the model does not
        match either. So the drop is measured on some training photos, if there are any. A file that loses more than
        PSNR_DROP_TOLERANCE_RATIO times `target_drop` (dB) is encoded again with a smaller distortion.
        """
        if self.scene is None or target_drop is None:
            return self._encode_to_distortion(target, references, self.report)[0]
        candidate, distortion = self._encode_to_distortion(target, references, report_part(self.report, 0.0, 0.3))
        views = evenly_spaced(self.scene.train, PSNR_DROP_VIEWS)
        try:
            before = evaluate_model(self.model, views, report=report_part(self.report, 0.3, 0.6)).psnr
            for number in range(MAX_CORRECTIONS):
                report = report_round(report_part(self.report, 0.6, 1.0), number)
                psnr_drop = before - evaluate_model(self.decode(candidate), views, report=report).psnr
                if psnr_drop <= PSNR_DROP_TOLERANCE_RATIO * target_drop:
                    break
                distortion *= max(target_drop / psnr_drop, 1 / MAX_REFINING_RATIO)
                _LOG.info(
                    f"training photos lose {psnr_drop:.2f} dB, limit {target_drop:g} dB; encoding again at "
                    f"distortion {distortion:.2g}"
                )
                candidate = self.encode(distortion)
                candidate = dataclasses.replace(
                    candidate, measured_error=references.measure_error(self.decode(candidate))
                )
        except HyrfError as error:  # a photo cannot be read, or masks leave no pixel to score
            _LOG.warning(f"{error}; the loss on training photos is not measured")
        return candidate

    def _encode_to_distortion(
        self, target: float, references: ReferenceRenders, report: Report
    ) -> tuple[EncodedCandidate, float]:
        """Encode a file whose measured error is about `target`; return it and the distortion it was planned for.

        The parts were calibrated separately, so their errors together may differ a little from the prediction.
        """

        def encode_candidate(distortion: float, number: int) -> EncodedCandidate:
            candidate_report = report_round(report, number)
            candidate = self.encode(distortion, report_part(candidate_report, 0.0, 0.5))
            candidate_report("comparing renders of the file with those of the model", 0.5)
            return dataclasses.replace(candidate, measured_error=references.measure_error(self.decode(candidate)))

        candidate, distortion = encode_candidate(target, 0), target
        for number in range(MAX_CORRECTIONS):
            error = candidate.measured_error
            error_ratio = error / target
            if error_ratio == 0 or 1 / DISTORTION_TOLERANCE_RATIO < error_ratio < DISTORTION_TOLERANCE_RATIO:
                break
            distortion /= min(max(error_ratio, 1 / MAX_COARSENING_RATIO), MAX_REFINING_RATIO)
            kind = "finer" if error_ratio > 1 else "coarser"
            _LOG.info(
                f"renders have a mean squared error of {error:.2g}, target {target:.2g}; encoding again at "
                f"distortion {distortion:.2g} ({kind})"
            )
            other = encode_candidate(distortion, number + 1)
            if error_ratio > 1:
                candidate = other
                continue
            # Coarsen only once, because errors that the comparison views do not show must also stay bounded.
            return (
                (other, distortion)
                if other.measured_error < DISTORTION_TOLERANCE_RATIO * target
                else (candidate, target)
            )
        return candidate, distortion

    def encode_within_bytes(self, limit: int, start: float) -> tuple[EncodedCandidate, str]:
        """Search for the best file of at most `limit` bytes, from distortion `start`; return it and a description.

        Raises:
            HyrfSizeError: even the largest distortion gives a larger file.
        """
        rounds = count()

        def encode_candidate(distortion: float) -> EncodedCandidate:
            candidate = self.encode(distortion, report_round(self.report, next(rounds)))
            _LOG.info(f"distortion {distortion:.2g}: {len(candidate.data):,} bytes")
            return candidate

        answer = find_fullest(
            encode_candidate, lambda candidate: len(candidate.data), limit, start, self._max_trials(), DISTORTION_RANGE
        )
        if answer is None:
            smallest = len(self.encode(DISTORTION_RANGE[1]).data)
            raise HyrfSizeError(
                f"the model does not fit into {limit:,} bytes, and the smallest possible size is about {smallest:,} "
                "bytes",
                fix="use a larger target size, or train with fewer Gaussians (`max_gaussians`)",
                min_bytes=smallest,
            )
        distortion, candidate = answer
        return candidate, f"distortion {distortion:.2g} gives {len(candidate.data):,} of {limit:,} bytes"

    def encode_within_psnr_drop(self, limit: float, start: float) -> tuple[EncodedCandidate, str]:
        """Search for the smallest file that loses at most `limit` dB of PSNR; return it and a description.

        The loss is measured on the held-out photos, or on the training photos if none are held out.

        Raises:
            HyrfError: even the smallest distortion loses more.
        """
        assert self.scene is not None
        views = self.scene.test or self.scene.train
        self.report("scoring the model", 0.0)
        before = evaluate_model(self.model, views).psnr
        rounds = count()

        def encode_candidate(distortion: float) -> EncodedCandidate:
            report = report_round(self.report, next(rounds))
            candidate = self.encode(distortion, report_part(report, 0.0, 0.7))
            report("scoring the file", 0.7)
            psnr_drop = before - evaluate_model(self.decode(candidate), views).psnr
            candidate = dataclasses.replace(candidate, psnr_drop=psnr_drop)
            _LOG.info(f"distortion {distortion:.2g}: {len(candidate.data):,} bytes, {psnr_drop:+.3f} dB lost")
            return candidate

        answer = find_coarsest(
            encode_candidate,
            lambda candidate: candidate.psnr_drop <= limit,
            start,
            self._max_trials(),
            DISTORTION_RANGE,
        )
        if answer is None:
            raise HyrfError(
                f"even the finest file loses more than {limit:g} dB of PSNR",
                fix="use a larger `max_psnr_drop`, or profile 'raw'",
            )
        distortion, candidate = answer
        return (
            candidate,
            f"distortion {distortion:.2g} loses {candidate.psnr_drop:+.3f} of {limit:g} dB on {len(views)} photos",
        )

    @cached_property
    def _gains(self) -> dict[str, torch.Tensor] | None:
        """Return the residual gains of the photos to fine-tune on; None if the model was trained without gains."""
        assert self.scene is not None
        if self.model.exposure is None and not has_mean_exposure(self.provenance):
            return None
        return fit_residual_gains(self.model, self.scene.train, self.cache)

    def decode(self, candidate: EncodedCandidate) -> HybridModel:
        """Decode a file, on the device and at the precision of the model."""
        model = decode_model(candidate.data).to(self.model.gaussians.positions.device)
        model.precision = self.model.precision
        return model

    def _max_trials(self) -> int:
        return FINETUNED_SEARCH_TRIALS if self.finetune_steps else SEARCH_TRIALS
