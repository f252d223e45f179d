"""Training runs side by side, as one page."""

from hyrfpack.compare.report import ComparisonReport, compare

__all__ = ["ComparisonReport", "compare"]
