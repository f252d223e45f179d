"""Rows as tables of words: for the terminal and for Markdown pages."""

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

PARTS = {"codec": "error of each group of parameters", "rasterize": "error of each gradient"}
END = "<!-- end -->"


@dataclass(frozen=True)
class Table:
    """A title, column heads, and cells by row."""

    title: str
    header: list[str]
    cells: list[list[str]]


def tables(rows: Sequence[Row]) -> list[Table]:
    """One table for each group, and one more where errors of parts are told; columns without content are left out."""
    made = []
    for group in dict.fromkeys(row.group for row in rows):
        here = [row for row in rows if row.group == group]
        codec = group == "codec"
        columns: dict[str, Callable[[Row], str]] = {
            "setting": lambda row: row.setting,
            "value": lambda row: row.value,
            "": lambda row: ", ".join(
                word for word, told in (("reference", row.is_reference), ("default", row.is_default)) if told
            ),
            "encode ms" if codec else "ms": lambda row: _time(row.time),
            "ratio": lambda row: _number(row.ratio.wall),
            "cpu ms": lambda row: _number(row.time.work_ms),
            "cpu ratio": lambda row: _number(row.ratio.work),
            "decode ms": lambda row: _time(row.decode) if row.decode else "",
            "decode ratio": lambda row: _number(row.decode_ratio.wall) if row.decode_ratio else "",
            "max error": lambda row: _error(row.error.max),
            "rms error": lambda row: _error(row.error.rms),
            "PSNR": lambda row: _number(row.psnr if row.psnr_drop is None else None, ".2f"),
            "SSIM": lambda row: _number(row.ssim if row.ssim_drop is None else None, ".5f"),
            "PSNR drop": lambda row: _number(row.psnr_drop, ".3f"),
            "SSIM drop": lambda row: _number(row.ssim_drop, ".5f"),
            "bytes": lambda row: "" if row.bytes is None else f"{row.bytes:,}",
        }
        made.append(_table(group, columns, here))
        if group in PARTS:
            parts = list(dict.fromkeys(part for row in here for part in row.parts))
            columns = {head: columns[head] for head in ("setting", "value")}
            columns |= {part: partial(_part, part=part) for part in parts}
            title = f"{group}: {PARTS[group]}, max / rms"
            made.append(_table(title, columns, [row for row in here if row.parts and not row.is_reference]))
    return made


def markdown(report: BenchReport) -> dict[str, str]:
    """The tables of each group as Markdown, and under "machine" what they were measured with."""
    about = [f"Machine: {format_machine(report.machine)}.", f"Model: {report.subject}.", *report.notes]
    blocks = {"machine": "\n".join(f"- {sentence}" for sentence in about)}
    for table in tables(report.rows):
        ruler = ["---" if column < 3 else "--:" for column in range(len(table.header))]
        lines = "\n".join("| " + " | ".join(cells) + " |" for cells in (table.header, ruler, *table.cells))
        name, _, explained = table.title.partition(": ")
        blocks[name] = blocks[name] + f"\n\n{explained[0].upper()}{explained[1:]}:\n\n{lines}" if explained else lines
    return blocks


def fill(text: str, blocks: dict[str, str], name: str = "the page") -> str:
    """Put blocks into a Markdown page, each between the lines `<!-- bench NAME -->` and `<!-- end -->`.

    Places for blocks that were not made stay as they are.

    Raises:
        HyrfError: the page has no place for a block, or one does not end; `name` is what the message calls it.
    """
    for key, block in blocks.items():
        start = f"<!-- bench {key} -->"
        place = re.search(f"^{re.escape(start)}\n(.*?)^{END}$", text, re.MULTILINE | re.DOTALL)
        if place is None:
            raise HyrfError(f"{name}: there is no place for {key}; add the lines '{start}' and '{END}' to it")
        text = f"{text[: place.start(1)]}\n{block}\n\n{text[place.end(1) :]}"
    return text


def empty_page(blocks: dict[str, str]) -> str:
    """A page with a heading and a place for each block."""
    return "\n".join(f"## {key}\n\n<!-- bench {key} -->\n{END}\n" for key in blocks)


def _table(title: str, columns: dict[str, Callable[[Row], str]], rows: Sequence[Row]) -> Table:
    cells = [[tell(row) for tell in columns.values()] for row in rows]
    kept = [number for number in range(len(columns)) if any(line[number] for line in cells)]
    header = list(columns)
    return Table(title, [header[number] for number in kept], [[line[number] for number in kept] for line in cells])


def _time(time: Timing) -> str:
    return _number(time.ms) + ("" if time.spread_ms is None else f" ± {_number(time.spread_ms, '.2g')}")


def _part(row: Row, part: str) -> str:
    error = row.parts.get(part)
    return "" if error is None else f"{_error(error.max)} / {_error(error.rms)}"


def _error(value: float) -> str:
    return f"{value:.1e}" if value else "0"


def _number(value: float | None, form: str = ".3g") -> str:
    if value is None:
        return ""
    return f"{value:,.0f}" if form.endswith("g") and abs(value) >= 100 else f"{value:{form}}"
