"""Speed against error: what each operation and each setting costs in time, beside what it costs in accuracy."""

from hyrfpack.bench.rows import Error, Row
from hyrfpack.bench.suite import GROUPS, BenchReport, bench

__all__ = ["GROUPS", "BenchReport", "Error", "Row", "bench"]
