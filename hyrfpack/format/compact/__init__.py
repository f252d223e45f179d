"""Profile `compact`: every number is quantised as coarsely as renders allow and entropy coded.

positions                          lattice of the contracted cube, Morton order, gaps       section codec 6
colour, scale, opacity logits      a step for each class of Gaussians, prediction, rANS     section codec 7
hash tables                        a step for each usage class of rows, rANS                section codec 8, shared 11
decoders (MLPs)                    a step for each output, rANS                             section codec 8
residuals                          a flag for each Gaussian, a step for each class, rANS    section codec 13

`hyrfpack.compress_model` chooses what is stored and the quantisation steps; this package only encodes and decodes.
"""

from __future__ import annotations

import numpy as np

from hyrfpack.errors import HyrfFormatError
from hyrfpack.format.arrays import grid_configs
from hyrfpack.format.compact.groups import decode_groups, decode_usage_classes
from hyrfpack.format.compact.plan import USAGE_CLASS_COUNT, build_step_groups, lattice_to_local
from hyrfpack.format.compact.quantized import (
    CODEC_CHANNELS,
    CODEC_GROUPS,
    CODEC_POINTS,
    CODEC_RESIDUALS,
    CODEC_STATED_GROUPS,
    decode_channels,
    encode,
)
from hyrfpack.format.compact.residuals import decode_residuals
from hyrfpack.format.sections import DECODER_SECTIONS, LOGIT_SECTIONS, POSITIONS, RESIDUAL_SECTIONS, TABLE_SECTIONS
from hyrfpack.model.config import ModelConfig
from hyrfpack.quant.points import LatticePoints, decode_points

__all__ = ["CODEC_POINTS", "decode_positions", "decode_section", "encode"]

# The sections that each codec is allowed for.
SECTIONS_BY_CODEC = {
    CODEC_POINTS: (POSITIONS,),
    CODEC_CHANNELS: LOGIT_SECTIONS,
    CODEC_GROUPS: (*TABLE_SECTIONS, *DECODER_SECTIONS),
    CODEC_STATED_GROUPS: TABLE_SECTIONS,
    CODEC_RESIDUALS: RESIDUAL_SECTIONS,
}


def decode_positions(data: memoryview, count: int, config: ModelConfig) -> tuple[np.ndarray, LatticePoints]:
    """Decode the positions of a layer.

    Args:
        data: stored bytes of the section.
        count: number of Gaussians in the layer.
        config: configuration of the model.

    Returns:
        Local positions (count, 3) float32, and the lattice points that are needed to decode the other sections.

    Raises:
        DamagedDataError: the bytes are damaged.
    """
    points = decode_points(data, count)
    return lattice_to_local(points, config.frame), points


def decode_section(
    group: str, codec: int, data: memoryview, shape: tuple[int, int], config: ModelConfig, points: LatticePoints | None
) -> np.ndarray:
    """Decode a section of codec 7, 8, 11 or 13.

    Args:
        group: section type in the first layer.
        codec: codec number of the section.
        data: stored bytes of the section.
        shape: (rows, columns) of the result.
        config: configuration of the model.
        points: lattice points from `decode_positions`; None if the positions have another codec.

    Returns:
        (rows, columns) float32.

    Raises:
        DamagedDataError: the bytes are damaged.
        HyrfFormatError: this codec is not allowed for the section, or needs positions of another codec.
    """
    if group not in SECTIONS_BY_CODEC[codec]:
        raise HyrfFormatError(f"it cannot have codec {codec}", fix="the file is damaged, write it again")
    if group in DECODER_SECTIONS:
        return decode_groups(data, build_step_groups(group, config)).reshape(shape)
    if codec == CODEC_STATED_GROUPS:
        groups, data = decode_usage_classes(data, grid_configs(config)[group].offsets, USAGE_CLASS_COUNT)
        return decode_groups(data, groups).reshape(shape)
    if points is None:
        raise HyrfFormatError(f"codec {codec} needs positions of codec {CODEC_POINTS}", fix="write the file again")
    if codec == CODEC_RESIDUALS:
        return decode_residuals(group, data, points.classes, shape[1])
    if codec == CODEC_CHANNELS:
        return decode_channels(data, points, shape[1])
    return decode_groups(data, build_step_groups(group, config, points)).reshape(shape)
