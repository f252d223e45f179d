"""Measure the run time of operations and settings together with the error that each of them causes."""

from hyrfpack.bench.rows import Error, Row
from hyrfpack.bench.suite import GROUPS, BenchReport, benchmark_model

__all__ = ["GROUPS", "BenchReport", "Error", "Row", "benchmark_model"]
