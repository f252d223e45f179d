"""Quantisation-aware fine-tuning, which continues training with quantised parameters and the rate in the loss."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from hyrfpack.compress.plan import replan_moved
from hyrfpack.compress.rate_distortion import LAMBDA_PER_DISTORTION
from hyrfpack.compress.sensitivity import Sensitivity
from hyrfpack.compress.training_quantizer import TrainingQuantizer, parameters_replaced
from hyrfpack.config.train import LearningRates
from hyrfpack.data import PictureCache
from hyrfpack.device import Photos, upload
from hyrfpack.errors import HyrfError, HyrfTrainingError
from hyrfpack.evaluate.exposure import fit_gains
from hyrfpack.format.compact.plan import Plan
from hyrfpack.model import HybridModel
from hyrfpack.model.exposure import apply_exposure_gains, clamp_colors
from hyrfpack.ops.ssim import photometric_loss
from hyrfpack.ops.transfer import HostCopy
from hyrfpack.parallel.pool import keep_freed_memory, torch_on_one_thread
from hyrfpack.parallel.ranks import SINGLE_PROCESS, Ranks
from hyrfpack.progress import Progress, TaskEvent, ignore_progress
from hyrfpack.render import render_view
from hyrfpack.render.reserve import Reserve, can_reserve
from hyrfpack.scene import Picture, View
from hyrfpack.train.distributed import average_gradients
from hyrfpack.train.launched import LaunchedStep
from hyrfpack.train.optimizer import Optimizer
from hyrfpack.train.reserves import ReserveEstimator
from hyrfpack.train.step_checks import MAX_GRADIENT, check_step
from hyrfpack.train.trainer import shuffled

FINETUNING_RATES = LearningRates(
    # The last rate is low: if a Gaussian changes its cell late, its other numbers no longer fit.
    positions=(1e-4, 1e-6),
    fields=(2e-3, 2e-4),
    color_logits=(6e-3, 6e-4),
    scale_logits=(8e-3, 8e-4),
    opacity_logits=(2e-2, 2e-3),
)
# Shorter runs have no time to converge after large steps, so their rates are lower in proportion to their length.
FULL_RATE_STEPS = 500
# A small mean squared error e added to a picture raises the photometric loss by about LOSS_PER_MSE * e.
LOSS_PER_MSE = 40.0


def finetune(
    model: HybridModel,
    plan: Plan,
    sensitivity: Sensitivity,
    views: Sequence[View],
    steps: int,
    *,
    seed: int = 0,
    gains: Mapping[str, Tensor] | None = None,
    cache: PictureCache | None = None,
    progress: Progress = ignore_progress,
    ranks: Ranks = SINGLE_PROCESS,
) -> tuple[HybridModel, Plan]:
    """Fit a model to the photos with its numbers quantised as in the file.

    Each step renders the model with quantised numbers (a straight-through estimator passes the gradients) and adds

        LOSS_PER_MSE * 2 ln 2 D * bits

    to the photometric loss, with the same lambda as `quantize`. A number q steps from its prediction has the rate
    |q| / (b ln 2) bits, where b is the mean of |q| in its group. This is the ideal code of a Laplace distribution.
    A step copies no parameters to the host, see `TrainingQuantizer`.
    Positions move on the lattice; classes and their steps stay fixed.

    Args:
        model: a trained model; not changed.
        plan: the model's plan.
        sensitivity: the sensitivities that the plan was made from.
        views: photos to fit.
        steps: number of views to fit; one process takes one view per optimiser step, several take one each.
        seed: random seed of the order of views.
        gains: residual gains of each photo, applied to the render before it is compared, see `fit_residual_gains`; None
            compares renders as they are.
        cache: cache of decoded photos.
        progress: called with a `TaskEvent` after each step.
        ranks: processes that fit the same model together, as in `Trainer`; all get the same result.

    Returns:
        The stored part of the model, fitted, and its plan. It must be quantised with `reach` 0, because its numbers
        were fitted to be rounded to the nearest symbol.

    Raises:
        HyrfTrainingError: the loss or a gradient is not finite.
    """
    tuned = plan.apply(model)
    tuned.load_state_dict({"gaussians.positions": model.gaussians.positions.detach()[plan.kept]}, strict=False)
    tuned.requires_grad_(True)
    share = min(1.0, steps / FULL_RATE_STEPS)
    rates = {
        name: (share * first, share * last) for name, (first, last) in dataclasses.asdict(FINETUNING_RATES).items()
    }
    price = LOSS_PER_MSE * LAMBDA_PER_DISTORTION * plan.distortion_per_number
    quantizer = TrainingQuantizer(tuned, plan, sensitivity, price)
    optimizer = Optimizer(tuned, LearningRates(**rates), ranks.size)
    finetuner = _Finetuner(tuned, quantizer, optimizer, views, -(-steps // ranks.size), seed, gains, ranks)
    finetuner.run(cache or PictureCache(), progress)
    plan, placed = replan_moved(plan, tuned)
    return placed, plan


@dataclass(frozen=True)
class _BackpropagatedView:
    """A view whose gradients, without those of the rate, are those of the parameters.

    Attributes:
        view, picture: the view and its photo.
        loss: scalar on the device.
        rate_gradients: see `QuantizedParameters`.
        demand, reserve: what the rendering needed and had, see `Rendering.demand`; None if it reserved no memory.
    """

    view: View
    picture: Picture
    loss: Tensor
    rate_gradients: dict[str, Tensor]
    demand: Tensor | None
    reserve: Reserve | None


class _Finetuner:
    """The steps of fine-tuning.

    As in training (`Trainer`), a GPU renders views into reserved memory, and the host reads the numbers of a step after
    it has launched the gradients of the next one. A step whose reserve was too small changes nothing and is retaken.
    """

    def __init__(
        self,
        model: HybridModel,
        quantizer: TrainingQuantizer,
        optimizer: Optimizer,
        views: Sequence[View],
        steps: int,
        seed: int,
        gains: Mapping[str, Tensor] | None,
        ranks: Ranks,
    ) -> None:
        """Prepare to fine-tune a planned model in `steps` optimiser steps; the other arguments are `finetune`'s."""
        self.model, self.quantizer, self.optimizer = model, quantizer, optimizer
        self.views, self.steps, self.seed, self.gains, self.ranks = views, steps, seed, gains, ranks
        device = model.gaussians.positions.device
        self.photos = Photos(device)
        self.reserves = ReserveEstimator() if can_reserve(device) and ranks.is_single else None
        self._launched: LaunchedStep | None = None

    def run(self, cache: PictureCache, progress: Progress) -> None:
        """Take all steps.

        Raises:
            HyrfTrainingError: the loss or a gradient is not finite.
        """
        order = shuffled(self.views, self.seed, range(self.ranks.rank, self.steps * self.ranks.size, self.ranks.size))
        with closing(cache.stream(order)) as pictures, torch_on_one_thread(), keep_freed_memory():
            for step in range(1, self.steps + 1):
                problem: HyrfError | None = None
                rendered: _BackpropagatedView | None = None
                try:
                    view, picture = next(pictures)
                    rendered = self._backpropagate(view, picture)
                except HyrfError as error:
                    if self.ranks.is_single:
                        raise
                    problem = error
                if self._confirm_launched():  # These gradients are those of an older model.
                    self._discard_gradients()
                    rendered = self._backpropagate(view, picture)
                self._update(step, rendered, problem)
                if self.reserves is None or step == self.steps:
                    self._confirm_launched(problem)
                progress(TaskEvent(f"fine-tuning, step {step}/{self.steps}", step / self.steps))

    def _backpropagate(self, view: View, picture: Picture) -> _BackpropagatedView:
        """Backpropagate the photometric loss of a view of the quantised model."""
        quantized = self.quantizer.quantize(self.model)
        solid = np.array(self.model.config.solid, np.float32)
        target, mask = self.photos.get(view.load, picture, solid)
        reserve = None if self.reserves is None else self.reserves.estimate(view, len(self.model))
        with parameters_replaced(self.model, quantized.values):
            rendering = render_view(self.model, view.camera, reserve=reserve)
            image = rendering.rgb
            if self.gains is not None:
                image = apply_exposure_gains(clamp_colors(image), self.gains[view.name])
            loss = photometric_loss(image, target, mask)
            loss.backward()
        return _BackpropagatedView(view, picture, loss.detach(), quantized.rate_gradients, rendering.demand, reserve)

    def _update(self, step: int, rendered: _BackpropagatedView | None, problem: HyrfError | None) -> None:
        """Launch the rest of a step: average and complete the gradients, update the parameters, copy the numbers.

        On one of several processes, None stands for a view that has a problem.
        """
        loss = self.model.gaussians.positions.new_zeros(()) if rendered is None else rendered.loss
        packed = torch.stack((loss,))
        if not self.ranks.is_single:
            own = loss.new_tensor((loss, problem is not None))
            packed = average_gradients(self.ranks, list(self.model.parameters()), own) / self.ranks.size
        if rendered is not None:
            for name, parameter in self.model.named_parameters():
                if parameter.grad is not None and name in rendered.rate_gradients:
                    parameter.grad += rendered.rate_gradients[name]
        checks, reserved = None, None
        if rendered is not None and rendered.reserve is not None and rendered.demand is not None:
            checks = check_step(rendered.loss, self.optimizer.gradients(), rendered.demand, rendered.reserve)
            reserved = rendered.view, rendered.picture
        broken = self.optimizer.step(step - 1, self.steps, None if checks is None else checks.valid)
        # Adam sets no flags where the step is not valid.
        numbers = [broken] if checks is None else [checks.valid[None], checks.demand, checks.norms]
        self._launched = LaunchedStep(step, reserved, HostCopy(torch.cat([packed, *numbers])), len(packed))

    def _confirm_launched(self, problem: HyrfError | None = None) -> bool:
        """Wait for the numbers of the launched step, if any, and check them; return whether the step was retaken.

        Args:
            problem: the problem of this process's view.
        """
        if self._launched is None:
            return False
        launched, self._launched = self._launched, None
        (loss, *problems), numbers = launched.read_numbers()
        self.ranks.raise_if_lost()
        if any(problems):
            self.ranks.raise_if_any(problem)
        is_finite, is_complete = np.isfinite(loss), True
        if launched.reserved is None:
            is_finite = is_finite and not any(numbers)
        else:
            valid, nonfinite_positions, in_view, nonfinite_inputs, pairs, *norms = numbers
            is_finite = is_finite and not nonfinite_positions and not nonfinite_inputs
            is_finite = is_finite and all(norm <= MAX_GRADIENT for norm in norms)
            is_complete = bool(valid)
            assert self.reserves is not None
            self.reserves.record(launched.reserved[0], len(self.model), int(in_view), int(pairs))
        if not is_finite:
            size = self.ranks.size
            views = shuffled(self.views, self.seed, range((launched.step - 1) * size, launched.step * size))
            raise HyrfTrainingError(
                f"fine-tuning stopped at step {launched.step} on view {' or '.join(repr(v.name) for v in views)}: the "
                "loss or a gradient is not finite",
                fix="compress without `finetune_steps`",
            )
        if is_complete or launched.reserved is None:
            return False
        self.optimizer.retract_step()
        self._discard_gradients()
        self._update(launched.step, self._backpropagate(*launched.reserved), None)
        self._confirm_launched()
        return True

    def _discard_gradients(self) -> None:
        for parameter in self.model.parameters():
            parameter.grad = None


@torch.no_grad()
def fit_residual_gains(
    model: HybridModel, views: Sequence[View], cache: PictureCache | None = None
) -> dict[str, Tensor]:
    """Fit the residual gains of each photo, which match the render as photographed to the photo.

    E(image, gains) is `apply_exposure_gains`. With the gains g_map of the model's exposure map and the residual gains g
    of a photo,

        photo = E(E(consistent, g_map), g) + e = E(consistent, g_map g) + e

    A model that is fitted to photos with these gains keeps its consistent exposure and its map, because g absorbs the
    part of a photo's exposure that the map does not explain. Without a map, g is the whole exposure. A photo that is
    nearly black or white has gains of one, so it has the exposure that the map predicts.

    Returns:
        (3,) gains on the model's device, by the name of the photo.
    """
    device = model.gaussians.positions.device
    solid = np.array(model.config.solid, np.float32)
    decoded, gains = model.decode(), {}
    with closing((cache or PictureCache()).stream(views)) as pictures, torch_on_one_thread():
        for view, picture in pictures:
            photo, mask = upload(picture, solid, device)
            fitted = fit_gains(render_view(model, view.camera, decoded=decoded).rgb, photo, mask)
            gains[view.name] = torch.from_numpy(fitted).float().to(device)
    return gains
