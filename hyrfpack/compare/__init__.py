"""Comparison of finished training runs side by side, as one HTML page."""

from hyrfpack.compare.report import ComparisonReport, compare_runs

__all__ = ["ComparisonReport", "compare_runs"]
