"""Hypothesis strategies for cameras."""

from __future__ import annotations

import numpy as np
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from hyrfpack.scene import Camera

lengths = st.floats(1e-3, 1e6)
places = st.floats(-1e7, 1e7)


@st.composite
def cameras(draw) -> Camera:
    """Draw a camera of any size, lens and pose."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec(draw(st.tuples(*3 * [st.floats(-4, 4)]))).as_matrix()
    pose[:3, 3] = draw(st.tuples(places, places, places))
    sides = st.integers(1, 16384)
    return Camera(draw(sides), draw(sides), draw(lengths), draw(lengths), draw(places), draw(places), pose)
