"""Made-up splats for tests of formats, and ways to damage their files."""

from __future__ import annotations

import numpy as np
from hypothesis import strategies as st

from hyrfpack.splats.splats import Splats, normalized_quats

# Pieces of bytes that take the place of one, at fractions of a file; and how much of the file is left.
EDITS = st.lists(st.tuples(st.floats(0, 0.999), st.binary(min_size=0, max_size=3)), min_size=1, max_size=4)
LENGTHS = st.sampled_from([1.0, 1.0, 0.9, 0.3])


def made_up(count: int = 40, degree: int = 3, shift=(0.0, 0.0, 0.0)) -> Splats:
    """Random splats about `shift`."""
    rng = np.random.default_rng(count)
    return Splats(
        rng.normal(size=(count, 3)) + shift,
        np.exp(rng.normal(size=(count, 3)) - 3),
        normalized_quats(rng.normal(size=(count, 4))),
        rng.random(count),
        rng.normal(size=(count, (degree + 1) ** 2, 3)) * 0.3,
    )


def damaged(data: bytes, edits: list[tuple[float, bytes]], length: float) -> bytes:
    """A file cut to a fraction of its length, with pieces of it replaced."""
    data = data[: int(length * len(data))]
    for place, piece in edits:
        at = int(place * len(data))
        data = data[:at] + piece + data[at + 1 :]
    return data
