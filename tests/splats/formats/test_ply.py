"""PLY of Gaussians: the INRIA layout is written, its variants are read, invalid files are refused."""

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
from hyrfpack.splats.splats import Splats, normalize_quats

PROPERTY_NAMES = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", *(f"scale_{i}" for i in range(3))]
PROPERTY_NAMES += [f"rot_{i}" for i in range(4)]


def make_splats(count: int, degree: int = 3) -> Splats:
    rng = np.random.default_rng(count)
    return Splats(
        rng.normal(0, 5, (count, 3)).astype(np.float32),
        np.exp(rng.normal(-3, 2, (count, 3))),
        normalize_quats(rng.normal(size=(count, 4))),
        rng.uniform(0, 1, count),
        rng.normal(size=(count, (degree + 1) ** 2, 3)),
    )


def build_ply(
    names: list[str], kind: str, rows: bytes, count: int, order: str = "binary_little_endian", before: str = ""
):
    head = [f"property {kind} {name}" for name in names]
    return "\n".join(["ply", f"format {order} 1.0", "comment made by hand", *before.splitlines(),
                      f"element vertex {count}", *head, "end_header\n"]).encode() + rows  # fmt: skip


def test_encode_writes_the_inria_layout():
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


def test_comments_may_contain_any_text():
    data = ply.encode(make_splats(3)).replace(b"1.0\n", "1.0\ncomment a\x0cb\u2028c\x85\n".encode(), 1)
    assert len(ply.decode(data, "a.ply")) == 3


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("count", [0, 1, 500])
def test_splats_round_trip_with_float32_precision(degree, count):
    splats = make_splats(count, degree)
    decoded = ply.decode(ply.encode(splats), "a.ply")
    np.testing.assert_array_equal(decoded.positions, splats.positions)
    np.testing.assert_array_equal(decoded.harmonics, splats.harmonics)
    np.testing.assert_allclose(decoded.quats, splats.quats, atol=1e-7)
    np.testing.assert_allclose(decoded.scales, splats.scales, rtol=1e-6)
    np.testing.assert_allclose(decoded.opacities, splats.opacities, rtol=1e-6)


def test_opacities_0_and_1_and_scale_0_are_stored_finite_and_round_trip():
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
def test_variants_of_the_layout_are_decoded_to_the_same_splats(variant):
    splats = make_splats(7, 1)
    values = np.frombuffer(ply.encode(splats).split(b"end_header\n")[1], "<f4").reshape(7, -1)
    names = [
        *PROPERTY_NAMES[:3],
        "nx",
        "ny",
        "nz",
        *PROPERTY_NAMES[3:6],
        *(f"f_rest_{i}" for i in range(9)),
        *PROPERTY_NAMES[6:],
    ]
    if variant == "order":
        turn = np.random.default_rng(0).permutation(len(names))
        data = build_ply([names[i] for i in turn], "float32", np.ascontiguousarray(values[:, turn]).tobytes(), 7)
    elif variant == "double":
        data = build_ply(names, "double", values.astype("<f8").tobytes(), 7)
    elif variant == "big":
        data = build_ply(names, "float", values.astype(">f4").tobytes(), 7, "binary_big_endian")
    elif variant == "text":
        text = "\n".join(" ".join(f"{v:.9g}" for v in row) for row in values) + "\n\n"
        data = build_ply(
            names, "float", b"1 2 3\n" + text.encode(), 7, "ascii", "element face 1\nproperty list int int f"
        )
    elif variant == "mixed":
        rows = b"".join(row.tobytes() + b"\x07\x00\x00" for row in values)
        data = build_ply(names, "float", rows, 7).replace(
            b"end_header", b"property uchar a\nproperty short b\nend_header"
        )
    else:
        before = "element camera 2\nproperty float f\nproperty uchar g"
        data = build_ply(names, "float", bytes(10) + values.tobytes() + bytes(8), 7, before=before)
        data = data.replace(b"end_header", b"element face 1\nproperty list uchar int vertex_indices\nend_header")
    if variant == "big":
        data = re.sub(rb"(?<!\x00)\n", b"\r\n", data[: data.index(b"end_header")]) + data[data.index(b"end_header") :]

    decoded = ply.decode(data, "a.ply")

    for name in ("positions", "scales", "opacities", "harmonics"):
        np.testing.assert_allclose(getattr(decoded, name), getattr(splats, name), rtol=1e-6, err_msg=name)
    np.testing.assert_allclose(decoded.quats, splats.quats, atol=1e-6)


def test_double_positions_keep_their_precision():
    row = np.array([[4e6 + 1 / 3, 0, 0, *[0] * 10, 1.0]])
    decoded = ply.decode(build_ply(PROPERTY_NAMES, "double", row.tobytes(), 1), "a.ply")
    assert decoded.positions[0, 0] == 4e6 + 1 / 3


def test_infinite_logits_and_logarithms_are_limits_and_quaternions_are_normalized():
    row = np.float32([[0] * 6 + [np.inf, -np.inf, 0, 0, 3, 0, 4, 0], [0] * 6 + [-np.inf, 0, 0, 0, 0, 0, 0, 0]])
    decoded = ply.decode(build_ply(PROPERTY_NAMES, "float", row.tobytes(), 2), "a.ply")
    np.testing.assert_array_equal(decoded.opacities, [1, 0])
    assert decoded.scales[0, 0] == 0
    np.testing.assert_allclose(decoded.quats, [[0.6, 0, 0.8, 0], [1, 0, 0, 0]], rtol=1e-6)


def test_harmonics_of_degree_4_are_ignored():
    names = [*PROPERTY_NAMES, *(f"f_rest_{i}" for i in range(72))]
    row = np.float32([[*[0] * 10, 1, 0, 0, 0, *range(72)]])
    decoded = ply.decode(build_ply(names, "float", row.tobytes(), 1), "a.ply")
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


VALID_ROW = np.float32([[*[0] * 10, 1, 0, 0, 0]])
VALID_FILE = build_ply(PROPERTY_NAMES, "float", VALID_ROW.tobytes(), 1)


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"", "this is not a PLY file"),
        (b"solid cube", "this is not a PLY file"),
        (b"ply\nformat ascii 1.0\n", "header has no end"),
        (build_ply(["x", "y", "z"], "float", bytes(12), 1), r"because its vertices have no f_dc_0, .* and 7"),
        (build_ply([*PROPERTY_NAMES[:-1], "w"], "float", VALID_ROW.tobytes(), 1), "have no rot_3;"),
        (VALID_FILE.replace(b"vertex", b"points"), "have no x, y, z, f_dc_0 and 10 more"),
        (VALID_FILE[:-1], "file ends before the 1 rows of its element 'vertex'"),
        (VALID_FILE.replace(b"vertex 1\n", b"vertex 999999999999999\n"), "before the 999,999,999,999,999 rows"),
        (VALID_FILE.replace(b"vertex 1\n", b"vertex -1\n"), "line 'element vertex -1' of its PLY header"),
        (VALID_FILE.replace(b"float z", b"float y"), "line 'property float y'"),
        (VALID_FILE.replace(b"float z", b"quad z"), "line 'property quad z'"),
        (VALID_FILE.replace(b"format binary_little_endian 1.0\n", b""), "in which format"),
        (build_ply([*PROPERTY_NAMES, "f_rest_0"], "float", bytes(60), 1), "1 properties f_rest_, but a degree"),
        (
            build_ply([*PROPERTY_NAMES, *(f"f_rest_{i}" for i in range(1, 10))], "float", bytes(99), 1),
            "9 properties f_rest_",
        ),
        (VALID_FILE.replace(b"float z", b"list uchar int z"), "have no z"),
        (
            build_ply(PROPERTY_NAMES, "float", VALID_ROW.tobytes(), 1, before="element f 1\nproperty list int int i"),
            "that are lists",
        ),
        (build_ply(PROPERTY_NAMES, "float", b"1 2 3\n", 1, "ascii"), "is 3, and the header says 14"),
        (
            build_ply(PROPERTY_NAMES, "float", b"1 " * 14 + b"\n1 2\n", 2, "ascii"),
            "is 2, and the header says 14",
        ),
        (build_ply(PROPERTY_NAMES, "float", b"1 " * 13 + b"three\n", 1, "ascii"), "not made of numbers"),
        (build_ply(PROPERTY_NAMES, "float", b"\n \n", 1, "ascii"), "ends before the 1 rows"),
        (
            build_ply(PROPERTY_NAMES, "float", np.float32(np.nan).tobytes() * 14, 1),
            "position of Gaussian 0 of 1 is not a finite",
        ),
        (
            build_ply(PROPERTY_NAMES, "float", np.float32([[*[0] * 7, 1e3, *[0] * 6]]).tobytes(), 1),
            "the scale of Gaussian 0",
        ),
        (
            build_ply(PROPERTY_NAMES, "double", np.array([[0] * 3 + [1e300] + [0] * 10], float).tobytes(), 1),
            "the colour of",
        ),
    ],
)
def test_invalid_files_are_refused_with_the_reason(data, words):
    with pytest.raises(HyrfDataError, match=words) as error:
        ply.decode(data, "some.ply")
    assert str(error.value).startswith("some.ply: ")


@settings(max_examples=50, derandomize=True, database=None)
@given(
    text=st.booleans(),
    edits=FILE_EDITS,
    length=KEPT_FRACTIONS,
)
def test_damaged_files_are_decoded_or_refused(text, edits, length):
    data = ply.encode(make_splats(5, 0))
    if text:
        values = np.frombuffer(data.split(b"end_header\n")[1], "<f4").reshape(5, -1)
        names = ["x", "y", "z", "nx", "ny", "nz", *PROPERTY_NAMES[3:]]
        data = build_ply(names, "float", "\n".join(" ".join(map(str, row)) for row in values).encode(), 5, "ascii")
    try:
        splats = ply.decode(damage_file(data, edits, length), "a.ply")
    except HyrfDataError as error:
        assert str(error).startswith("a.ply: ")
    else:
        assert np.isfinite(splats.positions).all()
