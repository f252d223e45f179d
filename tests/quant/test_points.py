from __future__ import annotations

import math
import struct
import tracemalloc

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from property_tests import examples

from hyrfpack.quant.errors import DamagedDataError
from hyrfpack.quant.integers import encode_integers
from hyrfpack.quant.morton import MAX_BITS_PER_AXIS
from hyrfpack.quant.points import MAX_POINT_CLASSES, LatticePoints, decode_points, encode_points


def random_points(count: int, bits: list[int], seed: int = 0, spread: float = 1.0) -> LatticePoints:
    """Draw points from the cube [0, spread)^3, a part of the unit cube, with uniformly random classes."""
    rng = np.random.default_rng(seed)
    classes = rng.integers(len(bits), size=count).astype(np.uint8)
    sides = (1 << np.array(bits))[classes][:, None]
    return LatticePoints(np.floor(rng.random((count, 3)) * spread * sides).astype(np.int64), classes, np.array(bits))


def sorted_rows(points: LatticePoints) -> list[tuple[int, ...]]:
    return sorted(map(tuple, np.column_stack([points.classes, points.cells]).tolist()))


_rng = np.random.default_rng(1)
HARD_CASES = {
    "none": random_points(0, [7]),
    "none, all classes": random_points(0, list(range(1, 17))),
    "one": LatticePoints(np.array([[5, 0, 7]]), np.zeros(1, np.uint8), np.array([3])),
    "one in the last corner": LatticePoints(
        np.full((1, 3), 2**18 - 1), np.zeros(1, np.uint8), np.array([MAX_BITS_PER_AXIS])
    ),
    "first and last corner": LatticePoints(
        np.array([[2**18 - 1] * 3, [0] * 3]), np.array([0, 0], np.uint8), np.array([MAX_BITS_PER_AXIS])
    ),
    "coincident": LatticePoints(np.tile([[100, 200, 300]], (2000, 1)), np.zeros(2000, np.uint8), np.array([16])),
    "coincident in all classes": LatticePoints(
        np.zeros((1600, 3), np.int64), (np.arange(1600) % 16).astype(np.uint8), np.arange(3, 19)
    ),
    "duplicates": LatticePoints(_rng.integers(0, 3, (3000, 3)), np.zeros(3000, np.uint8), np.array([12])),
    "uniform": random_points(3000, [14]),
    "one bit": random_points(500, [1]),
    "all classes": random_points(3000, [18, 17, 16, 15, 14, 13, 12, 11, 10, 9, 8, 7, 6, 5, 2, 1]),
    "equal classes": random_points(900, [10, 10, 10]),
    "classes nobody is in": LatticePoints(
        _rng.integers(0, 512, (800, 3)), np.full(800, 2, np.uint8), np.array([18, 1, 9, 4])
    ),
    "outlier": LatticePoints(
        np.concatenate([_rng.integers(0, 9, (999, 3)), [[2**18 - 1] * 3]]), np.zeros(1000, np.uint8), np.array([18])
    ),
    "two far clumps": LatticePoints(
        np.concatenate([_rng.integers(0, 50, (500, 3)), 2**17 - 1 - _rng.integers(0, 50, (500, 3))]),
        _rng.integers(0, 2, 1000).astype(np.uint8),
        np.array([18, 17]),
    ),
}


def check_round_trip(points: LatticePoints) -> None:
    data, order, ordered = encode_points(points)

    decoded = decode_points(data, len(points.cells))
    for name in ("cells", "classes", "bits"):
        np.testing.assert_array_equal(getattr(decoded, name), getattr(ordered, name), err_msg=name)
    assert sorted(order.tolist()) == list(range(len(points.cells)))
    np.testing.assert_array_equal(decoded.classes, points.classes[order])
    assert (decoded.bits >= points.bits).all()
    # The encoder may refine a class; the finer cell must lie inside the original one.
    shift = (decoded.bits - points.bits)[decoded.classes][:, None]
    np.testing.assert_array_equal(decoded.cells >> shift, points.cells[order])


@pytest.mark.parametrize("name", HARD_CASES)
def test_points_round_trip(name: str) -> None:
    check_round_trip(HARD_CASES[name])


@given(st.data())
@examples(100)
def test_any_points_round_trip(data: st.DataObject) -> None:
    bits = data.draw(st.lists(st.integers(1, MAX_BITS_PER_AXIS), min_size=1, max_size=MAX_POINT_CLASSES))
    count, seed = data.draw(st.integers(0, 200)), data.draw(st.integers(0, 1000))
    spread = data.draw(st.sampled_from([1e-6, 0.01, 0.3, 1.0]))

    check_round_trip(random_points(count, bits, seed, spread))


def test_many_points_round_trip() -> None:
    points = random_points(300_000, [16, 14, 12, 11, 10, 9])

    data, order, ordered = encode_points(points)

    decoded = decode_points(data, 300_000)
    np.testing.assert_array_equal(decoded.cells, ordered.cells)
    np.testing.assert_array_equal(decoded.classes, points.classes[order])


@pytest.mark.parametrize("name", HARD_CASES)
def test_the_bytes_do_not_depend_on_the_order_of_points(name: str) -> None:
    points = HARD_CASES[name]
    shuffled = np.random.default_rng(2).permutation(len(points.cells))

    data, _, ordered = encode_points(points)
    again = encode_points(points)[0]
    from_shuffled = encode_points(LatticePoints(points.cells[shuffled], points.classes[shuffled], points.bits))[0]

    assert data == again == from_shuffled
    assert sorted_rows(decode_points(from_shuffled, len(shuffled))) == sorted_rows(ordered)


def test_equal_points_of_a_class_keep_their_order() -> None:
    points = HARD_CASES["coincident in all classes"]

    order = encode_points(points)[1]

    expected = [place for kind in range(16) for place in range(1600) if points.classes[place] == kind]
    assert order.tolist() == expected


def test_points_adjacent_in_the_encoded_order_are_near_in_space() -> None:
    ordered = encode_points(random_points(4000, [12]))[2]

    steps = np.linalg.norm(np.diff(ordered.centers() / 2**19, axis=0), axis=1)
    apart = np.linalg.norm(np.diff(random_points(4000, [12]).centers() / 2**19, axis=0), axis=1)
    assert steps.mean() < apart.mean() / 5


@pytest.mark.parametrize("bits", [1, 7, 18])
def test_centers_are_the_middles_of_the_cells(bits: int) -> None:
    points = random_points(50, [18, bits])

    for center, cell, kind in zip(points.centers().tolist(), points.cells.tolist(), points.classes, strict=True):
        side = 2 ** -int(points.bits[kind])
        assert [value / 2**19 for value in center] == [(coordinate + 0.5) * side for coordinate in cell]


def min_multiset_bits(count: int, bits: int) -> float:
    """Return the least bits for `count` points where all multisets are equally likely: log2 of their number."""
    cells = 8**bits
    return (math.lgamma(count + cells) - math.lgamma(count + 1) - math.lgamma(cells)) / math.log(2)


@pytest.mark.parametrize(
    ("count", "bits"),
    [
        (20_000, 12),
        (3000, 18),
        (5000, 4),
        (40_000, 5),
        (100_000, 3),
    ],
)
def test_uniform_points_take_at_most_2_percent_more_than_their_entropy(count: int, bits: int) -> None:
    data = encode_points(random_points(count, [bits]))[0]

    assert 8 * len(data) < 1.02 * min_multiset_bits(count, bits) + 400  # 400 bits for header and models


def test_classes_take_at_most_5_percent_more_than_their_entropy() -> None:
    points = random_points(30_000, [14, 14])
    one_class = LatticePoints(points.cells, np.zeros(30_000, np.uint8), np.array([14]))

    more = 8 * (len(encode_points(points)[0]) - len(encode_points(one_class)[0])) / 30_000

    assert 0.98 < more < 1.05


def test_coincident_points_take_fewer_than_60_bytes() -> None:
    points = LatticePoints(np.tile([[77, 5, 9]], (100_000, 1)), np.zeros(100_000, np.uint8), np.array([18]))

    assert len(encode_points(points)[0]) < 60


SAMPLE_POINTS = random_points(60, [9, 7, 6])
SAMPLE_DATA = encode_points(SAMPLE_POINTS)[0]
HEADER_STRUCT = struct.Struct("<BBII")  # base bits, number of classes, gap bytes, class bytes


@pytest.mark.parametrize("name", ["one", "coincident", "one bit", "two far clumps", "all classes"])
def test_truncation_and_trailing_bytes_are_refused(name: str) -> None:
    count = len(HARD_CASES[name].cells)
    data = encode_points(HARD_CASES[name])[0]

    for length in np.unique(np.append(np.arange(min(len(data), 100)), np.linspace(0, len(data) - 1, 60).astype(int))):
        with pytest.raises(DamagedDataError):
            decode_points(data[:length], count)
    with pytest.raises(DamagedDataError):
        decode_points(data + b"\0", count)


def check_decodes_to_the_lattice_or_is_refused(data: bytes, count: int) -> None:
    try:
        points = decode_points(data, count)
    except DamagedDataError:
        return
    assert points.cells.shape == (count, 3) and points.classes.shape == (count,)
    assert points.bits.min() >= 1 and points.bits.max() <= MAX_BITS_PER_AXIS
    assert points.cells.min(initial=0) >= 0
    assert (points.cells < (1 << points.bits)[points.classes][:, None]).all()
    assert points.centers().max(initial=0) < 2**19


@given(st.data())
@examples(200)
def test_damaged_data_is_refused_or_decodes_to_the_lattice(data: st.DataObject) -> None:
    damaged = bytearray(SAMPLE_DATA)
    for _ in range(data.draw(st.integers(1, 4))):
        damaged[data.draw(st.integers(0, len(damaged) - 1))] ^= data.draw(st.integers(1, 255))

    check_decodes_to_the_lattice_or_is_refused(bytes(damaged), 60)


@given(st.binary(max_size=120), st.integers(0, 50))
@examples(100)
def test_random_bytes_are_refused_or_decode_to_the_lattice(data: bytes, count: int) -> None:
    check_decodes_to_the_lattice_or_is_refused(data, count)
    check_decodes_to_the_lattice_or_is_refused(SAMPLE_DATA[:13] + data, count)


def sample_with_header(**changes: int) -> bytes:
    fields = dict(zip(("base", "kinds", "gaps", "classes"), HEADER_STRUCT.unpack_from(SAMPLE_DATA), strict=True))
    return HEADER_STRUCT.pack(*(fields | changes).values()) + SAMPLE_DATA[HEADER_STRUCT.size :]


@pytest.mark.parametrize(
    "changes",
    [
        {"base": 0},
        {"base": 10},
        {"base": 19},
        {"base": 255},
        {"kinds": 0},
        {"kinds": 17},
        {"kinds": 255},
        {"gaps": 2**32 - 1},
        {"classes": 2**32 - 1},
        {"gaps": 2**32 - 1, "classes": 2**32 - 1},
        {"gaps": 0},
        {"classes": 0},
    ],
    ids=str,
)
def test_invalid_headers_are_refused_in_little_memory(changes: dict[str, int]) -> None:
    tracemalloc.start()
    with pytest.raises(DamagedDataError):
        decode_points(sample_with_header(**changes), 60)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()

    assert peak < 1 << 20


@pytest.mark.parametrize("bits", [0, 19, 63, 255])
def test_classes_with_invalid_bits_are_refused(bits: int) -> None:
    damaged = bytearray(SAMPLE_DATA)
    damaged[HEADER_STRUCT.size + 1] = bits

    with pytest.raises(DamagedDataError, match="bits"):
        decode_points(bytes(damaged), 60)


@pytest.mark.parametrize("count", [0, 59, 61, 6000, 100_000])
def test_wrong_point_count_is_refused(count: int) -> None:
    with pytest.raises(DamagedDataError):
        decode_points(SAMPLE_DATA, count)


def test_gaps_that_leave_the_lattice_are_refused() -> None:
    data = encode_points(LatticePoints(np.array([[1, 1, 1], [3, 3, 3]]), np.zeros(2, np.uint8), np.array([2])))[0]
    damaged = bytearray(data)
    damaged[0] = damaged[HEADER_STRUCT.size] = 1  # the lattice has 8 cells, and the last point lies in cell 63

    assert data[0] == 2
    with pytest.raises(DamagedDataError, match="out of the lattice"):
        decode_points(bytes(damaged), 2)


@pytest.mark.parametrize("kind", [2, 300, 2**40])
def test_undeclared_classes_are_refused(kind: int) -> None:
    gaps, classes = encode_integers(np.array([1, 1])), encode_integers(np.array([0, kind]), np.zeros(2, np.uint8))
    data = HEADER_STRUCT.pack(2, 2, len(gaps), len(classes)) + bytes([2, 2]) + gaps + classes

    with pytest.raises(DamagedDataError, match=f"a class {kind}, but only 2 are declared"):
        decode_points(data, 2)


def test_decoding_takes_at_most_120_bytes_per_point() -> None:
    points = random_points(100_000, [14, 12])
    data = encode_points(points)[0]
    decode_points(data, 100_000)

    tracemalloc.start()
    decode_points(data, 100_000)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()

    assert peak < 120 * 100_000
