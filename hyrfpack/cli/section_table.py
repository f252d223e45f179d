"""The table of the sections of a `.hyrf` file, which `hyrfpack info` and `compress` print."""

from __future__ import annotations

from collections.abc import Iterable

from hyrfpack.cli.common import format_table
from hyrfpack.format.info import SectionSize, sum_layers


def format_section_table(
    sections: Iterable[SectionSize], total: int, gaussians: int, shares: dict[str, float] | None = None
) -> str:
    """Format a table of the bytes of each section, summed over its layers, and of its share of the loss if known.

    Args:
        sections: sizes of all sections of a file.
        total: bytes of the file.
        gaussians: number of its Gaussians.
        shares: shares of the loss by section, as in `hyrfpack.CompressionReport`.
    """
    parts = sum_layers(sections)
    overhead = SectionSize("", "header, table of contents, padding", 0, total - sum(part.after for part in parts))
    header = ["section", "unpacked bytes", "stored bytes", "share", "bits/Gaussian", "bits/number"]
    rows = []
    stored = {part.type for part in parts}
    if stored.isdisjoint(shares or ()):  # each part of a merged file has sections of its own, which are not listed
        shares = None
    for part in (*parts, overhead):
        row = [
            f"{part.type} {part.holds}".strip(),
            f"{part.before:,}" if part.type else "",
            f"{part.after:,}",
            f"{part.after / total:.1%}",
            f"{8 * part.after / max(gaussians, 1):.2f}",
            f"{8 * part.after / part.parameters:.2f}" if part.parameters else "",
        ]
        rows.append([*row, f"{shares[part.type]:.1%}" if part.type in shares else ""] if shares else row)
    if shares:
        header.append("of the loss")
        left_out = sum(share for part, share in shares.items() if part not in stored)
        rows.append(["Gaussians left out", "", "", "", "", "", f"{left_out:.1%}"])
    return format_table(header, rows)
