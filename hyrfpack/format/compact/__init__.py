"""Profile `compact`: every number as coarse as pictures allow, in as few bits as that takes.

positions                          lattice of the contracted cube, Morton order, gaps       section codec 6
colour, scale, opacity logits      a step for each class of Gaussians, prediction, rANS     section codec 7
hash tables                        a step by how often a row is read, rANS                  section codec 8
decoders (MLPs)                    a step for each output, rANS                             section codec 8

`hyrfpack.compress` decides what is stored and how finely; here what it quantised becomes bytes, and bytes numbers.
"""

from __future__ import annotations

import numpy as np

from hyrfpack.errors import HyrfFormatError
from hyrfpack.format.compact.groups import decode_groups
from hyrfpack.format.compact.plan import from_lattice, groups_of
from hyrfpack.format.compact.quantized import CODEC_CHANNELS, CODEC_GROUPS, CODEC_POINTS, decode_channels, encode
from hyrfpack.format.sections import LOGITS, MLPS, POSITIONS, TABLES
from hyrfpack.model.config import ModelConfig
from hyrfpack.quant.points import Points, decode_points

__all__ = ["CODEC_POINTS", "decode_positions", "decode_section", "encode"]

# The sections that may have a codec.
CODECS = {CODEC_POINTS: (POSITIONS,), CODEC_CHANNELS: LOGITS, CODEC_GROUPS: (*TABLES, *MLPS)}


def decode_positions(data: memoryview, count: int, config: ModelConfig) -> tuple[np.ndarray, Points]:
    """Local positions (count, 3) float32 and the lattice points that the other sections need.

    Raises:
        DamagedDataError: the bytes are damaged.
    """
    points = decode_points(data, count)
    return from_lattice(points, config.frame), points


def decode_section(
    group: str, codec: int, data: memoryview, shape: tuple[int, int], config: ModelConfig, points: Points | None
) -> np.ndarray:
    """The numbers of a section of codec 7 or 8.

    Args:
        points: from `decode_positions`; None when the positions have another codec.

    Raises:
        DamagedDataError: the bytes are damaged.
        HyrfFormatError: the section cannot have this codec, or not beside such positions.
    """
    if group not in CODECS[codec]:
        raise HyrfFormatError(f"it cannot have codec {codec}; the file is damaged, write it again")
    if group in MLPS:
        return decode_groups(data, groups_of(group, config)).reshape(shape)
    if points is None:
        raise HyrfFormatError(f"codec {codec} needs positions of codec {CODEC_POINTS}; write the file again")
    if codec == CODEC_CHANNELS:
        return decode_channels(data, points, shape[1])
    return decode_groups(data, groups_of(group, config, points)).reshape(shape)
