"""Format rows as Markdown tables."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import TypeVar

from hyrfpack.errors import HyrfError

T = TypeVar("T")


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


def print_measured_table(
    columns: Sequence[str], subjects: Iterable[T], measure: Callable[[T], Iterable[Sequence[str]]]
) -> None:
    """Print a Markdown table, each row as soon as it is made; an error of a subject becomes its row.

    Args:
        columns: the column titles.
        subjects: what is measured, such as data sets or files; the first cell of an error's row.
        measure: yields the rows of one subject.
    """
    print(markdown_table(columns, []), flush=True)
    for subject in subjects:
        try:
            for row in measure(subject):
                print(markdown_row(row), flush=True)
        except HyrfError as error:
            print(markdown_row([str(subject), str(error), *[""] * (len(columns) - 2)]), flush=True)


def format_cell(value: object) -> str:
    """Return a number or text in few characters: floats with 3 digits, None as an empty string."""
    if value is None:
        return ""
    if isinstance(value, float):
        small = value != 0 and abs(value) < 1e-3
        return f"{value:.1e}" if small else f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.3g}"
    return f"{value:,}" if isinstance(value, int) and not isinstance(value, bool) else str(value)
