"""The measures by which versions are compared."""

from __future__ import annotations

import numpy as np
import pytest

from tools.studies.compare_versions import bytes_change_at_equal_psnr, score_gain_at_equal_bytes

SIZES = np.array([1e5, 2e5, 4e5, 8e5])


def curve(sizes: np.ndarray, shift: float = 0.0) -> np.ndarray:
    """A dB for each doubling."""
    return np.stack((sizes, 20 + np.log2(sizes / 1e5) + shift), 1)


@pytest.mark.parametrize("share", [0.5, 0.9, 1.0, 3.0])
def test_a_share_of_the_bytes_at_every_psnr_is_found(share):
    assert bytes_change_at_equal_psnr(curve(SIZES, -np.log2(share)), curve(SIZES)) == pytest.approx(share - 1)


def test_sizes_need_not_be_the_same_nor_in_order():
    assert bytes_change_at_equal_psnr(curve(1.7 * SIZES[::-1], 1.0), curve(SIZES)) == pytest.approx(-0.5)


def test_curves_that_share_no_psnr_are_not_compared():
    assert bytes_change_at_equal_psnr(curve(SIZES, 9.0), curve(SIZES)) is None


def test_a_larger_file_that_is_worse_does_not_count():
    worse = np.array([[1.6e6, 18.0]])
    both = bytes_change_at_equal_psnr(np.concatenate((curve(SIZES, 1.0), worse)), np.concatenate((curve(SIZES), worse)))
    assert both == pytest.approx(-0.5)


def test_scores_are_compared_at_the_most_bytes_that_both_have():
    assert score_gain_at_equal_bytes(curve(SIZES, 0.7), curve(2 * SIZES)) == pytest.approx(0.7)
    assert score_gain_at_equal_bytes(curve(4 * SIZES, -0.2), curve(SIZES)) == pytest.approx(-0.2)
