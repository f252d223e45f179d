"""Synthetic splats for tests of formats, and ways to damage their files."""

from __future__ import annotations

import numpy as np
from hypothesis import strategies as st

from hyrfpack.splats.splats import Splats, normalize_quats

# Each edit is a position, as a fraction of the file, and the bytes that replace the byte there.
FILE_EDITS = st.lists(st.tuples(st.floats(0, 0.999), st.binary(min_size=0, max_size=3)), min_size=1, max_size=4)
# The fraction of the file that is kept.
KEPT_FRACTIONS = st.sampled_from([1.0, 1.0, 0.9, 0.3])


def random_splats(count: int = 40, degree: int = 3, shift=(0.0, 0.0, 0.0)) -> Splats:
    """Return random splats around `shift`."""
    rng = np.random.default_rng(count)
    return Splats(
        rng.normal(size=(count, 3)) + shift,
        np.exp(rng.normal(size=(count, 3)) - 3),
        normalize_quats(rng.normal(size=(count, 4))),
        rng.random(count),
        rng.normal(size=(count, (degree + 1) ** 2, 3)) * 0.3,
    )


def damage_file(data: bytes, edits: list[tuple[float, bytes]], length: float) -> bytes:
    """Return the file's bytes cut to a fraction of their length, with the edits applied."""
    data = data[: int(length * len(data))]
    for place, piece in edits:
        at = int(place * len(data))
        data = data[:at] + piece + data[at + 1 :]
    return data
