"""Format measured rows as tables for the terminal and for Markdown pages."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

from hyrfpack.bench.rows import Row
from hyrfpack.bench.suite import BenchReport
from hyrfpack.errors import HyrfError
from hyrfpack.measure.machine import format_machine
from hyrfpack.measure.timing import Timing

PART_TABLE_TITLES = {"codec": "error of each group of parameters", "rasterize": "error of each gradient"}
BLOCK_END = "<!-- end -->"


@dataclass(frozen=True)
class Table:
    """A title, column heads, and the cells of each row."""

    title: str
    header: list[str]
    cells: list[list[str]]


def build_tables(rows: Sequence[Row]) -> list[Table]:
    """Build a table for each group, and a second one for groups with errors of parts; empty columns are left out."""
    tables = []
    for group in dict.fromkeys(row.group for row in rows):
        group_rows = [row for row in rows if row.group == group]
        codec = group == "codec"
        columns: dict[str, Callable[[Row], str]] = {
            "setting": lambda row: row.setting,
            "value": lambda row: row.value,
            "": lambda row: ", ".join(
                word for word, applies in (("reference", row.is_reference), ("default", row.is_default)) if applies
            ),
            "encode ms" if codec else "ms": lambda row: _format_time(row.time),
            "ratio": lambda row: _format_number(row.ratio.wall),
            "cpu ms": lambda row: _format_number(row.time.work_ms),
            "cpu ratio": lambda row: _format_number(row.ratio.work),
            "decode ms": lambda row: _format_time(row.decode) if row.decode else "",
            "decode ratio": lambda row: _format_number(row.decode_ratio.wall) if row.decode_ratio else "",
            "max error": lambda row: _format_error(row.error.max),
            "rms error": lambda row: _format_error(row.error.rms),
            "PSNR": lambda row: _format_number(row.psnr if row.psnr_drop is None else None, ".2f"),
            "SSIM": lambda row: _format_number(row.ssim if row.ssim_drop is None else None, ".5f"),
            "PSNR drop": lambda row: _format_number(row.psnr_drop, ".3f"),
            "SSIM drop": lambda row: _format_number(row.ssim_drop, ".5f"),
            "bytes": lambda row: "" if row.bytes is None else f"{row.bytes:,}",
        }
        tables.append(_build_table(group, columns, group_rows))
        if group in PART_TABLE_TITLES:
            parts = list(dict.fromkeys(part for row in group_rows for part in row.parts))
            columns = {head: columns[head] for head in ("setting", "value")}
            columns |= {part: partial(_format_part, part=part) for part in parts}
            title = f"{group}: {PART_TABLE_TITLES[group]}, max / rms"
            rows_with_parts = [row for row in group_rows if row.parts and not row.is_reference]
            tables.append(_build_table(title, columns, rows_with_parts))
    return tables


def format_markdown(report: BenchReport) -> dict[str, str]:
    """Format the tables of each group as Markdown by the group's name, and the machine and model under "machine"."""
    about = [f"Machine: {format_machine(report.machine)}.", f"Model: {report.subject}.", *report.notes]
    blocks = {"machine": "\n".join(f"- {sentence}" for sentence in about)}
    for table in build_tables(report.rows):
        ruler = ["---" if column < 3 else "--:" for column in range(len(table.header))]
        lines = "\n".join("| " + " | ".join(cells) + " |" for cells in (table.header, ruler, *table.cells))
        name, _, explained = table.title.partition(": ")
        blocks[name] = blocks[name] + f"\n\n{explained[0].upper()}{explained[1:]}:\n\n{lines}" if explained else lines
    return blocks


def fill_page(text: str, blocks: dict[str, str], name: str = "the page") -> str:
    """Insert blocks into a Markdown page, each between the lines `<!-- bench NAME -->` and `<!-- end -->`.

    Text between such lines for other blocks does not change.

    Args:
        text: the page.
        blocks: Markdown text by block name.
        name: name of the page in error messages.

    Raises:
        HyrfError: the page lacks the lines for a block.
    """
    for key, block in blocks.items():
        start = f"<!-- bench {key} -->"
        block_match = re.search(f"^{re.escape(start)}\n(.*?)^{BLOCK_END}$", text, re.MULTILINE | re.DOTALL)
        if block_match is None:
            raise HyrfError(
                f"{name}: there is no place for {key}",
                fix=f"add the lines '{start}' and '{BLOCK_END}' to it",
            )
        text = f"{text[: block_match.start(1)]}\n{block}\n\n{text[block_match.end(1) :]}"
    return text


def empty_page(blocks: dict[str, str]) -> str:
    """Make a Markdown page with a heading and empty insertion marks for each block."""
    return "\n".join(f"## {key}\n\n<!-- bench {key} -->\n{BLOCK_END}\n" for key in blocks)


def _build_table(title: str, columns: dict[str, Callable[[Row], str]], rows: Sequence[Row]) -> Table:
    """Format the cells of a table and drop columns that are empty in all rows."""
    cells = [[format_cell(row) for format_cell in columns.values()] for row in rows]
    filled_columns = [number for number in range(len(columns)) if any(line[number] for line in cells)]
    header = list(columns)
    return Table(
        title,
        [header[number] for number in filled_columns],
        [[line[number] for number in filled_columns] for line in cells],
    )


def _format_time(time: Timing) -> str:
    """Format the median and the spread of a time in milliseconds."""
    return _format_number(time.ms) + ("" if time.spread_ms is None else f" ± {_format_number(time.spread_ms, '.2g')}")


def _format_part(row: Row, part: str) -> str:
    """Format the error of one part of a row, "" if the row has none."""
    error = row.parts.get(part)
    return "" if error is None else f"{_format_error(error.max)} / {_format_error(error.rms)}"


def _format_error(value: float) -> str:
    """Format an error in scientific notation with two digits, 0 as "0"."""
    return f"{value:.1e}" if value else "0"


def _format_number(value: float | None, form: str = ".3g") -> str:
    """Format a number, None as ""; large numbers get thousands separators instead of an exponent."""
    if value is None:
        return ""
    return f"{value:,.0f}" if form.endswith("g") and abs(value) >= 100 else f"{value:{form}}"
