"""A planned model as quantised numbers, these as sections, and sections as numbers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy.special import expit

from hyrfpack.format.arrays import to_arrays
from hyrfpack.format.compact.channels import Channel, ErrorModel, decode_channel, encode_channel, quantize_channel
from hyrfpack.format.compact.groups import GroupSymbols, encode_groups, quantize_groups
from hyrfpack.format.compact.plan import Plan
from hyrfpack.model.hybrid import HybridModel
from hyrfpack.quant import DamagedDataError
from hyrfpack.quant.points import Points

CODEC_POINTS, CODEC_CHANNELS, CODEC_GROUPS = 6, 7, 8
SATURATED = 8.0  # an opacity's total logit beyond it looks like it: sigmoid is within 3.4e-4 of its end
OPACITY_REACH = 4  # where opacity is near 0 or 1 logits may move far


@dataclass(frozen=True)
class Quantized:
    """A model's numbers as they will be stored.

    Attributes:
        channels: of "COLO" (3, in the plan's basis), "SCAL" (1) and "OPAC" (1).
        groups: of "GTAB", "GMLP", "RTAB" and "RMLP".
    """

    channels: dict[str, list[Channel]]
    groups: dict[str, GroupSymbols]

    def arrays(self, plan: Plan) -> dict[str, np.ndarray]:
        """The numbers as they will be decoded: flat tables and decoders, (M, columns) explicit logits; float32."""
        arrays = {group: chosen.values for group, chosen in self.groups.items()}
        for group, channels in self.channels.items():
            arrays[group] = _joined([channel.values for channel in channels], plan.basis)
        return arrays


def quantize(model: HybridModel, plan: Plan) -> Quantized:
    """Quantise a planned model (`plan.apply`) by rate and distortion."""
    arrays = {group: values.astype(np.float64) for group, values in to_arrays(model).items()}
    sensitivity, classes, d, reach = plan.sensitivity, plan.points.classes, plan.distortion, plan.reach
    opacity, error = opacity_error(model, arrays["OPAC"][:, 0], sensitivity.opacities)
    channels = {
        "COLO": [
            quantize_channel(values, classes, sensitivity.colors, d, reach=reach)
            for values in (arrays["COLO"] @ plan.basis.astype(np.float64)).T
        ],
        "SCAL": [quantize_channel(arrays["SCAL"][:, 0], classes, sensitivity.scales, d, reach=reach)],
        "OPAC": [quantize_channel(opacity, classes, sensitivity.opacities, d, error, reach and OPACITY_REACH)],
    }
    by_group = {**sensitivity.tables, **sensitivity.decoders}
    groups = {
        group: quantize_groups(arrays[group].ravel(), plan.groups[group], by_group[group], d, reach)
        for group in plan.groups
    }
    return Quantized(channels, groups)


def encode(quantized: Quantized, plan: Plan) -> dict[str, tuple[int, bytes]]:
    """Codec and stored bytes of each section but the metadata."""
    sections = {"POSI": (CODEC_POINTS, plan.positions)}
    for group, channels in quantized.channels.items():
        data = b"".join(encode_channel(channel, plan.points.classes) for channel in channels)
        basis = plan.basis.astype("<f4").tobytes() if group == "COLO" else b""
        sections[group] = CODEC_CHANNELS, basis + data
    for group, chosen in quantized.groups.items():
        sections[group] = CODEC_GROUPS, encode_groups(chosen, plan.groups[group])
    return sections


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
        if not (np.abs(basis) <= 1.001).all():
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
    for column in range(3):
        first, second, third = (values * float(basis[column, j]) for j, values in enumerate(channels))
        joined[:, column] = first + second + third
    return joined


@torch.no_grad()
def opacity_error(model: HybridModel, logits: np.ndarray, sensitivity: np.ndarray) -> tuple[np.ndarray, ErrorModel]:
    """Opacity logits (M,) without tails that nobody sees, and the error of candidates, counted in opacity."""
    neural = model.geometry(model.cube_coords(model.gaussians.positions))[:, 0].double().cpu().numpy()
    opacities = expit(neural + logits)
    weights = sensitivity / np.maximum(opacities * (1 - opacities), 1e-4) ** 2

    def error(places: np.ndarray, candidates: np.ndarray) -> np.ndarray:
        return weights[places] * (expit(neural[places] + candidates) - opacities[places]) ** 2

    return np.clip(logits, -SATURATED - neural, SATURATED - neural), error
