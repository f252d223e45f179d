"""Quantises a model as its file will hold it, on the model's device, in each step of fine-tuning."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor

from hyrfpack.compress.channels import choose_channel_codes
from hyrfpack.compress.groups import choose_group_codes
from hyrfpack.compress.quantize import SATURATION_LOGIT, quantize
from hyrfpack.compress.sensitivity import Sensitivity
from hyrfpack.format.arrays import SECTION_PARAMETERS, iter_parameters
from hyrfpack.format.compact.channels import MAX_ABS_CHANNEL_VALUE
from hyrfpack.format.compact.groups import StepGroups
from hyrfpack.format.compact.plan import Plan
from hyrfpack.format.compact.quantized import LOGIT_COLUMNS
from hyrfpack.format.sections import COLORS, LOGIT_SECTIONS, OPACITIES, POSITIONS, RESIDUAL_SECTIONS, SCALES
from hyrfpack.model import HybridModel, expand
from hyrfpack.ops.transfer import tensor_like
from hyrfpack.parallel.pool import parallel_map
from hyrfpack.quant.lifting import iter_levels
from hyrfpack.quant.steps import ALL_ZERO_CODE, FIXED_POINT_ONE, MAX_ABS_SYMBOL, decode_step

# A group that is stored as zeros has a step so large that all its numbers are rounded to zero.
ALL_ZERO_STEP = 1e300
# Bits per number are |q| / (b ln 2), where b is the mean of |q| in a group plus this.
MIN_MEAN_MAGNITUDE = 0.1
NUMBERS_PER_CPU_BLOCK = 1 << 15  # small enough that temporary arrays stay in the caches
# On a GPU, sums have this many copies, to which numbers are added by turns: few addresses would queue atomic additions.
GPU_SUM_COPIES = 1024

T = TypeVar("T")


@dataclass(frozen=True)
class QuantizedParameters:
    """Parameters of a model, quantised as in its file, and the gradient of their rate.

    Attributes:
        values: numbers as they will be decoded, by the name of the parameter, in its shape.
        rate_gradients: d bits / d number (float32) by the name of the parameter, multiplied by the price of a bit.
    """

    values: dict[str, Tensor]
    rate_gradients: dict[str, Tensor]


class TrainingQuantizer:
    """Quantises a planned model as `quantize` with `reach` 0 does, again and again while its parameters change.

    Steps, groups and prediction weights depend on the plan only and stay on the model's device. A call copies nothing
    to the host and does not wait for the device. The CPU and GPUs run the same torch operations.

    A number q steps from its prediction has the rate |q| / (b ln 2) bits, where b is the mean of |q| in its group plus
    MIN_MEAN_MAGNITUDE.
    """

    def __init__(self, model: HybridModel, plan: Plan, sensitivity: Sensitivity, price: float) -> None:
        """Prepare for models of the shapes of `model`, a planned model (`plan.apply`).

        Args:
            sensitivity: the sensitivities that the plan was made from.
            price: factor of the gradients of the rate, the loss per bit.

        Raises:
            HyrfError: a parameter is NaN or infinite.
        """
        device, distortion = model.gaussians.positions.device, plan.distortion_per_number
        first = quantize(model, plan, sensitivity, reach=0, sections=(*LOGIT_SECTIONS, *RESIDUAL_SECTIONS))
        weights = [
            [channel.weight for group in LOGIT_SECTIONS for channel in channels[group]] for channels in first.channels
        ]
        # Fine-tuning does not change residuals.
        residuals = {group: values for group, values in first.arrays().items() if group in RESIDUAL_SECTIONS}
        self._residuals = {name: values.to(device) for name, values in iter_parameters(residuals, model)}
        self._logits = _LogitQuantizer(plan, sensitivity.subset(plan.kept), weights, price, device)
        self._groups = {
            group: _GroupQuantizer(groups, sensitivity.fields[group], distortion, price, device)
            for group, groups in plan.groups.items()
        }
        sides = [(1 << points.bits)[points.classes] for points in (layer.points for layer in plan.layers)]
        self._lattice_sides = torch.from_numpy(np.concatenate(sides).astype(np.float64)[:, None]).to(device)

    @torch.no_grad()
    def quantize(self, model: HybridModel) -> QuantizedParameters:
        """Return the quantised parameters of a model whose positions, logits, tables or decoders have changed."""
        parameters = {name: parameter.detach() for name, parameter in model.named_parameters()}
        values, gradients = dict(self._residuals), dict[str, Tensor]()
        for group, quantizer in self._groups.items():
            names = SECTION_PARAMETERS[group]
            parts = [parameters[name].reshape(-1) for name in names]
            found = quantizer.quantize(parts[0] if len(parts) == 1 else torch.cat(parts))
            for result, joined in zip((values, gradients), found, strict=True):
                pieces = joined.split([len(part) for part in parts])
                result |= {name: piece.view_as(parameters[name]) for name, piece in zip(names, pieces, strict=True)}
        explicit = [parameters[name] for group in LOGIT_SECTIONS for name in SECTION_PARAMETERS[group]]
        neural = model.geometry(model.cube_coords(model.gaussians.positions))[:, 0].double()
        for result, joined in zip((values, gradients), self._logits.quantize(explicit, neural), strict=True):
            pieces = joined.split(list(LOGIT_COLUMNS.values()), dim=1)
            result |= {SECTION_PARAMETERS[group][0]: piece for group, piece in zip(LOGIT_SECTIONS, pieces, strict=True)}
        values[SECTION_PARAMETERS[POSITIONS][0]] = self.lattice_positions(model)
        return QuantizedParameters(values, gradients)

    @torch.no_grad()
    def lattice_positions(self, model: HybridModel) -> Tensor:
        """Return the positions (M, 3) float32 at which a model's Gaussians would be stored."""
        positions = model.gaussians.positions.detach()
        result = torch.empty_like(positions)

        def snap(part: slice) -> None:
            sides = self._lattice_sides[part]
            cells = torch.floor(model.cube_coords(positions[part].double()) * sides)
            local = expand((torch.minimum(cells.clamp_min_(0), sides - 1) + 0.5) / sides)
            result[part] = local * tensor_like(model.config.frame.half_extent, local)

        _map_blocks(snap, len(positions), positions.device)
        return result


@contextmanager
def parameters_replaced(model: HybridModel, values: dict[str, Tensor]) -> Iterator[None]:
    """Replace parameters and buffers of a model, by their names, while the block runs."""
    targets = {**dict(model.named_parameters()), **dict(model.named_buffers())}
    replaced = {name: (targets[name].detach(), value) for name, value in values.items()}
    before = [target.clone() for target, _ in replaced.values()]
    for target, value in replaced.values():
        target.copy_(value)
    try:
        yield
    finally:
        for (target, _), value in zip(replaced.values(), before, strict=True):
            target.copy_(value)


class _GroupQuantizer:
    """Quantises the numbers of a hash table or of a decoder, in groups that share a step."""

    def __init__(
        self, groups: StepGroups, sensitivity: np.ndarray, distortion: float, price: float, device: torch.device
    ) -> None:
        codes, _ = choose_group_codes(groups, sensitivity, distortion)
        steps = np.where(codes == ALL_ZERO_CODE, ALL_ZERO_STEP, decode_step(codes) / FIXED_POINT_ONE)
        members = np.maximum(np.bincount(groups.index, minlength=groups.count), 1)
        self._steps, self._members = (torch.from_numpy(values).to(device) for values in (steps, members))
        self._index = torch.from_numpy(groups.index.astype(np.int32)).to(device)
        self._price = price

    def quantize(self, values: Tensor) -> tuple[Tensor, Tensor]:
        """Return the decoded numbers and the gradients of their rate, (n,) float32, for numbers (n,) float32."""
        decoded, gradients = torch.empty_like(values), torch.empty_like(values)

        def round_block(part: slice) -> Tensor:
            index = self._index[part]
            steps = self._steps.index_select(0, index)
            symbols = torch.round(values[part].double() / steps).clamp_(-MAX_ABS_SYMBOL, MAX_ABS_SYMBOL)
            decoded[part] = symbols * steps
            return _sum_by_group(symbols.abs_(), index, len(self._steps))

        sums = sum(_map_blocks(round_block, len(values), values.device))
        slopes = _rate_slopes(sums / self._members, self._steps, self._price).float()

        def multiply_block(part: slice) -> None:
            torch.mul(decoded[part].sign(), slopes.index_select(0, self._index[part]), out=gradients[part])

        _map_blocks(multiply_block, len(values), values.device)
        return decoded, gradients


class _LogitQuantizer:
    """Quantises the explicit logits of all Gaussians, by prediction from neighbours as in `hyrfpack.quant.lifting`.

    Its arrays have a row for each Gaussian and a column for each channel. The numbers of one level of the prediction
    are adjacent in them, so that a level is one operation on all layers and channels.
    """

    def __init__(
        self, plan: Plan, sensitivity: Sensitivity, weights: list[list[int]], price: float, device: torch.device
    ) -> None:
        self._price, self._levels, order, before, after = price, *_order_by_level(plan)
        counts = [len(layer.points.classes) for layer in plan.layers]
        edges = np.cumsum([0, *counts])
        self._layers = [slice(int(first), int(last)) for first, last in pairwise(edges)]
        class_count = max(int(layer.points.classes.max(initial=0)) + 1 for layer in plan.layers)
        group, steps = [], np.ones((len(plan.layers), class_count, sum(LOGIT_COLUMNS.values())), np.int64)
        logit_sensitivity = {COLORS: sensitivity.colors, SCALES: sensitivity.scales, OPACITIES: sensitivity.opacities}
        columns = [section for section, width in LOGIT_COLUMNS.items() for _ in range(width)]
        for number, (layer, part) in enumerate(zip(plan.layers, self._layers, strict=True)):
            classes = layer.points.classes
            group.append(number * class_count + classes.astype(np.int32))
            for column, section in enumerate(columns):
                codes = choose_channel_codes(classes, logit_sensitivity[section][part], plan.distortion_per_number)
                steps[number, : len(codes), column] = decode_step(codes)
        self._group_steps = torch.from_numpy(steps.reshape(-1, steps.shape[-1])).to(device)
        groups = np.concatenate(group)
        members = np.maximum(np.bincount(groups, minlength=len(self._group_steps)), 1)
        self._members = torch.from_numpy(members[:, None]).to(device)
        group_of_place = torch.from_numpy(groups).to(device)
        # Each layer's mean is weighted with 1 / step.
        self._mean_weights = 1 / self._group_steps.index_select(0, group_of_place).double()
        self._mean_totals = torch.stack([self._mean_weights[part].sum(0) for part in self._layers])
        # Arrays from here on are in the order of levels.
        self._order, self._before, self._after = (
            torch.from_numpy(index).to(device) for index in (order, before, after)
        )
        self._place = torch.empty_like(self._order)
        self._place[self._order] = torch.arange(len(order), device=device)
        self._group = group_of_place[self._order]
        self._layer = (self._group // class_count).int()
        self._steps = self._group_steps.index_select(0, self._group)
        self._weights = torch.tensor(weights, dtype=torch.int8).to(device).index_select(0, self._layer)
        if not any(any(row) for row in weights):
            self._levels = [(0, len(order))]
        self._basis = torch.from_numpy(plan.basis.astype(np.float64)).to(device)

    def quantize(self, logits: list[Tensor], neural: Tensor) -> tuple[Tensor, Tensor]:
        """Return the decoded logits and the gradients of their rate, (M, 5) float32 in the order of the file.

        Args:
            logits: explicit logits (M, columns) float32 of colours, scales and opacities.
            neural: (M,) float64 opacity logits of the geometry field, which are added to the explicit ones.
        """
        device = neural.device
        values = torch.empty_like(self._mean_weights)
        colors, scales, opacities = logits

        def transform(part: slice) -> None:
            # Colours are clamped before the change of basis; clamping after it would change the hue.
            clamped = colors[part].double().clamp_(-MAX_ABS_CHANNEL_VALUE / 2, MAX_ABS_CHANNEL_VALUE / 2)
            values[part, :3] = clamped @ self._basis
            values[part, 3:4] = scales[part]
            limit = neural[part]
            values[part, 4] = torch.minimum(
                torch.maximum(opacities[part, 0].double(), -SATURATION_LOGIT - limit), SATURATION_LOGIT - limit
            )
            values[part].clamp_(-MAX_ABS_CHANNEL_VALUE, MAX_ABS_CHANNEL_VALUE)

        _map_blocks(transform, len(values), device)
        sums = [(values[part] * self._mean_weights[part]).sum(0) for part in self._layers]
        means = (torch.stack(sums) / self._mean_totals).float().double()
        decoded, residuals = torch.empty_like(self._steps), torch.empty_like(self._steps)

        def center(part: slice) -> None:
            ordered = values.index_select(0, self._order[part]) - means.index_select(0, self._layer[part])
            residuals[part] = torch.round(ordered * FIXED_POINT_ONE).long()

        _map_blocks(center, len(values), device)
        self._lift(residuals, decoded)
        decoded_values, gradients = (torch.empty(len(values), 5, device=device) for _ in range(2))

        def sum_block(part: slice) -> Tensor:
            return _sum_by_group(residuals[part].abs().double(), self._group[part], len(self._group_steps))

        magnitudes = sum(_map_blocks(sum_block, len(values), device)) / self._members
        slopes = _rate_slopes(magnitudes, self._group_steps.double() / FIXED_POINT_ONE, 1.0)

        def finish(part: slice) -> None:
            place = self._place[part]
            numbers = decoded.index_select(0, place).double() / FIXED_POINT_ONE
            numbers += means.index_select(0, self._layer.index_select(0, place))
            gradient = residuals.index_select(0, place).sign() * slopes.index_select(
                0, self._group.index_select(0, place)
            )
            for column, weights in enumerate(self._basis):
                first, second, third = (numbers[:, j] * weights[j] for j in range(3))
                decoded_values[part, column] = first + second + third
            decoded_values[part, 3:] = numbers[:, 3:]
            gradient[:, :3] = gradient[:, :3] @ self._basis.T
            gradients[part] = gradient.mul_(self._price)

        _map_blocks(finish, len(values), device)
        return decoded_values, gradients

    def _lift(self, targets: Tensor, decoded: Tensor) -> None:
        """Replace targets by differences from their predictions in steps, and compute the decoded numbers.

        Both are (M, 5) int64 in units of 1 / FIXED_POINT_ONE, in the order of levels.
        """
        for number, (first, last) in enumerate(self._levels):

            def round_block(block: slice, first: int = first, is_predicted: bool = number > 0) -> None:
                part = slice(block.start + first, block.stop + first)
                steps, target, prediction = self._steps[part], targets[part], None
                if is_predicted:
                    prediction = decoded.index_select(0, self._before[part])
                    prediction += decoded.index_select(0, self._after[part])
                    prediction *= self._weights[part]
                    prediction >>= 5
                    target -= prediction
                target += steps >> 1
                torch.div(target, steps, rounding_mode="floor", out=target)
                torch.mul(target, steps, out=decoded[part])
                if prediction is not None:
                    decoded[part] += prediction

            _map_blocks(round_block, last - first, targets.device)


def _order_by_level(plan: Plan) -> tuple[list[tuple[int, int]], np.ndarray, np.ndarray, np.ndarray]:
    """Sort the Gaussians of all layers by the levels of their predictions.

    Returns:
        The first and the last row + 1 of each level. Then, for each row (M,) int64: the place of its Gaussian in the
        file, and the rows of its two neighbours, which are the same row if there is one; 0 for the first level, whose
        numbers are not predicted.
    """
    places, following = defaultdict[int, list[np.ndarray]](list), defaultdict[int, list[np.ndarray]](list)
    start = 0
    for count in (len(layer.points.classes) for layer in plan.layers):
        if count:
            places[0].append(np.array([start]))
            following[0].append(np.array([start]))
        for level, distance in iter_levels(count):
            places[distance].append(start + level)
            following[distance].append(start + np.where(level + distance < count, level + distance, level - distance))
        start += count
    distances = [0, *sorted((distance for distance in places if distance), reverse=True)]
    order = np.concatenate([part for distance in distances for part in places[distance]])
    after = np.concatenate([part for distance in distances for part in following[distance]])
    before = np.concatenate([part - distance for distance in distances for part in places[distance]])
    row = np.empty(len(order), np.int64)
    row[order] = np.arange(len(order))
    edges = np.cumsum([0, *(sum(map(len, places[distance])) for distance in distances)])
    return [(int(first), int(last)) for first, last in pairwise(edges)], order, row[before], row[after]


def _rate_slopes(magnitudes: Tensor, steps: Tensor, price: float) -> Tensor:
    """Return price * d rate / d number = price / (b ln 2 step) for positive symbols of mean magnitude `magnitudes`."""
    return price * (1 / ((magnitudes + MIN_MEAN_MAGNITUDE) * np.log(2) * steps))


def _sum_by_group(values: Tensor, index: Tensor, count: int) -> Tensor:
    """Return the sum of each group's integers, (count, ...) float64, for `values` (n, ...) and groups `index` (n,)."""
    copies = 1 if values.device.type == "cpu" else GPU_SUM_COPIES
    if copies > 1:
        turns = torch.arange(len(index), dtype=index.dtype, device=index.device) % copies
        index = turns * count + index
    sums = values.new_zeros(copies * count, *values.shape[1:]).index_add_(0, index, values)
    return sums.view(copies, count, *values.shape[1:]).sum(0)


def _map_blocks(function: Callable[[slice], T], count: int, device: torch.device) -> list[T]:
    """Call a function for slices of `count` rows: short ones on all cores of the CPU, one of all rows on a GPU."""
    size = NUMBERS_PER_CPU_BLOCK if device.type == "cpu" else max(count, 1)
    parts = [slice(first, min(first + size, count)) for first in range(0, count, size)]
    return parallel_map(function, parts, device)
