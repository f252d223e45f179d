"""SPZ: hand-packed records and real files are decoded, errors are bounded, invalid files are refused."""

from __future__ import annotations

import gzip
import struct
import sys
import tracemalloc
import zlib

import numpy as np
import pytest
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st

from hyrfpack.errors import HyrfDataError, HyrfError
from hyrfpack.splats.formats import compressed_ply, spz
from hyrfpack.splats.formats.hints import Hints
from hyrfpack.splats.splats import Splats, normalize_quats

# A half turn about x changes the sign of the harmonics that are odd in (y, z).
HALF_TURN_SIGNS = np.array([1, -1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1])


def make_splats(count: int, degree: int = 3, antialiased: bool = False) -> Splats:
    rng = np.random.default_rng(count)
    return Splats(
        rng.normal(0, 5, (count, 3)),
        np.exp(rng.normal(-3, 1, (count, 3))),
        normalize_quats(rng.normal(size=(count, 4))),
        rng.uniform(0, 1, count),
        rng.uniform(-0.95, 0.95, (count, (degree + 1) ** 2, 3)),
        antialiased,
    )


def sections_of_one_gaussian(version: int, degree: int = 0) -> list[bytes]:
    """Pack the sections of one Gaussian at (1, -2, 0.5) in the file's axes, with 8 fractional bits."""
    fixed = b"\x00\x01\x00" + b"\x00\xfe\xff" + b"\x80\x00\x00"
    position = struct.pack("<3e", 1, -2, 0.5) if version == 1 else fixed
    # The largest component is w, index 3; x = -256/511 sqrt(1/2), y = 0, z = 511/511 sqrt(1/2)
    rotation = struct.pack("<I", 3 << 30 | (512 | 256) << 20 | 511) if version >= 3 else bytes([0, 128, 128])
    harmonics = bytes(range(128, 128 + 3 * ((degree + 1) ** 2 - 1)))
    return [position, bytes([51]), bytes([255, 0, 51]), bytes([160, 144, 176]), rotation, harmonics]


def build_spz(sections: list[bytes], version: int, degree: int = 0, count: int = 1, bits: int = 8, flags: int = 0):
    if version < 4:
        return gzip.compress(
            struct.pack("<4sIIBBBB", b"NGSP", version, count, degree, bits, flags, 0) + b"".join(sections)
        )
    streams = [(zstandard.compress(section), len(section)) for section in sections if section]
    extension = struct.pack("<II", 0x12345678, 5) + b"hello" if flags & 2 else b""
    header = struct.pack("<4sIIBBBBI12x", b"NGSP", 4, count, degree, bits, flags, len(streams), 32 + len(extension))
    table = b"".join(struct.pack("<QQ", len(stream), length) for stream, length in streams)
    return header + extension + table + b"".join(stream for stream, _ in streams)


@pytest.mark.parametrize("version", [1, 2, 3, 4])
def test_a_hand_packed_record_is_decoded(version):
    splats = spz.decode(build_spz(sections_of_one_gaussian(version, degree=1), version, degree=1, flags=1), "a.spz")

    np.testing.assert_array_equal(splats.positions, [[1, 2, -0.5]])  # differs from the file by a half turn about x
    np.testing.assert_allclose(splats.scales, np.exp([[0, -1, 1]]), rtol=1e-6)
    np.testing.assert_allclose(splats.opacities, [0.2], rtol=1e-6)
    np.testing.assert_allclose(splats.harmonics[0, 0], np.array([0.5, -0.5, -0.3]) / 0.15, rtol=1e-6)
    np.testing.assert_allclose(splats.harmonics[0, 1:], HALF_TURN_SIGNS[1:4, None] * np.arange(9).reshape(3, 3) / 128)
    x, y, z = (-256 / 511 * 0.5**0.5, 0, 0.5**0.5) if version >= 3 else (-1, 1 / 255, 1 / 255)
    expected = np.array([np.sqrt(max(0, 1 - x * x - y * y - z * z)), x, -y, -z])
    np.testing.assert_allclose(abs(splats.quats[0] @ expected) / np.linalg.norm(expected), 1, rtol=1e-6)
    assert splats.antialiased


@pytest.mark.parametrize("version", [3, 4])
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_splats_round_trip_within_the_documented_error_bounds(version, degree):
    splats = make_splats(3000, degree, antialiased=degree == 2)

    decoded = spz.decode(spz.encode(splats, Hints(spz_version=version)), "a.spz")

    farthest = np.abs(splats.positions).max()
    assert np.abs(decoded.positions - splats.positions).max() <= farthest / 2**22 / 2
    assert np.abs(np.log(decoded.scales / splats.scales)).max() <= 1 / 32 + 1e-5
    assert np.abs(decoded.opacities - splats.opacities).max() <= 0.5 / 255 + 1e-6
    assert np.abs(decoded.harmonics[:, 0] - splats.harmonics[:, 0]).max() <= 0.5 / (0.15 * 255) + 1e-6
    assert np.abs(decoded.harmonics - splats.harmonics)[:, 1:].max(initial=0) <= 1 / 64 + 1e-6
    cosines = np.abs((decoded.quats.astype(np.float64) * splats.quats).sum(1)).min()
    assert 2 * np.arccos(min(cosines, 1)) < 0.006
    assert decoded.degree == degree and decoded.antialiased == splats.antialiased


def test_version_2_rounds_rotations_to_bytes_and_all_else_as_version_3():
    splats = make_splats(500, 1)
    older, newer = (spz.decode(spz.encode(splats, Hints(spz_version=version)), "a.spz") for version in (2, 3))
    for name in ("positions", "scales", "opacities", "harmonics"):
        np.testing.assert_array_equal(getattr(older, name), getattr(newer, name), name)
    upper = np.where(splats.quats[:, :1] < 0, -splats.quats, splats.quats)
    assert np.abs(older.quats - upper)[:, 1:].max() <= 0.5 / 127.5 + 1e-6


@pytest.mark.parametrize("version", [3, 4])
def test_encoding_decoded_splats_again_changes_nothing(version):
    once = spz.encode(make_splats(500), Hints(spz_version=version))
    twice = spz.encode(spz.decode(once, "a.spz"), Hints(spz_version=version))

    first, second = spz.decode(once, "a.spz"), spz.decode(twice, "a.spz")
    for name in ("positions", "scales", "opacities", "harmonics"):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name), name)
    np.testing.assert_allclose(first.quats, second.quats, atol=0.002)


@pytest.mark.parametrize("version", [3, 4])
def test_stored_values_are_those_of_the_splats_rotated_about_x(version):
    splats = make_splats(1)
    turned = splats.rotated(np.diag([1.0, -1, -1]))
    data = spz.encode(splats, Hints(spz_version=version))
    content = gzip.decompress(data)[16:] if version == 3 else zstandard.decompress(data[32 + 6 * 16 :])

    stored = [int.from_bytes(content[at : at + 3], "little", signed=True) for at in (0, 3, 6)]

    assert np.allclose(np.array(stored) / turned.positions[0], stored[0] / turned.positions[0, 0], rtol=1e-5)
    if version == 3:
        assert np.abs(np.frombuffer(content[20:], np.uint8) / 128 - 1 - turned.harmonics[0, 1:].ravel()).max() < 0.016


@pytest.mark.parametrize("version", [3, 4])
def test_a_file_without_gaussians_round_trips(version):
    assert len(spz.decode(spz.encode(make_splats(0, 2), Hints(spz_version=version)), "a.spz")) == 0


def test_positions_use_as_many_fractional_bits_as_the_farthest_one_allows():
    near = Splats(*(np.repeat(part, 2, axis=0) for part in (np.array([[0.1, 0.2, 0.3]]), np.ones((1, 3)))),
                  np.tile([1.0, 0, 0, 0], (2, 1)), np.ones(2), np.zeros((2, 1, 3)))  # fmt: skip
    for farthest, step in ((0.5, 2**-23), (1.0, 2**-22), (100.0, 2**-16), (4e6, 2**-1)):
        near.positions[1, 0] = -farthest
        error = np.abs(spz.decode(spz.encode(near), "a.spz").positions - near.positions).max()
        assert error <= step / 2
    near.positions[1, 0] = 5e6
    with pytest.raises(HyrfDataError, match="5,000,000 units from the origin, and SPZ reaches 4,194,303"):
        spz.encode(near)


def test_values_out_of_range_are_clipped():
    splats = Splats(np.zeros((2, 3)), np.array([[0, 1e-9, 1e9]] * 2), np.tile([1.0, 0, 0, 0], (2, 1)),
                    np.array([0.0, 1]), np.array([[[9.0, -9, 0], [5, -5, 0], [0] * 3, [0] * 3]] * 2))  # fmt: skip
    decoded = spz.decode(spz.encode(splats), "a.spz")
    np.testing.assert_allclose(decoded.scales[0], np.exp([-10, -10, 255 / 16 - 10]), rtol=1e-6)
    np.testing.assert_array_equal(decoded.opacities, [0, 1])
    np.testing.assert_allclose(decoded.harmonics[0, 0, :2], [0.5 / 0.15, -0.5 / 0.15], rtol=1e-6)
    assert decoded.harmonics[0, 1, 0] > 0.96 and decoded.harmonics[0, 1, 1] < -0.96


@pytest.mark.parametrize("version", [3, 4])
def test_harmonics_of_degree_4_are_ignored(version):
    decoded = spz.decode(build_spz(sections_of_one_gaussian(version, degree=4), version, degree=4), "a.spz")
    assert decoded.degree == 3
    np.testing.assert_allclose(decoded.harmonics[0, 15], HALF_TURN_SIGNS[15] * np.arange(42, 45) / 128)


def test_extensions_are_skipped():
    assert len(spz.decode(build_spz(sections_of_one_gaussian(4), 4, flags=2), "a.spz")) == 1
    assert len(spz.decode(build_spz([*sections_of_one_gaussian(3), b"extension"], 3, flags=2), "a.spz")) == 1


def test_encoding_is_deterministic_and_stores_no_time():
    older = Hints(spz_version=3)
    data = spz.encode(make_splats(50), older)
    assert data[:10] == b"\x1f\x8b\x08\0\0\0\0\0\0\xff"
    assert data == spz.encode(make_splats(50), older)
    assert spz.encode(make_splats(50)) == spz.encode(make_splats(50))


def test_only_version_4_needs_zstandard(monkeypatch):
    splats = make_splats(3)
    version_3, version_4 = (spz.encode(splats, Hints(spz_version=version)) for version in (3, 4))
    monkeypatch.setitem(sys.modules, "zstandard", None)
    assert spz.encode(splats, Hints(spz_version=3)) == version_3
    assert len(spz.decode(version_3, "a.spz")) == 3
    for call in (lambda: spz.encode(splats, Hints(spz_version=4)), lambda: spz.decode(version_4, "a.spz")):
        with pytest.raises(HyrfError, match="pip install zstandard"):
            call()


def test_version_4_is_the_default():
    assert spz.encode(make_splats(50)) == spz.encode(make_splats(50), Hints(spz_version=4)) != b""
    assert spz.encode(make_splats(50))[:8] == struct.pack("<4sI", b"NGSP", 4)


def test_a_real_spz_equals_its_compressed_ply(shared_data):
    folder = shared_data / "trained_models"
    splats = spz.decode((folder / "biker.spz").read_bytes(), "biker.spz")
    other = compressed_ply.decode((folder / "biker.compressed.ply").read_bytes(), "biker.compressed.ply")

    assert len(splats) == len(other) == 152_746
    assert np.abs(splats.positions - other.positions).max() <= 2**-13 + 1e-6
    assert np.abs(np.log(splats.scales / np.maximum(other.scales, np.exp(-10)))).max() <= 1 / 32 + 1e-4
    assert np.abs(splats.opacities - other.opacities).max() <= 0.003
    assert np.abs(splats.harmonics - other.harmonics).max() <= 0.5 / (0.15 * 255) + 0.001
    assert np.abs((splats.quats * other.quats).sum(1)).min() > 0.99999


VALID_FILE_BY_VERSION = {version: build_spz(sections_of_one_gaussian(version), version) for version in (3, 4)}


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"", "this is not an SPZ file"),
        (b"ply\n", "this is not an SPZ file"),
        (VALID_FILE_BY_VERSION[3][:20], "ends within its header"),
        (VALID_FILE_BY_VERSION[3][:-4], "is truncated"),
        (VALID_FILE_BY_VERSION[3][:-8] + bytes(8), "gzip stream is damaged"),
        (VALID_FILE_BY_VERSION[4][:31], "ends within its header"),
        (VALID_FILE_BY_VERSION[4][:100], "outside of the file"),
        (VALID_FILE_BY_VERSION[4][:-1], "is truncated"),
        (gzip.compress(b"NGSQ" + bytes(40)), "do not start with 'NGSP'"),
        (gzip.compress(struct.pack("<4sIIBBBB", b"NGSP", 5, 1, 0, 8, 0, 0)), "this is SPZ version 5"),
        (build_spz([*sections_of_one_gaussian(3), b"!"], 3), "continues after its 1 Gaussians"),
        (build_spz(sections_of_one_gaussian(3), 3, count=2), "before its 2 Gaussians do"),
        (build_spz(sections_of_one_gaussian(4), 4, count=2), "a stream has 9 bytes, but 2 Gaussians need 18"),
        (build_spz(sections_of_one_gaussian(4), 4, degree=1), "5 streams do not fit harmonics of degree 1"),
        (build_spz(sections_of_one_gaussian(3), 3, degree=5), "harmonics of degree 5"),
        (build_spz(sections_of_one_gaussian(3), 3, bits=40), "40 fractional bits"),
        (build_spz(sections_of_one_gaussian(3), 3, flags=0x80), "levels of detail"),
        (build_spz(sections_of_one_gaussian(3), 3, count=2**32 - 1), "far more than"),
        (build_spz(sections_of_one_gaussian(4), 4, count=2**32 - 1), "far more than"),
        (
            build_spz([b"\0\x7c" * 3, *sections_of_one_gaussian(1)[1:]], 1),
            "the position of Gaussian 0 of 1 is not a finite number",
        ),
    ],
    # The bytes of gzip contain the time, so they cannot be test ids.
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_invalid_files_are_refused_with_the_reason(data, words):
    with pytest.raises(HyrfDataError, match=words) as error:
        spz.decode(data, "some.spz")
    assert str(error.value).startswith("some.spz: ")


def test_unsupported_versions_raise_value_error():
    with pytest.raises(ValueError, match="version 1"):
        spz.encode(make_splats(1), Hints(spz_version=1))


@pytest.mark.parametrize("version", [3, 4])
def test_a_compression_bomb_is_refused_in_little_memory(version):
    zeros = bytes(50_000_000)
    sections = sections_of_one_gaussian(version)
    if version == 3:
        bomb = build_spz([*sections, zeros], 3)
    else:
        good = build_spz(sections, 4)
        first = zstandard.compress(zeros)
        rest = good[32 + 5 * 16 + struct.unpack_from("<Q", good, 32)[0] :]
        bomb = good[:32] + struct.pack("<QQ", len(first), 9) + good[48 : 32 + 5 * 16] + first + rest
    tracemalloc.start()
    with pytest.raises(HyrfDataError):
        spz.decode(bomb, "bomb.spz")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 2_000_000


@settings(max_examples=40, derandomize=True, database=None)
@given(
    version=st.sampled_from([3, 4]),
    inside=st.booleans(),
    edits=st.lists(st.tuples(st.floats(0, 0.999), st.integers(0, 255)), min_size=1, max_size=4),
    length=st.sampled_from([1.0, 1.0, 0.9, 0.3]),
)
def test_damaged_files_are_decoded_or_refused(version, inside, edits, length):
    data = spz.encode(make_splats(20, 1), Hints(spz_version=version))
    inside &= version == 3
    data = bytearray(gzip.decompress(data) if inside else data)
    for place, byte in edits:
        data[int(place**3 * len(data))] = byte  # most edits are near the start
    data = bytes(data[: int(length * len(data))])
    try:
        splats = spz.decode(gzip.compress(data) if inside else data, "a.spz")
    except HyrfDataError as error:
        assert str(error).startswith("a.spz: ")
    else:
        assert np.isfinite(splats.positions).all()


def test_a_wrong_gzip_checksum_is_refused():
    content = gzip.decompress(VALID_FILE_BY_VERSION[3])
    deflate = zlib.compressobj(wbits=-15)
    body = deflate.compress(content) + deflate.flush()
    wrong = b"\x1f\x8b\x08\0\0\0\0\0\0\xff" + body + struct.pack("<II", zlib.crc32(content) ^ 1, len(content))
    with pytest.raises(HyrfDataError, match="gzip stream is damaged"):
        spz.decode(wrong, "a.spz")
