"""Profile `paper`: exactly the compression that the HyRF paper describes (section 3.4).

positions                          half precision                                       section codec 2
decoders (MLPs)                    half precision                                       section codec 2
colour, scale, opacity logits      residual vector quantisation, Huffman                section codec 3
hash tables                        8 bits between the table's extremes, Huffman         section codec 4
"""

from __future__ import annotations

import struct
from dataclasses import asdict
from typing import Any

import numpy as np
import torch

from hyrfpack.config.compress import MAX_VQ_STAGES, PaperSettings
from hyrfpack.errors import HyrfError, HyrfFormatError, needs_package
from hyrfpack.format import sections
from hyrfpack.format.arrays import to_arrays
from hyrfpack.format.container import Section
from hyrfpack.format.raw import decode_plain
from hyrfpack.model.gaussians import LOGIT_LIMIT
from hyrfpack.model.hybrid import HybridModel
from hyrfpack.quant import (
    HuffmanStream,
    MinMaxParams,
    MinMaxQuantizer,
    ResidualVectorQuantizer,
    huffman_decode,
    huffman_encode,
)

CODEC_FLOAT16 = 2
CODEC_RESIDUAL_VQ = 3
CODEC_MIN_MAX = 4
FLOAT16_MAX = 65504.0
TABLE_CODE_BITS = 8

_VQ_HEADER_STRUCT = struct.Struct("<BBH")  # stages, columns, codewords per stage
_STREAM_LENGTH_STRUCT = struct.Struct("<Q")


def encode(model: HybridModel, **settings: Any) -> tuple[list[Section], dict]:
    """Encode a model; return its sections and the settings used. Gaussians keep their order.

    Args:
        model: the model to encode.
        settings: fields of `PaperSettings`.

    Raises:
        HyrfError: a parameter is NaN or infinite; a position, logit or decoder weight exceeds the range of half
            precision; a setting is out of range; or dahuffman is not installed.
    """
    paper_settings = PaperSettings(**settings)
    with needs_package("profile 'paper'"):
        import dahuffman  # noqa: F401 - builds the Huffman codes; imported here to fail early if it is missing
    arrays = to_arrays(model)
    # Halves are encoded first. They reject values that would overflow the geometry field, whose outputs are needed to
    # clip the opacity logits below.
    halves = {
        group: _encode_float16(group, arrays[group])
        for group in (sections.POSITIONS, *sections.DECODER_SECTIONS, *sections.RESIDUAL_SECTIONS)
        if group in arrays
    }
    arrays[sections.OPACITIES] = _clip_opacity_logits(model, arrays[sections.OPACITIES])
    return [
        halves[sections.POSITIONS],
        _encode_residual_vq(sections.COLORS, arrays[sections.COLORS], paper_settings.color, paper_settings.seed),
        _encode_residual_vq(sections.SCALES, arrays[sections.SCALES], paper_settings.scale, paper_settings.seed),
        _encode_residual_vq(
            sections.OPACITIES, arrays[sections.OPACITIES], paper_settings.opacity, paper_settings.seed
        ),
        _encode_min_max(sections.GEOMETRY_TABLE, arrays[sections.GEOMETRY_TABLE]),
        halves[sections.GEOMETRY_DECODER],
        _encode_min_max(sections.RADIANCE_TABLE, arrays[sections.RADIANCE_TABLE]),
        halves[sections.RADIANCE_DECODER],
        *(halves[group] for group in sections.RESIDUAL_SECTIONS if group in halves),
    ], asdict(paper_settings)


@torch.no_grad()
def _clip_opacity_logits(model: HybridModel, opacity_logits: np.ndarray) -> np.ndarray:
    """Clip opacity logits (N, 1) where opacity no longer changes, so that no codewords go to invisible differences.

    The sum of the explicit logit and the field's output is clipped to +-LOGIT_LIMIT, within 7e-6 of opacity 0 and 1.
    """
    neural = model.geometry(model.cube_coords(model.gaussians.positions))[:, :1].cpu().numpy()
    if not np.isfinite(neural).all():
        raise HyrfError(
            "the model's geometry field gives opacities that are NaN or infinite",
            fix="train it again with lower learning rates",
        )
    return np.clip(opacity_logits, -LOGIT_LIMIT - neural, LOGIT_LIMIT - neural)


def _check_half_range(tag: str, values: np.ndarray) -> None:
    """Raise HyrfError if a value exceeds the range of half precision."""
    largest = np.abs(values).max(initial=0)
    if largest > FLOAT16_MAX:
        raise HyrfError(
            f"numbers in the model's {sections.SECTION_CONTENTS[tag]} reach {largest:.6g} and half precision ends at "
            f"{FLOAT16_MAX:.0f}",
            fix="keep this model as profile raw, or train it again without such outliers",
        )


def _encode_float16(tag: str, values: np.ndarray) -> Section:
    _check_half_range(tag, values)
    return Section(tag, CODEC_FLOAT16, values.astype("<f2").tobytes(), 4 * values.size)


def _decode_float16(data: memoryview, shape: tuple[int, int]) -> np.ndarray:
    return decode_plain(data, shape, "<f2")


def _encode_min_max(tag: str, values: np.ndarray) -> Section:
    codes, params = MinMaxQuantizer(TABLE_CODE_BITS).encode(values)
    data = params.to_bytes() + huffman_encode(codes.ravel()).to_bytes()
    return Section(tag, CODEC_MIN_MAX, data, 4 * values.size)


def _decode_min_max(data: memoryview, shape: tuple[int, int]) -> np.ndarray:
    params = MinMaxParams.from_bytes(bytes(data[:9]))
    codes = _decode_huffman(data[9:], shape[0] * shape[1])
    return MinMaxQuantizer.decode(codes, params).reshape(shape)


def _encode_residual_vq(tag: str, values: np.ndarray, codebook_counts: tuple[int, int], seed: int) -> Section:
    """Encode values with `codebook_counts`: the number of stages, and of codewords in each stage."""
    _check_half_range(tag, values)
    stages, size = codebook_counts
    quantizer = ResidualVectorQuantizer(stages, size, codebook_dtype="float16", seed=seed)
    indices, codebooks = quantizer.encode(values)
    parts = [_VQ_HEADER_STRUCT.pack(stages, values.shape[1], size), codebooks.astype("<f2").tobytes()]
    for stage in indices.T:
        stream = huffman_encode(np.ascontiguousarray(stage)).to_bytes()
        parts += [_STREAM_LENGTH_STRUCT.pack(len(stream)), stream]
    return Section(tag, CODEC_RESIDUAL_VQ, b"".join(parts), 4 * values.size)


def _decode_residual_vq(data: memoryview, shape: tuple[int, int]) -> np.ndarray:
    if len(data) < _VQ_HEADER_STRUCT.size:
        raise HyrfFormatError(
            f"it has {len(data)} bytes, fewer than the header of a residual quantiser",
            fix="the file is damaged, copy or write it again",
        )
    stages, columns, size = _VQ_HEADER_STRUCT.unpack_from(data)
    position = _VQ_HEADER_STRUCT.size + 2 * stages * size * columns
    if not (1 <= stages <= MAX_VQ_STAGES and size) or columns != shape[1] or position > len(data):
        raise HyrfFormatError(
            f"it declares {stages} codebooks of {size} codewords of {columns} numbers, which do not fit its size",
            fix="the file is damaged, copy or write it again",
        )
    codebooks = np.frombuffer(data[_VQ_HEADER_STRUCT.size : position], "<f2").reshape(stages, size, columns)
    if not np.isfinite(codebooks).all():
        raise HyrfFormatError(
            "its codebooks hold numbers that are not finite",
            fix="the file is damaged, copy or write it again",
        )
    decoded = np.zeros(shape, np.float32)
    for stage in range(stages):
        start = position + _STREAM_LENGTH_STRUCT.size
        position = start + (_STREAM_LENGTH_STRUCT.unpack_from(data, position)[0] if start <= len(data) else 0)
        if not start <= position <= len(data):
            raise HyrfFormatError(
                f"it ends within stage {stage} of {stages}",
                fix="the file is damaged, copy or write it again",
            )
        indices = _decode_huffman(data[start:position], shape[0])
        decoded += ResidualVectorQuantizer.decode(indices[:, None], codebooks[stage : stage + 1])
    if position != len(data):
        raise HyrfFormatError(
            f"{len(data) - position} bytes follow its last stage",
            fix="the file is damaged, copy or write it again",
        )
    return decoded


def _decode_huffman(data: memoryview, count: int) -> np.ndarray:
    stream = HuffmanStream.from_bytes(bytes(data))
    if stream.count != count:
        raise HyrfFormatError(
            f"it codes {stream.count} symbols and the metadata asks for {count}",
            fix="the file is damaged, copy or write it again",
        )
    return huffman_decode(stream)


DECODER_BY_CODEC = {
    CODEC_FLOAT16: _decode_float16,
    CODEC_RESIDUAL_VQ: _decode_residual_vq,
    CODEC_MIN_MAX: _decode_min_max,
}
