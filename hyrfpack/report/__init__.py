"""Pages for people: finished training runs side by side, and what compression did to a model."""

from hyrfpack.report.comparison import ComparisonReport, compare_runs
from hyrfpack.report.compression import write_compression_report

__all__ = ["ComparisonReport", "compare_runs", "write_compression_report"]
