"""A planned model as quantised numbers, these as sections, and sections as numbers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TypeVar

import numpy as np
import torch
from scipy.special import expit

from hyrfpack.format.arrays import to_arrays
from hyrfpack.format.compact.channels import (
    LIMIT,
    Channel,
    ErrorModel,
    decode_channel,
    encode_channel,
    quantize_channel,
)
from hyrfpack.format.compact.groups import GroupSymbols, encode_groups, quantize_groups
from hyrfpack.format.compact.plan import Plan
from hyrfpack.format.sections import (
    COLORS,
    LAYERED,
    LOGITS,
    MLPS,
    OPACITIES,
    POSITIONS,
    SCALES,
    TABLES,
    layer_section,
)
from hyrfpack.model.hybrid import HybridModel
from hyrfpack.parallel.pool import run_tasks
from hyrfpack.quant import DamagedDataError
from hyrfpack.quant.points import Points

CODEC_POINTS, CODEC_CHANNELS, CODEC_GROUPS = 6, 7, 8
SATURATED = 8.0  # an opacity's total logit beyond it looks like it: sigmoid is within 3.4e-4 of its end
COLUMNS = {COLORS: 3, SCALES: 1, OPACITIES: 1}
OPACITY_REACH = 4  # where opacity is near 0 or 1 logits may move far
_BLOCK = 1 << 15  # numbers at once: few enough that temporaries stay in the caches

T = TypeVar("T")


@dataclass(frozen=True)
class Quantized:
    """A model's numbers as they will be stored.

    Attributes:
        channels: of each layer "COLO" (3, in the plan's basis), "SCAL" (1) and "OPAC" (1).
        groups: of "GTAB", "GMLP", "RTAB" and "RMLP".
    """

    channels: list[dict[str, list[Channel]]]
    groups: dict[str, GroupSymbols]

    def arrays(self, plan: Plan) -> dict[str, np.ndarray]:
        """The numbers as they will be decoded: flat tables and decoders, (M, columns) explicit logits; float32."""
        arrays = {group: chosen.values for group, chosen in self.groups.items()}
        for group in LOGITS:
            layers = [[channel.values for channel in layer[group]] for layer in self.channels]
            arrays[group] = np.concatenate([_joined(values, plan.basis) for values in layers])
        return arrays


def quantize(model: HybridModel, plan: Plan, like: Quantized | None = None) -> Quantized:
    """Quantise a planned model (`plan.apply`) by rate and distortion.

    Args:
        like: an earlier result of the same plan, whose weights of predictions are taken over.
    """
    arrays = {group: values.astype(np.float64) for group, values in to_arrays(model).items()}
    sensitivity, d, reach = plan.sensitivity, plan.distortion, plan.reach
    opacity, error = opacity_error(model, arrays[OPACITIES][:, 0], sensitivity.opacities)
    by_group = {**sensitivity.tables, **sensitivity.decoders}
    jobs = {
        group: partial(quantize_groups, arrays[group].ravel(), plan.groups[group], by_group[group], d, reach)
        for group in plan.groups
    }
    # Cut before it is turned: a colour far outside would come back as another.
    colors = np.clip(arrays[COLORS], -LIMIT / 2, LIMIT / 2) @ plan.basis.astype(np.float64)
    for layer, part in enumerate(plan.parts):
        classes, s = plan.layers[layer].points.classes, sensitivity.of(part)

        def opacity_cost(places: np.ndarray, candidates: np.ndarray, part: slice = part) -> np.ndarray:
            return error(places + part.start, candidates)

        parts = {
            COLORS: (colors[part], s.colors, None, reach),
            SCALES: (arrays[SCALES][part], s.scales, None, reach),
            OPACITIES: (opacity[part, None], s.opacities, opacity_cost, reach and OPACITY_REACH),
        }
        for group, (values, weights, cost, far) in parts.items():
            for column, numbers in enumerate(values.T):
                weight = None if like is None else like.channels[layer][group][column].weight
                jobs[f"{group} {layer} {column}"] = partial(
                    quantize_channel, numbers, classes, weights, d, cost, far, weight
                )
    done = _together(jobs)
    channels = [
        {group: [done[f"{group} {layer} {column}"] for column in range(count)] for group, count in COLUMNS.items()}
        for layer in range(len(plan.layers))
    ]
    return Quantized(channels, {group: done[group] for group in plan.groups})


def encode(quantized: Quantized, plan: Plan) -> dict[str, tuple[int, bytes]]:
    """Codec and stored bytes of each section but the metadata, in file order: a part of the file from its start on is
    a model if it holds the first layer and the fields."""

    def encode_channels(layer: int, group: str) -> tuple[int, bytes]:
        basis = plan.basis.astype("<f4").tobytes() if group == COLORS else b""
        classes = plan.layers[layer].points.classes
        channels = [encode_channel(channel, classes) for channel in quantized.channels[layer][group]]
        return CODEC_CHANNELS, basis + b"".join(channels)

    def encode_numbers(group: str) -> tuple[int, bytes]:
        return CODEC_GROUPS, encode_groups(quantized.groups[group], plan.groups[group])

    jobs = {group: partial(encode_numbers, group) for group in plan.groups}
    for layer in range(len(plan.layers)):
        jobs |= {layer_section(group, layer): partial(encode_channels, layer, group) for group in COLUMNS}
    done = _together(jobs)
    for layer, points in enumerate(plan.layers):
        done[layer_section(POSITIONS, layer)] = CODEC_POINTS, points.positions
    first = [*MLPS, *LAYERED, *TABLES]
    further = [layer_section(group, layer) for layer in range(1, len(plan.layers)) for group in LAYERED]
    return {type: done[type] for type in (*first, *further)}


def decode_channels(data: memoryview, points: Points, columns: int) -> np.ndarray:
    """The explicit logits (N, columns) float32, 3 columns in a basis that comes before them.

    Raises:
        DamagedDataError: the bytes are truncated, damaged or contradict themselves.
    """
    basis = np.eye(columns)
    if columns == 3:
        if len(data) < 36:
            raise DamagedDataError(f"its {len(data)} bytes are fewer than those of a basis; it is truncated")
        basis = np.frombuffer(data[:36], "<f4").reshape(3, 3)
        data = data[36:]
        if not (np.abs(basis) <= 1 + 2**-10).all():
            raise DamagedDataError("its basis is not orthonormal; it is damaged")
    channels = []
    for _ in range(columns):
        values, data = decode_channel(data, points.classes)
        channels.append(values)
    if len(data):
        raise DamagedDataError(f"{len(data)} bytes follow its last channel; it is damaged")
    return _joined(channels, basis)


def _joined(channels: list[np.ndarray], basis: np.ndarray) -> np.ndarray:
    """Channels back in their columns, float32. Products are added in order: every decoder gets the same numbers."""
    if len(channels) == 1:
        return channels[0][:, None].astype(np.float32)
    joined = np.empty((len(channels[0]), 3), np.float32)
    for start in range(0, len(joined), _BLOCK):
        part = slice(start, start + _BLOCK)
        for column in range(3):
            first, second, third = (values[part] * float(basis[column, j]) for j, values in enumerate(channels))
            joined[part, column] = first + second + third
    return joined


def _together(jobs: dict[str, Callable[[], T]]) -> dict[str, T]:
    """What independent jobs return; they run side by side."""
    names, done = list(jobs), {}

    def run(index: int) -> None:
        done[names[index]] = jobs[names[index]]()

    run_tasks(run, len(names))
    return {name: done[name] for name in names}


@torch.no_grad()
def opacity_error(model: HybridModel, logits: np.ndarray, sensitivity: np.ndarray) -> tuple[np.ndarray, ErrorModel]:
    """Opacity logits (M,) without tails that nobody sees, and the error of candidates, counted in opacity."""
    neural = model.geometry(model.cube_coords(model.gaussians.positions))[:, 0].double().cpu().numpy()
    opacities = expit(neural + logits)
    weights = sensitivity / np.maximum(opacities * (1 - opacities), 1e-4) ** 2

    def error(places: np.ndarray, candidates: np.ndarray) -> np.ndarray:
        return weights[places] * (expit(neural[places] + candidates) - opacities[places]) ** 2

    return np.clip(logits, -SATURATED - neural, SATURATED - neural), error
