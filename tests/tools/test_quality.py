"""Measures that compare the quality of versions."""

from __future__ import annotations

import numpy as np
import pytest

from tools.studies.compare_versions import bytes_change_at_equal_psnr, score_gain_at_equal_bytes

FILE_SIZES = np.array([1e5, 2e5, 4e5, 8e5])


def make_curve(sizes: np.ndarray, shift: float = 0.0) -> np.ndarray:
    """Return a curve of 1 dB for each doubling of the size."""
    return np.stack((sizes, 20 + np.log2(sizes / 1e5) + shift), 1)


@pytest.mark.parametrize("share", [0.5, 0.9, 1.0, 3.0])
def test_a_constant_ratio_of_bytes_at_equal_psnr_is_found(share):
    assert bytes_change_at_equal_psnr(make_curve(FILE_SIZES, -np.log2(share)), make_curve(FILE_SIZES)) == pytest.approx(
        share - 1
    )


def test_file_sizes_may_differ_and_be_unordered():
    assert bytes_change_at_equal_psnr(make_curve(1.7 * FILE_SIZES[::-1], 1.0), make_curve(FILE_SIZES)) == pytest.approx(
        -0.5
    )


def test_curves_that_share_no_psnr_are_not_compared():
    assert bytes_change_at_equal_psnr(make_curve(FILE_SIZES, 9.0), make_curve(FILE_SIZES)) is None


def test_a_larger_file_of_lower_quality_is_ignored():
    worse = np.array([[1.6e6, 18.0]])
    both = bytes_change_at_equal_psnr(
        np.concatenate((make_curve(FILE_SIZES, 1.0), worse)), np.concatenate((make_curve(FILE_SIZES), worse))
    )
    assert both == pytest.approx(-0.5)


def test_scores_are_compared_at_the_most_bytes_that_both_have():
    assert score_gain_at_equal_bytes(make_curve(FILE_SIZES, 0.7), make_curve(2 * FILE_SIZES)) == pytest.approx(0.7)
    assert score_gain_at_equal_bytes(make_curve(4 * FILE_SIZES, -0.2), make_curve(FILE_SIZES)) == pytest.approx(-0.2)
