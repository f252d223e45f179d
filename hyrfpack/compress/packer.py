"""Encoding of a model with measured sensitivities: once, to a distortion, or by a search for a size or a loss."""

from __future__ import annotations

import dataclasses
import logging
from dataclasses import dataclass, field
from functools import cached_property

import torch

from hyrfpack.cameras.capture import has_mean_exposure
from hyrfpack.compress.finetune import finetune, fit_residual_gains
from hyrfpack.compress.limits import (
    FINETUNED_SEARCH_TRIALS,
    SEARCH_TRIALS,
    EncodedCandidate,
    encode_within_bytes,
    encode_within_psnr_drop,
)
from hyrfpack.compress.part_errors import predict_errors
from hyrfpack.compress.plan import make_plan
from hyrfpack.compress.planner import Planner
from hyrfpack.compress.quantize import field_opacity_logits, opacity_column, quantize
from hyrfpack.compress.reference_renders import ReferenceRenders
from hyrfpack.compress.sensitivity import Sensitivity
from hyrfpack.data import PictureCache
from hyrfpack.errors import HyrfError
from hyrfpack.evaluate import evaluate_model
from hyrfpack.format.codec import decode_model, encode_model
from hyrfpack.model import HybridModel
from hyrfpack.parallel.ranks import SINGLE_PROCESS, Ranks
from hyrfpack.progress import Progress, TaskEvent, ignore_progress, part_of_progress, round_of_progress
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
        progress: called with `TaskEvent`s.
        cache: cache of decoded photos.
        ranks: processes that fine-tune together.
        planner: the planner that the sensitivities were calibrated with, which may have the plan already.
    """

    model: HybridModel
    provenance: dict
    sensitivity: Sensitivity
    scene: Scene | None = None
    finetune_steps: int = 0
    prune: bool = True
    progress: Progress = ignore_progress
    cache: PictureCache = field(default_factory=PictureCache)
    ranks: Ranks = SINGLE_PROCESS
    planner: Planner | None = None

    def encode(self, distortion: float, progress: Progress = ignore_progress) -> EncodedCandidate:
        """Encode a file that adds an estimated `distortion` to the mean squared error of pictures."""
        progress(TaskEvent("planning quantisation", 0.0))
        model, steps = self.model, self.finetune_steps
        if steps:
            assert self.scene is not None
            plan = make_plan(model, self.sensitivity, distortion, self.prune)
            _LOG.info(f"fine-tuning for {steps:,} steps")
            planned, plan = finetune(
                model,
                plan,
                self.sensitivity,
                self.scene.train,
                steps,
                gains=self._gains,
                cache=self.cache,
                progress=part_of_progress(progress, 0.0, 0.9),
                ranks=self.ranks,
            )
            field_logits = field_opacity_logits(planned)
        else:
            plans = (self.planner or Planner(model, self.prune)).plan(self.sensitivity, distortion)
            planned, plan, field_logits = plans.model, plans.plan, opacity_column(plans.geometry_outputs)
        progress(TaskEvent("quantising", 0.9 if steps else 0.1))
        reach = 0 if steps else 1
        quantized = quantize(planned, plan, self.sensitivity, reach=reach, field_logits=field_logits)
        progress(TaskEvent("entropy coding", 0.95 if steps else 0.6))
        data = encode_model(planned, "compact", self.provenance, quantized=quantized)
        return EncodedCandidate(data, predict_errors(planned, quantized, self.sensitivity, field_logits))

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
            return self._encode_to_distortion(target, references, self.progress)[0]
        candidate, distortion = self._encode_to_distortion(
            target, references, part_of_progress(self.progress, 0.0, 0.3)
        )
        views = evenly_spaced(self.scene.train, PSNR_DROP_VIEWS)
        try:
            before = evaluate_model(self.model, views, progress=part_of_progress(self.progress, 0.3, 0.6)).psnr
            for number in range(MAX_CORRECTIONS):
                progress = round_of_progress(part_of_progress(self.progress, 0.6, 1.0), number)
                scoring, encoding = part_of_progress(progress, 0.0, 0.5), part_of_progress(progress, 0.5, 1.0)
                psnr_drop = before - evaluate_model(self.decode(candidate), views, progress=scoring).psnr
                if psnr_drop <= PSNR_DROP_TOLERANCE_RATIO * target_drop:
                    break
                distortion *= max(target_drop / psnr_drop, 1 / MAX_REFINING_RATIO)
                _LOG.info(
                    f"training photos lose {psnr_drop:.2f} dB, target {target_drop:g} dB; encoding again at "
                    f"distortion {distortion:.2g}"
                )
                candidate = self.encode(distortion, encoding)
                candidate = dataclasses.replace(
                    candidate, measured_error=references.measure_error(self.decode(candidate))
                )
        except HyrfError as error:  # a photo cannot be read, or masks leave no pixel to score
            _LOG.warning(f"{error}; the loss on training photos is not measured")
        return candidate

    def _encode_to_distortion(
        self, target: float, references: ReferenceRenders, progress: Progress
    ) -> tuple[EncodedCandidate, float]:
        """Encode a file whose measured error is about `target`; return it and the distortion it was planned for.

        The parts were calibrated separately, so their errors together may differ a little from the prediction.
        """

        def encode_candidate(distortion: float, number: int) -> EncodedCandidate:
            candidate_progress = round_of_progress(progress, number)
            candidate = self.encode(distortion, part_of_progress(candidate_progress, 0.0, 0.5))
            candidate_progress(TaskEvent("comparing renders of the file with those of the model", 0.5))
            return dataclasses.replace(candidate, measured_error=references.measure_error(self.decode(candidate)))

        candidate, distortion = encode_candidate(target, 0), target
        for number in range(MAX_CORRECTIONS):
            error = candidate.measured_error
            error_ratio = error / target
            if error_ratio == 0 or 1 / DISTORTION_TOLERANCE_RATIO < error_ratio < DISTORTION_TOLERANCE_RATIO:
                break
            before = distortion
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
                else (candidate, before)
            )
        return candidate, distortion

    def encode_within_bytes(self, limit: int, start: float) -> tuple[EncodedCandidate, str]:
        """Search for the best file of at most `limit` bytes; see `limits.encode_within_bytes`."""
        return encode_within_bytes(self.encode, limit, start, self.progress, self._max_trials())

    def encode_within_psnr_drop(self, limit: float, start: float) -> tuple[EncodedCandidate, str]:
        """Search for the smallest file that loses at most `limit` dB of PSNR; see `limits.encode_within_psnr_drop`.

        The loss is measured on the held-out photos, or on the training photos if none are held out.
        """
        assert self.scene is not None
        views = self.scene.test or self.scene.train
        return encode_within_psnr_drop(
            self.encode, self.decode, self.model, views, limit, start, self.progress, self._max_trials()
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
