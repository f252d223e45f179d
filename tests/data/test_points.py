"""Points with colours from PLY files; the expected numbers are written by hand."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from hyrfpack.data.points import read_ply_points
from hyrfpack.errors import HyrfDataError

POINT_ROWS = [[1.0, -2.5, 3.0], [0.0, 1e3, -4.0]]


def ply_file(path: Path, kind: str, full: float, order: str = "<", faces: bool = False) -> Path:
    """Write a PLY file of two points with colours of full, half and no intensity, as other programs do."""
    name = {"<": "binary_little_endian", ">": "binary_big_endian", "": "ascii"}[order]
    header = ["ply", f"format {name} 1.0", "comment by hand", "element vertex 2"]
    header += [f"property float {axis}" for axis in ("x", "y", "z", "nx")]
    header += [f"property {kind} {color}" for color in ("red", "green", "blue")]
    header += ["element face 1", "property list uchar int vertex_indices"] if faces else []
    colors = [[full, full // 2 if full > 1 else 0.5, 0], [0, 0, 0]]
    types = {"uchar": "u1", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4", "double": "f8"}
    layout = np.dtype([("p", order + "f4", 4), ("c", (order or "=") + types[kind], 3)])
    rows = np.array([((*p, 7), tuple(c)) for p, c in zip(POINT_ROWS, colors, strict=True)], layout)
    if order:
        data = rows.tobytes() + (b"\x03" + bytes(12) if faces else b"")
    else:
        lines = [" ".join(map(str, (*p, 7, *c))) for p, c in zip(POINT_ROWS, colors, strict=True)]
        data = "\n".join([*lines, *(["3 0 1 1"] if faces else []), ""]).encode()
    path.write_bytes("\n".join([*header, "end_header", ""]).encode() + data)
    return path


@pytest.mark.parametrize("faces", [False, True])
@pytest.mark.parametrize("order", ["<", ">", ""])
@pytest.mark.parametrize(
    ("kind", "full", "half"), [("uchar", 255, 127 / 255), ("ushort", 65535, 32767 / 65535), ("float", 1.0, 0.5)]
)
def test_written_points_and_colours_are_read_back(tmp_path, kind, full, half, order, faces):
    points, colors = read_ply_points(ply_file(tmp_path / "a.ply", kind, full, order, faces))

    np.testing.assert_array_equal(points, POINT_ROWS)
    np.testing.assert_allclose(colors, [[1, half, 0], [0, 0, 0]], rtol=0, atol=1e-7)
    assert points.dtype == colors.dtype == np.float64


@pytest.mark.parametrize("order", ["<", ""])
@pytest.mark.parametrize("kind", ["float", "double", "int", "uint"])
def test_colours_from_0_to_255_in_a_wide_type_are_scaled(tmp_path, kind, order):
    _, colors = read_ply_points(ply_file(tmp_path / "a.ply", kind, 255, order))

    np.testing.assert_allclose(colors, [[1, 127 / 255, 0], [0, 0, 0]], rtol=0, atol=1e-7)


@pytest.mark.parametrize("full", [1.5, 1000.0])
def test_floating_point_colours_of_another_range_are_clipped(tmp_path, full):
    _, colors = read_ply_points(ply_file(tmp_path / "a.ply", "float", full))

    assert colors[0, 0] == 1


def test_a_colour_that_is_not_finite_does_not_change_the_scale(tmp_path):
    header = "ply\nformat ascii 1.0\nelement vertex 2\n"
    header += "".join(f"property float {label}\n" for label in ("x", "y", "z", "red", "green", "blue"))
    (tmp_path / "a.ply").write_text(f"{header}end_header\n0 0 0 255 51 nan\n0 0 0 inf 0 102\n")

    np.testing.assert_allclose(read_ply_points(tmp_path / "a.ply")[1], [[1, 0.2, 0], [1, 0, 0.4]])


def test_trimesh_is_not_needed(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "trimesh", None)
    assert len(read_ply_points(ply_file(tmp_path / "a.ply", "uchar", 255))[0]) == 2


@pytest.mark.parametrize("properties", ["", "property float x\nproperty float y\n"])
def test_a_file_without_points_is_rejected_by_name(tmp_path, properties):
    (tmp_path / "a.ply").write_text(f"ply\nformat ascii 1.0\nelement vertex 0\n{properties}end_header\n")
    with pytest.raises(HyrfDataError, match="a.ply: the file has no points"):
        read_ply_points(tmp_path / "a.ply")


def test_a_file_that_cannot_be_opened_is_rejected_by_name(tmp_path):
    with pytest.raises(HyrfDataError, match="a.ply: the points cannot be read"):
        read_ply_points(tmp_path / "a.ply")
