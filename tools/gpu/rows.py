"""Make rows of the results: plain dictionaries, one for each row of a table.

"table" names the table that a row belongs to. "status" is "failed" or "left out", with the reason under "note"; a row
without "status" passed. All other keys are columns.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

Row = dict[str, object]

MAX_KERNEL_ROWS = 15


def make_goal_row(name: str, measured: float, target: float, unit: str, *, at_least: bool) -> Row:
    """Return a row that compares a measured number with its goal; a missed goal does not fail the check."""
    met = measured >= target if at_least else measured <= target
    sign = "at least" if at_least else "at most"
    row: Row = {"table": "Goals", "goal": f"{name}: {sign} {target:g} {unit}", "measured": f"{measured:.3g} {unit}"}
    return row | {"met": "yes" if met else "no"}


def make_kernel_rows(times: Mapping[str, float], table: str) -> Iterator[Row]:
    """Yield rows of the kernels that take longest on the device: milliseconds and share of the total."""
    total = sum(times.values())
    for name, ms in list(times.items())[:MAX_KERNEL_ROWS]:
        yield {"table": table, "kernel": name[:90], "ms": ms, "share": f"{ms / total:.1%}"}
