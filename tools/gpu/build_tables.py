"""Format reports of `tools.gpu.build` as tables."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

COMPARED_TARGETS = ("sm_86", "sm_89", "sm_90", "sm_120")


def format_table(report: dict[str, Any]) -> Iterator[str]:
    """Yield the lines of a table with the largest values over all builds of each kernel and target, and all errors."""
    rows: dict[tuple[str, str, int], list[dict]] = {}
    for row in report["builds"]:
        if not row["error"]:
            rows.setdefault((row["kernel"], row["target"], row["warps"]), []).append(row)
    yield f"Triton {report['triton']}"
    yield f"{'kernel':40} {'target':8} {'warps':>5} {'builds':>6} {'registers':>9} {'shared':>7} {'spills':>6}"
    for (kernel, target, warps), builds in sorted(rows.items()):
        registers, shared, spills = (max(row[key] for row in builds) for key in ("registers", "shared", "spills"))
        yield f"{kernel:40} {target:8} {warps:5} {len(builds):6} {registers:9} {shared:7} {spills:6}"
    for row in report["builds"]:
        if row["spills"] or row["error"]:
            yield f"{row['kernel']} on {row['target']}: {row['error'] or 'spills'} {row['constants']}"
    for row in report["builds"]:
        if row["sass"]:
            facts = ", ".join(f"{name.replace('_', ' ')} {value}" for name, value in row["sass"].items() if value)
            yield f"{row['kernel']} on {row['target']}: {facts} {row['constants']}"
    for row in report["probes"]:
        if row["error"]:
            yield f"{row['target']}: Triton cannot build for this target: {row['error']}"
    for kernel in report["left_out"]:
        yield f"{kernel}: no operation launches it"


def format_comparison(reports: Sequence[dict[str, Any]]) -> Iterator[str]:
    """Yield the lines of a Markdown table: registers of each kernel on COMPARED_TARGETS, "+ n" for n bytes of spills.

    A cell has the largest values over all builds, for each report in turn where they differ.
    """
    yield f"| kernel | {' | '.join(COMPARED_TARGETS)} |"
    yield f"|---|{'---|' * len(COMPARED_TARGETS)}"
    for kernel in sorted({row["kernel"] for report in reports for row in report["builds"]}):
        cells = []
        for target in COMPARED_TARGETS:
            values = []
            for report in reports:
                rows = [row for row in report["builds"] if (row["kernel"], row["target"]) == (kernel, target)]
                registers, spills = (max((row[key] for row in rows), default=0) for key in ("registers", "spills"))
                values.append(f"{registers} + {spills}" if spills else f"{registers}")
            cells.append(" / ".join(dict.fromkeys(values)))
        yield f"| `{kernel}` | {' | '.join(cells)} |"
