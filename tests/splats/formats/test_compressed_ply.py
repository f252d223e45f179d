"""Compressed PLY: hand-packed records and a real file are decoded, invalid files are refused."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from made_up_splats import FILE_EDITS, KEPT_FRACTIONS, damage_file

from hyrfpack.errors import HyrfDataError
from hyrfpack.splats.formats import compressed_ply, ply

POSITION_AXES, SCALE_NAMES, COLOR_CHANNELS = ("x", "y", "z"), ("scale_x", "scale_y", "scale_z"), ("r", "g", "b")
BAND_0_VALUE = 0.5 / np.sqrt(np.pi)


def build_compressed_ply(
    count: int, words: list[int], colored: bool = False, rest: int = 0, chunks: int | None = None
) -> bytes:
    """Build a file of `count` equal Gaussians; chunk k spans x, y, z from k to (k + 1, k + 2, k + 4)."""
    chunks = -(-count // 256) if chunks is None else chunks
    parts = (POSITION_AXES, SCALE_NAMES, COLOR_CHANNELS) if colored else (POSITION_AXES, SCALE_NAMES)
    names = [f"{end}_{part}" for group in parts for end in ("min", "max") for part in group]
    bounds = [[k, k, k, k + 1, k + 2, k + 4, -4, -3, -2, 0, 1, 2, *([0.25, 0, 0, 0.5, 2, 1] if colored else [])]
              for k in range(chunks)]  # fmt: skip
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        f"element chunk {chunks}",
        *(f"property float {n}" for n in names),
    ]
    lines += [f"element vertex {count}"]
    lines += [f"property uint packed_{part}" for part in ("position", "rotation", "scale", "color")]
    if rest:
        lines += [f"element sh {count}", *(f"property uchar f_rest_{i}" for i in range(rest))]
    data = "\n".join([*lines, "end_header\n"]).encode()
    data += np.array(bounds, "<f4").tobytes() + np.array(words * count, "<u4").tobytes()
    return data + bytes(range(rest)) * count


# The words hold position (2047, 0, 1024) / 2047; a quaternion whose largest component is w and whose x, y, z are 1023,
# 0, 512; scale 0, 1023, 0; RGB 255, 51, 0; opacity 102.
PACKED_WORDS = [2047 << 21 | 1024, 1023 << 20 | 512, 1023 << 11, 255 << 24 | 51 << 16 | 102]


@pytest.mark.parametrize("colored", [False, True])
def test_hand_packed_records_are_decoded(colored):
    splats = compressed_ply.decode(build_compressed_ply(300, PACKED_WORDS, colored, rest=9), "a.ply")

    part = 4 * 1024 / 2047
    np.testing.assert_allclose(splats.positions[[0, 255]], [[1, 0, part]] * 2, rtol=1e-12)
    np.testing.assert_allclose(splats.positions[256], [2, 1, 1 + part], rtol=1e-12)  # lies in the second chunk
    np.testing.assert_allclose(splats.scales[0], np.exp([-4, 1, -2]), rtol=1e-6)
    np.testing.assert_allclose(splats.quats[0], [0, 0.5**0.5, -(0.5**0.5), (512 / 1023 - 0.5) * 2**0.5], atol=1e-3)
    np.testing.assert_allclose(splats.opacities, 0.4, rtol=1e-6)
    color = np.array([0.5, 2 * 0.2, 0]) if colored else np.array([1, 0.2, 0])
    np.testing.assert_allclose(splats.harmonics[0, 0], (color - 0.5) / BAND_0_VALUE, rtol=1e-5)
    codes = np.arange(9).reshape(3, 3).T  # the codes are stored channel by channel
    np.testing.assert_allclose(splats.harmonics[5, 1:], np.where(codes == 0, -4, (codes + 0.5) / 32 - 4), rtol=1e-6)


@pytest.mark.parametrize("largest", [0, 1, 2, 3])
def test_the_largest_quaternion_component_is_restored(largest):
    words = [0, largest << 30 | 716 << 20 | 307 << 10 | 512, 0, 0]
    quat = compressed_ply.decode(build_compressed_ply(1, words), "a.ply").quats[0]
    others = (np.array([716, 307, 512]) / 1023 - 0.5) * 2**0.5
    expected = np.insert(others, largest, np.sqrt(1 - others @ others))
    np.testing.assert_allclose(quat, np.sign(expected[0]) * expected, atol=1e-6)


def test_a_file_without_gaussians_is_read():
    assert len(ply.decode(build_compressed_ply(0, PACKED_WORDS, rest=24), "a.ply")) == 0


def test_the_ply_reader_recognises_compressed_files(shared_data):
    data = (shared_data / "trained_models" / "biker.compressed.ply").read_bytes()
    splats = ply.decode(data, "biker.compressed.ply")
    assert len(splats) == 152_746 and splats.degree == 0
    with pytest.raises(HyrfDataError, match="holds no Gaussians"):
        ply.decode_plain(data, "biker.compressed.ply")


VALID_FILE = build_compressed_ply(300, PACKED_WORDS)


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (ply.encode(ply.decode(build_compressed_ply(0, PACKED_WORDS), "")), "'vertex' has no property packed_position"),
        (VALID_FILE.replace(b"uint packed_scale", b"int packed_scale"), "no property packed_scale of the right type"),
        (VALID_FILE.replace(b"max_scale_z", b"max_scale_w"), "'chunk' has no property max_scale_z"),
        (VALID_FILE.replace(b"element chunk", b"element chunky"), "'chunk' has no property min_x"),
        (VALID_FILE.replace(b"min_scale_x", b"min_r"), "no property min_scale_x"),
        (VALID_FILE[:-1], "ends before the 300 rows of its element 'vertex'"),
        (build_compressed_ply(300, PACKED_WORDS, chunks=1), "1 chunks do not fit 300 Gaussians"),
        (build_compressed_ply(300, PACKED_WORDS, chunks=3), "3 chunks do not fit 300 Gaussians"),
        (build_compressed_ply(3, PACKED_WORDS, rest=8), "the element 'sh' has 8 properties"),
        (build_compressed_ply(3, PACKED_WORDS, rest=9).replace(b"sh 3", b"sh 2"), "'sh' has 2 rows for 3 Gaussians"),
        (VALID_FILE.replace(b"binary_little_endian", b"ascii"), "in text cannot be read"),
        (
            VALID_FILE.replace(np.array([0, 0, 0, 1, 2, 4], "<f4").tobytes(), np.full(6, np.nan, "<f4").tobytes()),
            "position",
        ),
    ],
)
def test_invalid_files_are_refused_with_the_reason(data, words):
    with pytest.raises(HyrfDataError, match=words) as error:
        compressed_ply.decode(data, "some.ply")
    assert str(error.value).startswith("some.ply: ")


@settings(max_examples=40, derandomize=True, database=None)
@given(
    edits=FILE_EDITS,
    length=KEPT_FRACTIONS,
)
def test_damaged_files_are_decoded_or_refused(edits, length):
    data = build_compressed_ply(5, PACKED_WORDS, colored=True, rest=9)
    try:
        splats = ply.decode(damage_file(data, edits, length), "a.ply")
    except HyrfDataError as error:
        assert str(error).startswith("a.ply: ")
    else:
        assert np.isfinite(splats.positions).all()
