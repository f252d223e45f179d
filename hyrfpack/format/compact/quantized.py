"""A model's quantised numbers as sections, and sections as numbers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from hyrfpack.format.compact.channels import Channel, decode_channel, encode_channel
from hyrfpack.format.compact.groups import GroupSymbols, encode_groups
from hyrfpack.format.compact.plan import Plan
from hyrfpack.format.container import Section
from hyrfpack.format.sections import COLORS, LAYERED, LOGITS, MLPS, POSITIONS, TABLES, layer_section
from hyrfpack.model.hybrid import HybridModel
from hyrfpack.parallel.pool import run_jobs
from hyrfpack.quant import DamagedDataError
from hyrfpack.quant.points import Points

CODEC_POINTS, CODEC_CHANNELS, CODEC_GROUPS = 6, 7, 8
COLUMNS = dict(zip(LOGITS, (3, 1, 1), strict=True))
_BLOCK = 1 << 15  # numbers at once: few enough that temporaries stay in the caches


@dataclass(frozen=True)
class Quantized:
    """A model's numbers as they will be stored; of some sections, until it is encoded.

    Attributes:
        plan: which they are.
        channels: of each layer colour (3, in the plan's basis), scale (1) and opacity logits (1), by section.
        groups: of the hash tables and decoders, by section.
    """

    plan: Plan
    channels: list[dict[str, list[Channel]]]
    groups: dict[str, GroupSymbols]

    def arrays(self) -> dict[str, np.ndarray]:
        """The numbers as they will be decoded: flat tables and decoders, (M, columns) explicit logits; float32."""
        arrays = {group: chosen.values for group, chosen in self.groups.items()}
        for group in self.channels[0]:
            layers = [[channel.values for channel in layer[group]] for layer in self.channels]
            arrays[group] = np.concatenate([_joined(values, self.plan.basis) for values in layers])
        return arrays


def encode(model: HybridModel, quantized: Quantized) -> tuple[list[Section], dict]:
    """Sections for a model but for the metadata, in file order, and what was decided, for people.

    A part of the file from its start on is a model if it holds the first layer and the fields.

    Args:
        model: whose numbers were quantised.
        quantized: from `hyrfpack.compress.quantize`.
    """
    plan = quantized.plan

    def encode_channels(layer: int, group: str) -> Section:
        basis = plan.basis.astype("<f4").tobytes() if group == COLORS else b""
        classes = plan.layers[layer].points.classes
        data = basis + b"".join(encode_channel(channel, classes) for channel in quantized.channels[layer][group])
        return Section(layer_section(group, layer), CODEC_CHANNELS, data, 4 * COLUMNS[group] * len(classes))

    def encode_numbers(group: str) -> Section:
        data = encode_groups(quantized.groups[group], plan.groups[group])
        return Section(group, CODEC_GROUPS, data, 4 * len(plan.groups[group].index))

    jobs: dict[str, Callable[[], Section]] = {group: partial(encode_numbers, group) for group in plan.groups}
    for layer in range(len(plan.layers)):
        jobs |= {layer_section(group, layer): partial(encode_channels, layer, group) for group in COLUMNS}
    done = run_jobs(jobs)
    for layer, part in enumerate(plan.layers):
        tag = layer_section(POSITIONS, layer)
        done[tag] = Section(tag, CODEC_POINTS, part.positions, 12 * len(part.points.classes))
    further = [layer_section(group, layer) for layer in range(1, len(plan.layers)) for group in LAYERED]
    settings = {"distortion": plan.distortion_per_number, "gaussians_before": len(model)}
    return [done[tag] for tag in (*MLPS, *LAYERED, *TABLES, *further)], settings


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
