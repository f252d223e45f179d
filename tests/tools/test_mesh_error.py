"""The error of a mesh counts surfaces that the mesh misses."""

from __future__ import annotations

import re

import numpy as np
import pytest

import hyrfpack
from hyrfpack.demo.scene import write_demo_scene
from hyrfpack.mesh import Mesh
from tools.studies.mesh_error import print_demo_error


def test_a_mesh_that_misses_a_side_has_a_lower_recall(tmp_path, capsys):
    scene = hyrfpack.load_scene(write_demo_scene(tmp_path / "demo", views=8, size=32))

    def measure_recall(left: float) -> float:
        """Return the recall of a piece of the ground from x = `left` to 3."""
        corners = np.array([[left, -3, 0], [3, -3, 0], [3, 3, 0], [left, 3, 0.0]])
        faces = np.array([[0, 1, 2], [0, 2, 3]])
        print_demo_error(Mesh(corners, faces, np.zeros((4, 3), np.uint8), 0.1, 0.3, 1), scene)
        (recall,) = re.findall(r"recall ([\d.]+)", capsys.readouterr().out)
        return float(recall)

    assert measure_recall(0.0) == pytest.approx(measure_recall(-3.0) / 2, rel=0.4)
