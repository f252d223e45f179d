"""Rows of the results: plain dictionaries, one for each line of a table.

"table" names the table that a row belongs to, "status" is "failed" or "left out" unless all is well, with the reason
under "note". All other keys are columns.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

Row = dict[str, object]

KERNELS_TOLD = 15


def goal(name: str, measured: float, wanted: float, unit: str, *, at_least: bool) -> Row:
    """A measured number beside what is aimed at. To miss it is no failure of the check."""
    met = measured >= wanted if at_least else measured <= wanted
    sign = "at least" if at_least else "at most"
    row: Row = {"table": "Goals", "goal": f"{name}: {sign} {wanted:g} {unit}", "measured": f"{measured:.3g} {unit}"}
    return row | {"met": "yes" if met else "no"}


def kernel_rows(times: Mapping[str, float], table: str) -> Iterator[Row]:
    """The longest of the device's kernels, in milliseconds, with their shares of all."""
    total = sum(times.values())
    for name, ms in list(times.items())[:KERNELS_TOLD]:
        yield {"table": table, "kernel": name[:90], "ms": ms, "share": f"{ms / total:.1%}"}
