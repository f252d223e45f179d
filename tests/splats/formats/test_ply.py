"""PLY of Gaussians: the layout other programs expect, their own variants of it, and what hostile files meet."""

from __future__ import annotations

import re
import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_up_splats import FILE_EDITS, KEPT_FRACTIONS, damage_file

from hyrfpack.errors import HyrfDataError
from hyrfpack.splats.formats import ply
from hyrfpack.splats.splats import Splats, normalized_quats

NAMES = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", *(f"scale_{i}" for i in range(3))]
NAMES += [f"rot_{i}" for i in range(4)]


def make_splats(count: int, degree: int = 3) -> Splats:
    rng = np.random.default_rng(count)
    return Splats(
        rng.normal(0, 5, (count, 3)).astype(np.float32),
        np.exp(rng.normal(-3, 2, (count, 3))),
        normalized_quats(rng.normal(size=(count, 4))),
        rng.uniform(0, 1, count),
        rng.normal(size=(count, (degree + 1) ** 2, 3)),
    )


def file_of(
    names: list[str], kind: str, rows: bytes, count: int, order: str = "binary_little_endian", before: str = ""
):
    head = [f"property {kind} {name}" for name in names]
    return "\n".join(["ply", f"format {order} 1.0", "comment made by hand", *before.splitlines(),
                      f"element vertex {count}", *head, "end_header\n"]).encode() + rows  # fmt: skip


def test_encode_writes_the_layout_that_programs_expect():
    splats = Splats(
        np.array([[1.0, 2, 3]]), np.exp([[-1.0, 0, 1]]), np.array([[0.5, 0.5, -0.5, 0.5]]), np.array([0.75]),
        np.arange(48.0).reshape(1, 16, 3),
    )  # fmt: skip
    header, rows = ply.encode(splats).split(b"end_header\n")

    names = ["x", "y", "z", "nx", "ny", "nz", *(f"f_dc_{i}" for i in range(3)), *(f"f_rest_{i}" for i in range(45))]
    names += ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    lines = ["ply", "format binary_little_endian 1.0", "element vertex 1", *(f"property float {n}" for n in names)]
    assert header.decode().splitlines() == lines
    rest = [3 * term + channel for channel in range(3) for term in range(1, 16)]
    expected = [1, 2, 3, 0, 0, 0, 0, 1, 2, *rest, np.log(3), -1, 0, 1, 0.5, 0.5, -0.5, 0.5]
    np.testing.assert_allclose(struct.unpack("<62f", rows), expected, rtol=1e-6, atol=1e-7)


def test_comments_hold_anything():
    data = ply.encode(make_splats(3)).replace(b"1.0\n", "1.0\ncomment a\x0cb\u2028c\x85\n".encode(), 1)
    assert len(ply.decode(data, "a.ply")) == 3


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("count", [0, 1, 500])
def test_everything_comes_back_to_the_precision_of_float32(degree, count):
    splats = make_splats(count, degree)
    decoded = ply.decode(ply.encode(splats), "a.ply")
    np.testing.assert_array_equal(decoded.positions, splats.positions)
    np.testing.assert_array_equal(decoded.harmonics, splats.harmonics)
    np.testing.assert_allclose(decoded.quats, splats.quats, atol=1e-7)
    np.testing.assert_allclose(decoded.scales, splats.scales, rtol=1e-6)
    np.testing.assert_allclose(decoded.opacities, splats.opacities, rtol=1e-6)


def test_opacities_0_and_1_and_scale_0_are_finite_in_the_file_and_come_back():
    splats = Splats(np.zeros((4, 3)), np.array([[0, 1e-45, 3e38]] * 4), np.tile([1.0, 0, 0, 0], (4, 1)),
                    np.float32([0, 1, 1e-45, 1 - 2**-24]), np.zeros((4, 1, 3)))  # fmt: skip
    data = ply.encode(splats)
    assert np.isfinite(np.frombuffer(data.split(b"end_header\n")[1], "<f4")).all()
    decoded = ply.decode(data, "a.ply")
    np.testing.assert_array_equal(decoded.opacities, splats.opacities)
    np.testing.assert_allclose(decoded.scales, splats.scales, rtol=1e-5)


def test_positions_beyond_float32_are_refused():
    splats = make_splats(2)
    splats.positions[1, 2] = -1e39
    with pytest.raises(HyrfDataError, match="farther from the origin"):
        ply.encode(splats)


@pytest.mark.parametrize("variant", ["order", "double", "big", "text", "mixed", "elements"])
def test_variants_of_the_layout_mean_the_same(variant):
    splats = make_splats(7, 1)
    values = np.frombuffer(ply.encode(splats).split(b"end_header\n")[1], "<f4").reshape(7, -1)
    names = [*NAMES[:3], "nx", "ny", "nz", *NAMES[3:6], *(f"f_rest_{i}" for i in range(9)), *NAMES[6:]]
    if variant == "order":
        turn = np.random.default_rng(0).permutation(len(names))
        data = file_of([names[i] for i in turn], "float32", np.ascontiguousarray(values[:, turn]).tobytes(), 7)
    elif variant == "double":
        data = file_of(names, "double", values.astype("<f8").tobytes(), 7)
    elif variant == "big":
        data = file_of(names, "float", values.astype(">f4").tobytes(), 7, "binary_big_endian")
    elif variant == "text":
        text = "\n".join(" ".join(f"{v:.9g}" for v in row) for row in values) + "\n\n"
        data = file_of(
            names, "float", b"1 2 3\n" + text.encode(), 7, "ascii", "element face 1\nproperty list int int f"
        )
    elif variant == "mixed":
        rows = b"".join(row.tobytes() + b"\x07\x00\x00" for row in values)
        data = file_of(names, "float", rows, 7).replace(
            b"end_header", b"property uchar a\nproperty short b\nend_header"
        )
    else:
        before = "element camera 2\nproperty float f\nproperty uchar g"
        data = file_of(names, "float", bytes(10) + values.tobytes() + bytes(8), 7, before=before)
        data = data.replace(b"end_header", b"element face 1\nproperty list uchar int vertex_indices\nend_header")
    if variant == "big":
        data = re.sub(rb"(?<!\x00)\n", b"\r\n", data[: data.index(b"end_header")]) + data[data.index(b"end_header") :]

    decoded = ply.decode(data, "a.ply")

    for name in ("positions", "scales", "opacities", "harmonics"):
        np.testing.assert_allclose(getattr(decoded, name), getattr(splats, name), rtol=1e-6, err_msg=name)
    np.testing.assert_allclose(decoded.quats, splats.quats, atol=1e-6)


def test_positions_in_double_keep_their_digits():
    row = np.array([[4e6 + 1 / 3, 0, 0, *[0] * 10, 1.0]])
    decoded = ply.decode(file_of(NAMES, "double", row.tobytes(), 1), "a.ply")
    assert decoded.positions[0, 0] == 4e6 + 1 / 3


def test_infinite_logits_and_logarithms_are_0_and_1_and_quaternions_become_unit():
    row = np.float32([[0] * 6 + [np.inf, -np.inf, 0, 0, 3, 0, 4, 0], [0] * 6 + [-np.inf, 0, 0, 0, 0, 0, 0, 0]])
    decoded = ply.decode(file_of(NAMES, "float", row.tobytes(), 2), "a.ply")
    np.testing.assert_array_equal(decoded.opacities, [1, 0])
    assert decoded.scales[0, 0] == 0
    np.testing.assert_allclose(decoded.quats, [[0.6, 0, 0.8, 0], [1, 0, 0, 0]], rtol=1e-6)


def test_harmonics_of_degree_4_are_left_out():
    names = [*NAMES, *(f"f_rest_{i}" for i in range(72))]
    row = np.float32([[*[0] * 10, 1, 0, 0, 0, *range(72)]])
    decoded = ply.decode(file_of(names, "float", row.tobytes(), 1), "a.ply")
    np.testing.assert_array_equal(decoded.harmonics[0, 1:], np.arange(72).reshape(3, 24).T[:15])


@pytest.mark.parametrize(
    ("file", "count", "degree"), [("inria_sh3_small.ply", 9080, 3), ("playbot_lod3_sh2.ply", 31_000, 2)]
)
def test_files_of_other_programs_are_read(shared_data, file, count, degree):
    data = (shared_data / "trained_models" / file).read_bytes()
    splats = ply.decode(data, file)
    assert len(splats) == count and splats.degree == degree
    body = np.frombuffer(data[data.index(b"end_header\n") + 11 :], "<f4").reshape(count, -1)
    np.testing.assert_array_equal(splats.positions, body[:, :3])
    again = ply.decode(ply.encode(splats), file)
    np.testing.assert_allclose(again.scales, splats.scales, rtol=1e-6)
    np.testing.assert_array_equal(again.harmonics, splats.harmonics)


ROW = np.float32([[*[0] * 10, 1, 0, 0, 0]])
GOOD = file_of(NAMES, "float", ROW.tobytes(), 1)


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"", "this is not a PLY file"),
        (b"solid cube", "this is not a PLY file"),
        (b"ply\nformat ascii 1.0\n", "header has no end"),
        (file_of(["x", "y", "z"], "float", bytes(12), 1), r"because its vertices have no f_dc_0, .* and 7"),
        (file_of([*NAMES[:-1], "w"], "float", ROW.tobytes(), 1), "have no rot_3;"),
        (GOOD.replace(b"vertex", b"points"), "have no x, y, z, f_dc_0 and 10 more"),
        (GOOD[:-1], "file ends before the 1 rows of its element 'vertex'"),
        (GOOD.replace(b"vertex 1\n", b"vertex 999999999999999\n"), "before the 999,999,999,999,999 rows"),
        (GOOD.replace(b"vertex 1\n", b"vertex -1\n"), "line 'element vertex -1' of its PLY header"),
        (GOOD.replace(b"float z", b"float y"), "line 'property float y'"),
        (GOOD.replace(b"float z", b"quad z"), "line 'property quad z'"),
        (GOOD.replace(b"format binary_little_endian 1.0\n", b""), "in which format"),
        (file_of([*NAMES, "f_rest_0"], "float", bytes(60), 1), "1 properties f_rest_, but a degree"),
        (file_of([*NAMES, *(f"f_rest_{i}" for i in range(1, 10))], "float", bytes(99), 1), "9 properties f_rest_"),
        (GOOD.replace(b"float z", b"list uchar int z"), "have no z"),
        (file_of(NAMES, "float", ROW.tobytes(), 1, before="element f 1\nproperty list int int i"), "that are lists"),
        (file_of(NAMES, "float", b"1 2 3\n", 1, "ascii"), "have 3 numbers, and the header says 14"),
        (file_of(NAMES, "float", b"1 2 three\n", 1, "ascii"), "not made of numbers"),
        (file_of(NAMES, "float", b"\n \n", 1, "ascii"), "ends before the 1 rows"),
        (file_of(NAMES, "float", np.float32(np.nan).tobytes() * 14, 1), "position of Gaussian 0 of 1 is not a finite"),
        (file_of(NAMES, "float", np.float32([[*[0] * 7, 1e3, *[0] * 6]]).tobytes(), 1), "the scale of Gaussian 0"),
        (file_of(NAMES, "double", np.array([[0] * 3 + [1e300] + [0] * 10], float).tobytes(), 1), "the colour of"),
    ],
)  # fmt: skip
def test_read_ply_refuses_with_a_sentence(data, words):
    with pytest.raises(HyrfDataError, match=words) as error:
        ply.decode(data, "some.ply")
    assert str(error.value).startswith("some.ply: ")


@settings(max_examples=50, deadline=None, derandomize=True, database=None)
@given(
    text=st.booleans(),
    edits=FILE_EDITS,
    length=KEPT_FRACTIONS,
)
def test_damaged_files_become_splats_or_a_sentence(text, edits, length):
    data = ply.encode(make_splats(5, 0))
    if text:
        values = np.frombuffer(data.split(b"end_header\n")[1], "<f4").reshape(5, -1)
        names = ["x", "y", "z", "nx", "ny", "nz", *NAMES[3:]]
        data = file_of(names, "float", "\n".join(" ".join(map(str, row)) for row in values).encode(), 5, "ascii")
    try:
        splats = ply.decode(damage_file(data, edits, length), "a.ply")
    except HyrfDataError as error:
        assert str(error).startswith("a.ply: ")
    else:
        assert np.isfinite(splats.positions).all()
