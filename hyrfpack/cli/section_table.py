"""The table of the sections of a `.hyrf` file, which `hyrfpack info` and `compress` print."""

from __future__ import annotations

from hyrfpack.cli.common import format_table


def format_section_table(
    sections: list[dict], total: int, gaussians: int, shares: dict[str, float] | None = None
) -> str:
    """Format a table of the bytes of each section, summed over its layers, and of its share of the loss if known."""
    from hyrfpack.format.sections import NON_PARAMETER_SECTIONS, SECTION_CONTENTS, group_and_layer

    together: dict[str, list] = {}
    for part in sections:
        tag = group_and_layer(part["type"])[0]
        sizes = together.setdefault(tag, [SECTION_CONTENTS.get(tag, part["holds"]), 0, 0])
        sizes[1] += part["before"]
        sizes[2] += part["after"]
    parts = [(tag, holds, f"{before:,}", after) for tag, (holds, before, after) in together.items()]
    parts.append(("", "header, table of contents, padding", "", total - sum(after for *_, after in parts)))
    rows, header = [], ["section", "unpacked bytes", "stored bytes", "share", "bits/Gaussian", "bits/number"]
    for tag, holds, before, after in parts:
        numbers = int(before.replace(",", "") or 0) / 4 if tag not in (*NON_PARAMETER_SECTIONS, "") else 0
        rows.append(
            [
                f"{tag} {holds}".strip(),
                before,
                f"{after:,}",
                f"{after / total:.1%}",
                f"{8 * after / max(gaussians, 1):.2f}",
                f"{8 * after / numbers:.2f}" if numbers else "",
            ]
        )
        if shares:
            rows[-1].append(f"{shares[tag]:.1%}" if tag in shares else "")
    if shares:
        left_out = sum(share for part, share in shares.items() if part not in together)
        rows.append(["Gaussians left out", "", "", "", "", "", f"{left_out:.1%}"])
    return format_table([*header, *(["of the loss"] if shares else [])], rows)
