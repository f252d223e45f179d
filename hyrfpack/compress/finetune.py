"""Quantisation-aware fine-tuning: train on, seeing through the quantiser, with the bits in the loss."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing

import numpy as np
import torch
from torch import Tensor

from hyrfpack.compress.plan import at_cells, follow
from hyrfpack.compress.quantize import quantize
from hyrfpack.compress.rate_distortion import ERROR_PER_BIT
from hyrfpack.compress.sensitivity import Sensitivity
from hyrfpack.data import PictureCache
from hyrfpack.device import Photos, upload
from hyrfpack.errors import HyrfError, HyrfTrainingError
from hyrfpack.evaluate.exposure import fitted_gains
from hyrfpack.format.arrays import iter_parameters
from hyrfpack.format.compact.plan import Plan, lattice_to_local
from hyrfpack.format.compact.quantized import QuantizedModel
from hyrfpack.format.sections import COLORS, POSITIONS
from hyrfpack.model import HybridModel
from hyrfpack.model.exposure import expose
from hyrfpack.ops.ssim import photometric_loss
from hyrfpack.parallel.pool import keep_freed_memory, torch_on_one_thread
from hyrfpack.parallel.ranks import SINGLE_PROCESS, Ranks
from hyrfpack.quant.steps import ONE, step_of
from hyrfpack.render import render
from hyrfpack.scene import Picture, View
from hyrfpack.train.config import LearningRates
from hyrfpack.train.optimizer import Optimizer
from hyrfpack.train.together import averaged
from hyrfpack.train.trainer import shuffled

RATES = LearningRates(
    positions=(1e-4, 1e-6),  # cells that are left late cost the other numbers what they have settled to
    fields=(2e-3, 2e-4),
    color_logits=(6e-3, 6e-4),
    scale_logits=(8e-3, 8e-4),
    opacity_logits=(2e-2, 2e-3),
)
FULL_RATES = 500  # steps from which on rates are these; in fewer there is no time to settle after large ones
LOSS_PER_ERROR = 40.0  # what the photometric loss rises by for a small mean squared error added to the picture


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
    report: Callable[[int, float], None] = lambda step, loss: None,
    ranks: Ranks = SINGLE_PROCESS,
) -> tuple[HybridModel, Plan]:
    """Fit a model's numbers to the photos as they will be decoded.

    Each step renders the model as it is after quantising (rounding passes gradients straight through) and adds

        LOSS_PER_ERROR * 2 ln 2 D * bits

    to the photometric loss, the exchange rate of `quantize`; a number q steps from its prediction is taken to cost
    |q| / (b ln 2) bits, b being the mean of |q| in its group (the ideal code of a Laplace distribution). Positions move
    on the lattice; classes and their steps stay.

    Args:
        model: a trained model; not changed.
        plan: its plan.
        sensitivity: that the plan was made by.
        views: photos to fit.
        steps: optimiser steps of one process, one view each; several take as many views together.
        seed: of the order of views.
        gains: of each photo, that renders as photographed are exposed by before they are compared, see
            `gains_of_photos`; None compares renders as they are.
        cache: holds decoded photos.
        report: called after each step with its number, from 1, and the photometric loss.
        ranks: processes that fit the same model together, as in `Trainer`; all get the same.

    Returns:
        The fitted part of the model that is stored, to be quantised with `reach` 0, for its numbers sit where they
        shall be rounded to; and its plan.

    Raises:
        HyrfTrainingError: the loss or a gradient is not finite.
    """
    tuned = plan.apply(model)
    tuned.load_state_dict({"gaussians.positions": model.gaussians.positions.detach()[plan.kept]}, strict=False)
    tuned.requires_grad_(True)
    share = min(1.0, steps / FULL_RATES)
    rates = {name: (share * first, share * last) for name, (first, last) in dataclasses.asdict(RATES).items()}
    optimizer = Optimizer(tuned, LearningRates(**rates), ranks.size)
    steps = -(-steps // ranks.size)
    quantized: QuantizedModel | None = None
    keep_freed_memory()
    photos = Photos(tuned.gaussians.positions.device)
    order = shuffled(views, seed, range(ranks.rank, steps * ranks.size, ranks.size))
    with closing((cache or PictureCache()).stream(order)) as pictures, torch_on_one_thread():
        for step in range(steps):
            quantized = quantize(tuned, plan, sensitivity, reach=0, like=quantized)
            exact = {name: value.clone() for name, value in tuned.state_dict().items()}
            decoded = {**quantized.arrays(), POSITIONS: _on_lattice(tuned, plan)}
            tuned.load_state_dict(dict(iter_parameters(decoded, tuned)), strict=False)
            problem: HyrfError | None = None
            try:
                loss = _fit(tuned, photos, *next(pictures), gains)
            except HyrfError as refusal:
                if ranks.is_single:
                    raise
                problem, loss = refusal, tuned.gaussians.positions.new_zeros(())
            if not ranks.is_single:
                said = averaged(ranks, list(tuned.parameters()), loss.new_tensor((loss, problem is not None)))
                loss, problems = said / ranks.size
                if problems:
                    ranks.raise_if_any(problem)
            tuned.load_state_dict(exact)
            _add_rate(tuned, quantized, LOSS_PER_ERROR * ERROR_PER_BIT * plan.distortion_per_number)
            broken = optimizer.step(step, steps)
            if not torch.isfinite(loss) or broken.any():
                views_of_step = shuffled(views, seed, range(step * ranks.size, (step + 1) * ranks.size))
                raise HyrfTrainingError(
                    f"fine-tuning stopped at step {step + 1} on view "
                    f"{' or '.join(repr(view.name) for view in views_of_step)}: the loss or a gradient is not "
                    "finite; compress without `finetune_steps`"
                )
            report(step + 1, float(loss))
    plan, placed = follow(plan, tuned)
    return placed, plan


def _fit(
    model: HybridModel, photos: Photos, view: View, picture: Picture, gains: Mapping[str, Tensor] | None
) -> Tensor:
    """Add the gradients of a view's photometric loss; the loss, a scalar."""
    solid = None if model.config.background else np.array(model.config.solid, np.float32)
    target, mask = photos.get(view.name, picture, solid)
    image = render(model, view.camera).rgb
    if gains is not None:
        image = expose(image, gains[view.name])
    loss = photometric_loss(image, target, mask)
    loss.backward()
    return loss.detach()


@torch.no_grad()
def gains_of_photos(model: HybridModel, views: Sequence[View], cache: PictureCache | None = None) -> dict[str, Tensor]:
    """Fit the residual gains of each photo: those of `expose` that bring the render as photographed to the photo.

    With the gains g_map of the model's exposure map and the residual gains g of a photo,

        photo = expose(expose(consistent, g_map), g) + e = expose(consistent, g_map g) + e

    so that a model which is fitted to photos with these gains keeps its consistent exposure and its map: what the map
    does not explain of a photo's exposure goes into g. Without a map, g holds all of it. A photo that is nearly black
    or white has gains of one, the exposure that the map predicts.

    Returns:
        (3,) gains on the model's device, by the name of the photo.
    """
    device = model.gaussians.positions.device
    solid = None if model.config.background else np.array(model.config.solid, np.float32)
    decoded, gains = model.decode(), {}
    with closing((cache or PictureCache()).stream(views)) as pictures, torch_on_one_thread():
        for view, picture in pictures:
            photo, mask = upload(picture, solid, device)
            fitted = fitted_gains(render(model, view.camera, decoded=decoded).rgb, photo, mask)
            gains[view.name] = torch.from_numpy(fitted).float().to(device)
    return gains


@torch.no_grad()
def _on_lattice(model: HybridModel, plan: Plan) -> np.ndarray:
    """The positions (M, 3) that a planned model's Gaussians would be stored at."""
    cube = model.cube_coords(model.gaussians.positions.double()).cpu().numpy()
    places, start = [], 0
    for points in (layer.points for layer in plan.layers):
        part = slice(start, start := start + len(points.classes))
        places.append(lattice_to_local(at_cells(cube[part], points.classes, points.bits), model.config.frame))
    return np.concatenate(places)


@torch.no_grad()
def _add_rate(model: HybridModel, quantized: QuantizedModel, price: float) -> None:
    """Add the gradient of price * bits to the parameters' gradients."""
    parameters, plan, slopes = dict(model.named_parameters()), quantized.plan, {}
    for group in quantized.channels[0]:
        values = np.concatenate(
            [
                np.stack([_slope(c.residuals, layer.points.classes, len(c.codes), c.codes) for c in channels[group]], 1)
                for layer, channels in zip(plan.layers, quantized.channels, strict=True)
            ]
        )
        slopes[group] = values @ plan.basis.T.astype(np.float64) if group == COLORS else values
    for group, chosen in quantized.groups.items():
        groups = plan.groups[group]
        slopes[group] = _slope(chosen.symbols, groups.index, groups.count, chosen.codes)
    slopes = {group: (price * values).astype(np.float32) for group, values in slopes.items()}
    for name, slope in iter_parameters(slopes, model):
        gradient = parameters[name].grad
        if gradient is not None:
            gradient += slope.to(gradient)


def _slope(symbols: np.ndarray, index: np.ndarray, count: int, codes: np.ndarray) -> np.ndarray:
    """d bits / d number: sign(q) / (b ln 2 step), (n,) float64."""
    members = np.maximum(np.bincount(index, minlength=count), 1)
    spread = np.bincount(index, np.abs(symbols), count) / members + 0.1
    slope = 1 / (spread * np.log(2) * (step_of(codes) / ONE))
    return np.sign(symbols) * slope[index]
