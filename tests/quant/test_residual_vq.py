from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from property_tests import examples
from scipy.cluster.vq import kmeans2

from hyrfpack.quant import ResidualVectorQuantizer
from hyrfpack.quant.errors import DamagedDataError


def correlated_attributes(count: int, seed: int = 0) -> np.ndarray:
    """Return rows like those of a scene: five correlated columns with very different scales and offsets."""
    rng = np.random.default_rng(seed)
    mixed = rng.standard_normal((count, 5)) @ rng.standard_normal((5, 5)) + rng.laplace(size=(count, 5))
    return (mixed * [1, 30, 0.01, 1, 5] + [0, 1000, 0, -3, 2]).astype(np.float32)


def mse_after_each_stage(values: np.ndarray, indices: np.ndarray, codebooks: np.ndarray) -> list[float]:
    """Return the mean squared error after 0, 1, ... S stages, in units of each column's standard deviation."""
    errors = []
    for stages in range(codebooks.shape[0] + 1):
        decoded = ResidualVectorQuantizer.decode(indices[:, :stages], codebooks[:stages])
        errors.append(float((((values - decoded) / values.std(axis=0)) ** 2).mean()))
    return errors


@pytest.mark.parametrize("codebook_dtype", ["float32", "float16"])
def test_error_falls_with_every_stage(codebook_dtype: str) -> None:
    values = correlated_attributes(5000)

    errors = mse_after_each_stage(values, *ResidualVectorQuantizer(5, 32, codebook_dtype).encode(values))

    assert all(after < 0.8 * before for before, after in zip(errors, errors[1:], strict=False))


@given(
    hnp.arrays(
        np.float32,
        st.tuples(st.integers(1, 40), st.integers(1, 4)),
        elements=st.floats(-1000, 1000, width=32) | st.sampled_from([0.0, 1.0]),
    ),
    st.integers(1, 9),
    st.sampled_from(["float32", "float16"]),
)
@examples(150)
def test_error_never_grows_with_a_stage(values: np.ndarray, size: int, codebook_dtype: str) -> None:
    indices, codebooks = ResidualVectorQuantizer(4, size, codebook_dtype).encode(values)

    scale = np.maximum(values.std(axis=0, dtype=np.float64), np.abs(values).max(axis=0) * 2.0**-10) + 1e-30
    previous = np.inf
    for stages in range(5):
        decoded = ResidualVectorQuantizer.decode(indices[:, :stages], codebooks[:stages])
        error = (((values.astype(np.float64) - decoded) / scale) ** 2).sum(axis=1).mean()
        assert error <= previous * (1 + 1e-4) + 1e-6
        previous = error


def test_every_row_takes_its_nearest_codeword() -> None:
    values = correlated_attributes(3000)

    indices, codebooks = ResidualVectorQuantizer(2, 16).encode(values)

    residual = values.astype(np.float64)
    for stage in range(2):
        away = (residual[:, None] - codebooks[stage]) / values.std(axis=0, dtype=np.float64)
        distances = (away**2).sum(axis=2)
        taken = np.take_along_axis(distances, indices[:, stage : stage + 1].astype(np.intp), axis=1)[:, 0]
        np.testing.assert_allclose(taken, distances.min(axis=1), rtol=1e-4, atol=1e-5)
        residual -= codebooks[stage, indices[:, stage]]


def test_one_stage_is_as_good_as_scipys_kmeans() -> None:
    values = np.random.default_rng(3).standard_normal((20_000, 5)).astype(np.float32)

    indices, codebooks = ResidualVectorQuantizer(1, 64).encode(values)

    centers, labels = kmeans2(values.astype(np.float64), 64, iter=20, minit="++", rng=0)
    ours = ((values - ResidualVectorQuantizer.decode(indices, codebooks)) ** 2).mean()
    assert ours <= 1.02 * ((values - centers[labels]) ** 2).mean()


def test_columns_of_any_scale_have_similar_relative_error() -> None:
    values = np.random.default_rng(4).standard_normal((5000, 3)).astype(np.float32) * np.float32([1e-6, 1, 1e6])

    decoded = ResidualVectorQuantizer.decode(*ResidualVectorQuantizer(4, 64).encode(values))

    relative = (values - decoded).std(axis=0) / values.std(axis=0)
    assert relative.max() < 1.3 * relative.min()


def test_rows_outside_the_training_sample_have_similar_error() -> None:
    values = correlated_attributes(150_000)

    errors = mse_after_each_stage(values, *ResidualVectorQuantizer(2, 16, iterations=3).encode(values))

    few = mse_after_each_stage(values[:20_000], *ResidualVectorQuantizer(2, 16, iterations=3).encode(values[:20_000]))
    assert errors[2] < 1.05 * few[2]


@pytest.mark.parametrize("rows", [1, 2, 5, 64])
def test_codebook_larger_than_the_data_is_exact(rows: int) -> None:
    values = np.random.default_rng(rows).standard_normal((rows, 5)).astype(np.float32)

    indices, codebooks = ResidualVectorQuantizer(2, 64).encode(values)

    assert codebooks.shape == (2, 64, 5)
    np.testing.assert_allclose(ResidualVectorQuantizer.decode(indices, codebooks), values, rtol=1e-6, atol=1e-7)


def test_zero_rows_round_trip() -> None:
    indices, codebooks = ResidualVectorQuantizer(3, 8).encode(np.zeros((0, 5), np.float32))

    assert indices.shape == (0, 3)
    assert codebooks.shape == (3, 8, 5)
    assert ResidualVectorQuantizer.decode(indices, codebooks).shape == (0, 5)


def test_identical_rows_are_exact() -> None:
    values = np.tile(np.float32([0.1, -7, 1e6, 0]), (1000, 1))

    decoded = ResidualVectorQuantizer.decode(*ResidualVectorQuantizer(2, 64).encode(values))

    np.testing.assert_array_equal(decoded, values)


@pytest.mark.parametrize("codebook_dtype", ["float32", "float16"])
def test_constant_channel_is_exact_and_does_not_affect_the_others(codebook_dtype: str) -> None:
    values = np.random.default_rng(5).standard_normal((4000, 2)).astype(np.float32)
    with_constant = np.insert(values, 1, np.float32(1234.567), axis=1)
    quantizer = ResidualVectorQuantizer(3, 32, codebook_dtype)

    alone = quantizer.decode(*quantizer.encode(values)) - values
    beside = quantizer.decode(*quantizer.encode(with_constant)) - with_constant

    np.testing.assert_allclose(beside[:, 1], 0, atol=2e-4)
    assert (beside[:, [0, 2]] ** 2).mean() < 1.05 * (alone**2).mean()


def test_heavy_tails_keep_the_relative_error_below_a_thousandth() -> None:
    values = np.random.default_rng(6).standard_cauchy((20_000, 5)).astype(np.float32)

    errors = mse_after_each_stage(values, *ResidualVectorQuantizer(6, 64).encode(values))

    assert np.isfinite(errors).all()
    assert errors[6] < 1e-3 * errors[0]


def test_largest_float16_values_stay_finite() -> None:
    values = np.full((1000, 2), 65504, np.float32)
    values[::100] = -65504
    values[:500, 1] = 1

    decoded = ResidualVectorQuantizer.decode(*ResidualVectorQuantizer(4, 1, "float16").encode(values))

    assert np.isfinite(decoded).all()


def test_float16_codebooks_hold_only_float16_values() -> None:
    _, codebooks = ResidualVectorQuantizer(3, 16, "float16").encode(correlated_attributes(2000))

    assert codebooks.dtype == np.float32
    np.testing.assert_array_equal(codebooks.astype(np.float16).astype(np.float32), codebooks)


def test_the_same_seed_gives_the_same_result() -> None:
    values = correlated_attributes(4000)

    first = ResidualVectorQuantizer(2, 32, seed=3).encode(values)
    second = ResidualVectorQuantizer(2, 32, seed=3).encode(values)

    for a, b in zip(first, second, strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize(("size", "dtype"), [(256, np.uint8), (257, np.uint16)])
def test_index_dtype_is_the_narrowest_that_holds_the_codebook(size: int, dtype: type) -> None:
    indices, _ = ResidualVectorQuantizer(1, size).encode(correlated_attributes(600))

    assert indices.dtype == dtype
    assert len(np.unique(indices)) == size


@pytest.mark.parametrize(
    ("bad", "codebook_dtype"), [(np.nan, "float32"), (np.inf, "float32"), (1e31, "float32"), (7e4, "float16")]
)
def test_values_that_cannot_be_stored_are_refused(bad: float, codebook_dtype: str) -> None:
    values = np.zeros((10, 3), np.float32)
    values[4, 1] = bad

    with pytest.raises(ValueError, match="residual VQ"):
        ResidualVectorQuantizer(codebook_dtype=codebook_dtype).encode(values)


@pytest.mark.parametrize(
    "settings_",
    [{"stages": 0}, {"codebook_size": 0}, {"codebook_size": 65537}, {"iterations": -1}, {"codebook_dtype": "int8"}],
)
def test_impossible_settings_are_refused(settings_: dict) -> None:
    with pytest.raises(ValueError, match="codebook_dtype|needs"):
        ResidualVectorQuantizer(**settings_)


def test_decoding_refuses_indices_outside_the_codebook() -> None:
    with pytest.raises(DamagedDataError, match="index 4 in a codebook of 4"):
        ResidualVectorQuantizer.decode(np.array([[0, 4]], np.uint8), np.zeros((2, 4, 3), np.float32))


def test_decoding_refuses_different_numbers_of_stages() -> None:
    with pytest.raises(DamagedDataError, match="disagree"):
        ResidualVectorQuantizer.decode(np.zeros((5, 3), np.uint8), np.zeros((2, 4, 3), np.float32))
