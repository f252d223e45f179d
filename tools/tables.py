"""Format rows as Markdown tables."""

from __future__ import annotations

from collections.abc import Sequence


def markdown_row(cells: Sequence[str]) -> str:
    """Return one row of a Markdown table."""
    return "| " + " | ".join(cells) + " |"


def markdown_table(columns: Sequence[str], rows: Sequence[Sequence[str]], ruler: Sequence[str] | None = None) -> str:
    """Return a Markdown table.

    Args:
        columns: the column titles.
        rows: the cells of each row.
        ruler: one alignment marker for each column, such as "--:" for right-aligned; left-aligned without it.
    """
    return "\n".join(map(markdown_row, (columns, ruler or ["---"] * len(columns), *rows)))


def format_cell(value: object) -> str:
    """Return a number or text in few characters: floats with 3 digits, None as an empty string."""
    if value is None:
        return ""
    if isinstance(value, float):
        small = value != 0 and abs(value) < 1e-3
        return f"{value:.1e}" if small else f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.3g}"
    return f"{value:,}" if isinstance(value, int) and not isinstance(value, bool) else str(value)
