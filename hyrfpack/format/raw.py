"""Profile `raw`: every number is stored exactly, as float32 (section codec 1)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hyrfpack.errors import HyrfFormatError
from hyrfpack.format.arrays import to_arrays
from hyrfpack.format.container import Section
from hyrfpack.model.hybrid import HybridModel

CODEC_FLOAT32 = 1


def encode(model: HybridModel, groups: Sequence[str] | None = None) -> tuple[list[Section], dict]:
    """Encode a model; return its sections and the settings used (none).

    Args:
        model: the model.
        groups: types of the sections to encode; None for all.

    Raises:
        HyrfError: a parameter is NaN or infinite.
    """
    arrays = to_arrays(model)
    sections = [
        Section(group, CODEC_FLOAT32, arrays[group].astype("<f4").tobytes(), 4 * arrays[group].size)
        for group in (arrays if groups is None else groups)
    ]
    return sections, {}


def decode_plain(data: memoryview, shape: tuple[int, int], dtype: str) -> np.ndarray:
    """Decode numbers that are stored row by row.

    Args:
        data: stored bytes.
        shape: (rows, columns).
        dtype: numpy dtype of the stored numbers.

    Returns:
        (rows, columns) float32.

    Raises:
        HyrfFormatError: the number of bytes does not fit the shape.
    """
    expected = shape[0] * shape[1] * np.dtype(dtype).itemsize
    if len(data) != expected:
        raise HyrfFormatError(
            f"it has {len(data)} bytes and the metadata asks for {expected}",
            fix="the file is damaged, copy or write it again",
        )
    return np.frombuffer(data, dtype).astype(np.float32).reshape(shape)


def _decode_float32(data: memoryview, shape: tuple[int, int]) -> np.ndarray:
    return decode_plain(data, shape, "<f4")


DECODER_BY_CODEC = {CODEC_FLOAT32: _decode_float32}
