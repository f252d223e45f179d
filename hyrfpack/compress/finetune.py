"""Quantisation-aware fine-tuning, which continues training with quantised parameters and the rate in the loss."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from contextlib import closing

import numpy as np
import torch
from torch import Tensor

from hyrfpack.compress.plan import replan_moved, snap_to_lattice
from hyrfpack.compress.quantize import quantize
from hyrfpack.compress.rate_distortion import LAMBDA_PER_DISTORTION
from hyrfpack.compress.sensitivity import Sensitivity
from hyrfpack.config.train import LearningRates
from hyrfpack.data import PictureCache
from hyrfpack.device import Photos, upload
from hyrfpack.errors import HyrfError, HyrfTrainingError
from hyrfpack.evaluate.exposure import fit_gains
from hyrfpack.format.arrays import iter_parameters
from hyrfpack.format.compact.plan import Plan, lattice_to_local
from hyrfpack.format.compact.quantized import QuantizedModel
from hyrfpack.format.sections import COLORS, POSITIONS
from hyrfpack.model import HybridModel
from hyrfpack.model.exposure import apply_exposure_gains
from hyrfpack.ops.ssim import photometric_loss
from hyrfpack.parallel.pool import keep_freed_memory, torch_on_one_thread
from hyrfpack.parallel.ranks import SINGLE_PROCESS, Ranks
from hyrfpack.progress import Progress, TaskEvent, ignore_progress
from hyrfpack.quant.steps import FIXED_POINT_ONE, decode_step
from hyrfpack.render import render_view
from hyrfpack.scene import Picture, View
from hyrfpack.train.distributed import average_gradients
from hyrfpack.train.optimizer import Optimizer
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
    optimizer = Optimizer(tuned, LearningRates(**rates), ranks.size)
    steps = -(-steps // ranks.size)
    quantized: QuantizedModel | None = None
    keep_freed_memory()
    photos = Photos(tuned.gaussians.positions.device)
    order = shuffled(views, seed, range(ranks.rank, steps * ranks.size, ranks.size))
    with closing((cache or PictureCache()).stream(order)) as pictures, torch_on_one_thread():
        for step in range(steps):
            quantized = quantize(tuned, plan, sensitivity, reach=0, previous=quantized)
            exact = {name: value.clone() for name, value in tuned.state_dict().items()}
            decoded = {**quantized.arrays(), POSITIONS: _lattice_positions(tuned, plan)}
            tuned.load_state_dict(dict(iter_parameters(decoded, tuned)), strict=False)
            problem: HyrfError | None = None
            try:
                loss = _backpropagate_view(tuned, photos, *next(pictures), gains)
            except HyrfError as error:
                if ranks.is_single:
                    raise
                problem, loss = error, tuned.gaussians.positions.new_zeros(())
            if not ranks.is_single:
                sums = average_gradients(ranks, list(tuned.parameters()), loss.new_tensor((loss, problem is not None)))
                loss, problems = sums / ranks.size
                if problems:
                    ranks.raise_if_any(problem)
            tuned.load_state_dict(exact)
            _add_rate_gradients(tuned, quantized, LOSS_PER_MSE * LAMBDA_PER_DISTORTION * plan.distortion_per_number)
            broken = optimizer.step(step, steps)
            if not torch.isfinite(loss) or broken.any():
                views_of_step = shuffled(views, seed, range(step * ranks.size, (step + 1) * ranks.size))
                raise HyrfTrainingError(
                    f"fine-tuning stopped at step {step + 1} on view "
                    f"{' or '.join(repr(view.name) for view in views_of_step)}: the loss or a gradient is not finite",
                    fix="compress without `finetune_steps`",
                )
            progress(TaskEvent(f"fine-tuning, step {step + 1}/{steps}", (step + 1) / steps))
    plan, placed = replan_moved(plan, tuned)
    return placed, plan


def _backpropagate_view(
    model: HybridModel, photos: Photos, view: View, picture: Picture, gains: Mapping[str, Tensor] | None
) -> Tensor:
    """Backpropagate the photometric loss of a view and return the loss, a detached scalar."""
    solid = None if model.config.background else np.array(model.config.solid, np.float32)
    target, mask = photos.get(view.load, picture, solid)
    image = render_view(model, view.camera).rgb
    if gains is not None:
        image = apply_exposure_gains(image, gains[view.name])
    loss = photometric_loss(image, target, mask)
    loss.backward()
    return loss.detach()


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
    solid = None if model.config.background else np.array(model.config.solid, np.float32)
    decoded, gains = model.decode(), {}
    with closing((cache or PictureCache()).stream(views)) as pictures, torch_on_one_thread():
        for view, picture in pictures:
            photo, mask = upload(picture, solid, device)
            fitted = fit_gains(render_view(model, view.camera, decoded=decoded).rgb, photo, mask)
            gains[view.name] = torch.from_numpy(fitted).float().to(device)
    return gains


@torch.no_grad()
def _lattice_positions(model: HybridModel, plan: Plan) -> np.ndarray:
    """Return the positions (M, 3) at which a planned model's Gaussians would be stored."""
    cube = model.cube_coords(model.gaussians.positions.double()).cpu().numpy()
    places, start = [], 0
    for points in (layer.points for layer in plan.layers):
        part = slice(start, start := start + len(points.classes))
        places.append(lattice_to_local(snap_to_lattice(cube[part], points.classes, points.bits), model.config.frame))
    return np.concatenate(places)


@torch.no_grad()
def _add_rate_gradients(model: HybridModel, quantized: QuantizedModel, price: float) -> None:
    """Add the gradient of price * rate to the gradients of the parameters; `price` is the loss per bit."""
    parameters, plan, slopes = dict(model.named_parameters()), quantized.plan, {}
    for group in quantized.channels[0]:
        values = np.concatenate(
            [
                np.stack(
                    [_rate_gradient(c.residuals, layer.points.classes, len(c.codes), c.codes) for c in channels[group]],
                    1,
                )
                for layer, channels in zip(plan.layers, quantized.channels, strict=True)
            ]
        )
        slopes[group] = values @ plan.basis.T.astype(np.float64) if group == COLORS else values
    for group, chosen in quantized.groups.items():
        groups = plan.groups[group]
        slopes[group] = _rate_gradient(chosen.symbols, groups.index, groups.count, chosen.codes)
    slopes = {group: (price * values).astype(np.float32) for group, values in slopes.items()}
    for name, slope in iter_parameters(slopes, model):
        gradient = parameters[name].grad
        if gradient is not None:
            gradient += slope.to(gradient)


def _rate_gradient(symbols: np.ndarray, index: np.ndarray, count: int, codes: np.ndarray) -> np.ndarray:
    """Return d rate / d number = sign(q) / (b ln 2 step) in bits, (n,) float64."""
    members = np.maximum(np.bincount(index, minlength=count), 1)
    spread = np.bincount(index, np.abs(symbols), count) / members + 0.1
    slope = 1 / (spread * np.log(2) * (decode_step(codes) / FIXED_POINT_ONE))
    return np.sign(symbols) * slope[index]
