from __future__ import annotations

import math

import pytest

from hyrfpack.bench.rows import format_value


@pytest.mark.parametrize(
    ("value", "words"),
    [
        (0.0, "0"),
        (0.3, "0.3"),
        (1 / 255, "1/255"),
        (1 / 512, "1/512"),
        (1e-4, "0.0001"),
        (1e-3, "0.001"),
        (1e-5, "1e-05"),
        (math.inf, "none"),
        (2, "2"),
        ((2, 128), "2 x 128"),
        ("raw", "raw"),
    ],
)
def test_values_are_formatted_for_reading(value, words):
    assert format_value(value) == words
