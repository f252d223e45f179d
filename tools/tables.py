"""Rows as tables: what all tools print their results with."""

from __future__ import annotations

from collections.abc import Sequence


def line(cells: Sequence[str]) -> str:
    """One row of a Markdown table."""
    return "| " + " | ".join(cells) + " |"


def markdown(columns: Sequence[str], rows: Sequence[Sequence[str]], ruler: Sequence[str] | None = None) -> str:
    """A Markdown table; `ruler` says which columns are aligned how ("--:" to the right)."""
    return "\n".join(map(line, (columns, ruler or ["---"] * len(columns), *rows)))


def cell(value: object) -> str:
    """A number or words in few characters; nothing for None."""
    if value is None:
        return ""
    if isinstance(value, float):
        small = value != 0 and abs(value) < 1e-3
        return f"{value:.1e}" if small else f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.3g}"
    return f"{value:,}" if isinstance(value, int) and not isinstance(value, bool) else str(value)
