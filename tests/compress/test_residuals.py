"""Residuals are quantised to symbols that a file can hold."""

from __future__ import annotations

import numpy as np
import pytest

from hyrfpack.compress.residuals import quantize_residuals
from hyrfpack.format.compact.residuals import decode_residual_symbols, encode_residuals
from hyrfpack.format.sections import HARMONICS
from hyrfpack.quant.steps import MAX_ABS_SYMBOL


@pytest.mark.parametrize("value", [1e5, -1e5])
def test_residuals_of_too_many_steps_are_clamped_to_what_a_file_holds(value: float) -> None:
    values, classes = np.full((4, 3), value), np.zeros(4, np.uint8)

    residuals = quantize_residuals(HARMONICS, values, classes, np.ones((4, 3)), distortion=1e-8)

    (symbols,) = residuals.symbols
    assert (np.abs(symbols) > 0.99 * MAX_ABS_SYMBOL).all()
    data = encode_residuals(HARMONICS, residuals, classes, np.eye(3, dtype=np.float32))
    (decoded,) = decode_residual_symbols(HARMONICS, memoryview(data), classes, 3)[0].symbols
    np.testing.assert_array_equal(decoded, symbols)
