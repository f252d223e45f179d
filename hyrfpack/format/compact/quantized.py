"""Encoding of a model's quantised numbers as sections, and decoding of its channels."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from hyrfpack.format.arrays import residual_widths
from hyrfpack.format.compact.channels import BASIS_BYTES, Channel, decode_channel, encode_channel, read_basis
from hyrfpack.format.compact.groups import GroupSymbols, encode_groups
from hyrfpack.format.compact.plan import Plan
from hyrfpack.format.compact.residuals import ResidualSymbols, encode_residuals
from hyrfpack.format.container import Section
from hyrfpack.format.sections import (
    COLORS,
    DECODER_SECTIONS,
    HARMONICS,
    LAYERED_SECTIONS,
    LOGIT_SECTIONS,
    POSITIONS,
    TABLE_SECTIONS,
    layer_section,
)
from hyrfpack.model.hybrid import HybridModel
from hyrfpack.parallel.pool import run_jobs
from hyrfpack.quant import DamagedDataError
from hyrfpack.quant.points import LatticePoints, encode_sorted_points

CODEC_POINTS = 6
CODEC_CHANNELS = 7
CODEC_GROUPS = 8
CODEC_STATED_GROUPS = 11
CODEC_RESIDUALS = 13
LOGIT_COLUMNS = dict(zip(LOGIT_SECTIONS, (3, 1, 1), strict=True))
_GAUSSIANS_PER_BLOCK = 1 << 15  # small enough that temporary arrays stay in the caches


@dataclass(frozen=True)
class QuantizedModel:
    """Quantised numbers of a model. `encode` needs those of all sections; other callers may leave some out.

    Attributes:
        plan: selection, order and grouping of the numbers.
        channels: for each layer, the channels of colour (3, in the plan's basis), scale (1) and opacity logits (1), by
            section.
        groups: symbols of the hash tables and decoders, by section.
        residuals: for each layer, the residuals by section; empty for a model without them.
    """

    plan: Plan
    channels: list[dict[str, list[Channel]]]
    groups: dict[str, GroupSymbols]
    residuals: list[dict[str, ResidualSymbols]] = field(default_factory=list)

    def arrays(self) -> dict[str, np.ndarray]:
        """Return float32 numbers as they will be decoded, by section: flat tables and decoders, logits (M, columns)."""
        arrays = {group: symbols.values for group, symbols in self.groups.items()}
        for group in self.channels[0]:
            layers = [[channel.values for channel in layer[group]] for layer in self.channels]
            arrays[group] = np.concatenate([_join_channels(values, self.plan.basis) for values in layers])
        for group in self.residuals[0] if self.residuals else ():
            basis = self.plan.basis if group == HARMONICS else None
            pairs = zip(self.residuals, self.plan.layers, strict=True)
            parts = [residuals[group].values(layer.points.classes, basis) for residuals, layer in pairs]
            arrays[group] = np.concatenate(parts)
        return arrays


def encode(model: HybridModel, quantized: QuantizedModel) -> tuple[list[Section], dict]:
    """Encode quantised numbers; return all sections except the metadata, in file order, and the metadata's settings.

    The start of the file is a usable model as soon as it contains the first layer and the fields.

    Args:
        model: the model that was quantised.
        quantized: its numbers, from `hyrfpack.compress.quantize`.
    """
    plan = quantized.plan

    def encode_positions(layer: int) -> Section:
        points = plan.layers[layer].points
        data = encode_sorted_points(points, plan.layers[layer].base_bits)
        return Section(layer_section(POSITIONS, layer), CODEC_POINTS, data, 12 * len(points.classes))

    def encode_channels(layer: int, group: str) -> Section:
        basis = plan.basis.astype("<f4").tobytes() if group == COLORS else b""
        classes = plan.layers[layer].points.classes
        data = basis + b"".join(encode_channel(channel, classes) for channel in quantized.channels[layer][group])
        return Section(layer_section(group, layer), CODEC_CHANNELS, data, 4 * LOGIT_COLUMNS[group] * len(classes))

    def encode_numbers(group: str) -> Section:
        data = encode_groups(quantized.groups[group], plan.groups[group])
        return Section(group, CODEC_GROUPS, data, 4 * len(plan.groups[group].index))

    def encode_layer_residuals(layer: int, group: str) -> Section:
        classes, symbols = plan.layers[layer].points.classes, quantized.residuals[layer][group]
        data = encode_residuals(group, symbols, classes, plan.basis if group == HARMONICS else None)
        return Section(layer_section(group, layer), CODEC_RESIDUALS, data, 4 * widths[group] * len(classes))

    widths = residual_widths(model.config)
    groups = (*LAYERED_SECTIONS, *widths)
    jobs: dict[str, Callable[[], Section]] = {group: partial(encode_numbers, group) for group in plan.groups}
    for number in range(len(plan.layers)):
        jobs[layer_section(POSITIONS, number)] = partial(encode_positions, number)
        jobs |= {layer_section(group, number): partial(encode_channels, number, group) for group in LOGIT_COLUMNS}
        jobs |= {layer_section(group, number): partial(encode_layer_residuals, number, group) for group in widths}
    sections = run_jobs(jobs)
    later_layers = [layer_section(group, number) for number in range(1, len(plan.layers)) for group in groups]
    settings = {"distortion": plan.distortion_per_number, "gaussians_before": plan.gaussians_before}
    return [sections[tag] for tag in (*DECODER_SECTIONS, *groups, *TABLE_SECTIONS, *later_layers)], settings


def decode_channels(data: memoryview, points: LatticePoints, columns: int) -> np.ndarray:
    """Decode explicit logits; the basis of 3 columns is stored before them.

    Args:
        data: stored bytes of the section.
        points: lattice points with the class of each Gaussian.
        columns: number of columns, 1 or 3.

    Returns:
        (N, columns) float32.

    Raises:
        DamagedDataError: the bytes are truncated, damaged or inconsistent.
    """
    basis = np.eye(columns)
    if columns == 3:
        basis, data = read_basis(data[:BASIS_BYTES]), data[BASIS_BYTES:]
    channels = []
    for _ in range(columns):
        values, data = decode_channel(data, points.classes)
        channels.append(values)
    if len(data):
        raise DamagedDataError(f"{len(data)} bytes follow its last channel; it is damaged")
    return _join_channels(channels, basis)


def _join_channels(channels: list[np.ndarray], basis: np.ndarray) -> np.ndarray:
    """Transform channels back to columns (N, columns) float32.

    Products are added in a fixed order, so that every decoder gets the same numbers.
    """
    if len(channels) == 1:
        return channels[0][:, None].astype(np.float32)
    joined = np.empty((len(channels[0]), 3), np.float32)
    for start in range(0, len(joined), _GAUSSIANS_PER_BLOCK):
        block = slice(start, start + _GAUSSIANS_PER_BLOCK)
        for column in range(3):
            first, second, third = (values[block] * float(basis[column, j]) for j, values in enumerate(channels))
            joined[block, column] = first + second + third
    return joined
