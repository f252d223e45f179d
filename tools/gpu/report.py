"""Write the results as a JSON file and as a Markdown page, with a description of the machine."""

from __future__ import annotations

import platform
import re
import subprocess
from collections.abc import Sequence
from datetime import datetime, timezone
from pathlib import Path

import torch

from hyrfpack.atomic import write_atomic
from hyrfpack.measure.machine import driver_version, format_machine, package_versions
from tools.gpu.rows import Row
from tools.json_files import write_json
from tools.tables import format_cell, markdown_table

REPOSITORY_ROOT = Path(__file__).parents[2]
HIDDEN_KEYS = ("table", "part", "item", "status", "note")
LEADING_TABLES = ("Goals", "Failed and left out")
FAILURE_LABEL_CELLS = 2  # the first two text cells are enough to identify a failed row


def describe_gpu_machine(device: torch.device, commit: str | None = None) -> dict[str, object]:
    """Return the facts that the numbers depend on: GPU, driver, package versions, commit and date.

    Args:
        device: the device that is measured.
        commit: the commit of this copy of the repository; None asks git.
    """
    facts: dict[str, object] = {"device": read_device_name(device)}
    if device.type == "cuda":
        properties = torch.cuda.get_device_properties(device)
        facts["memory GB"] = round(properties.total_memory / 1e9, 1)
        facts["multiprocessors"] = properties.multi_processor_count
        facts["driver"] = driver_version()
        facts |= _query_nvidia_smi()
        facts["cuda or rocm"] = torch.version.cuda or torch.version.hip
    facts |= {"python": platform.python_version(), "torch": torch.__version__}
    facts |= package_versions("triton", "numpy", "numba", "gsplat")
    facts["commit"] = commit or _first_output_line(
        "git", "-C", str(REPOSITORY_ROOT), "describe", "--always", "--dirty", "--abbrev=12"
    )
    facts["date"] = datetime.now(timezone.utc).strftime("%Y-%m-%d %H:%M UTC")
    return facts


def _query_nvidia_smi() -> dict[str, object]:
    """Return what nvidia-smi says of power, clocks and load of the GPU; nothing where it is missing."""
    names = (
        "power.limit",
        "clocks.max.sm",
        "clocks.max.memory",
        "temperature.gpu",
        "utilization.gpu",
        "mig.mode.current",
    )
    line = _first_output_line("nvidia-smi", f"--query-gpu={','.join(names)}", "--format=csv,noheader")
    values = [value.strip() for value in line.split(",")] if line else []
    return dict(zip(names, values, strict=True)) if len(values) == len(names) else {}


def read_device_name(device: torch.device) -> str:
    """Return the driver's name of the GPU, or the processor type for a CPU."""
    return torch.cuda.get_device_name(device) if device.type == "cuda" else f"{platform.machine()} CPU"


def make_file_name(name: str) -> str:
    """Return a device's name as a file name without ending: "NVIDIA H200" becomes "nvidia-h200"."""
    return re.sub(r"[^a-z0-9]+", "-", name.lower()).strip("-")


def write_report(page: Path, facts: dict[str, object], settings: dict[str, object], rows: Sequence[Row]) -> None:
    """Write a page and, beside it, a JSON file of the same name."""
    write_json(page.with_suffix(".json"), {"machine": facts, "settings": settings, "rows": list(rows)})
    write_atomic(page, format_page(facts, rows).encode())


def format_page(facts: dict[str, object], rows: Sequence[Row]) -> str:
    """Format the Markdown page: the machine, the goals, the failed rows, then one table for each kind of row."""
    machine_line = format_machine({key: value for key, value in facts.items() if key != "device" and value is not None})
    lines = [f"# {facts['device']}", "", f"Written by `python -m tools.gpu.check`: {machine_line}.", ""]
    lines += ["How to read it: [README.md](README.md).", ""]
    tables: dict[str, list[Row]] = {name: [] for name in LEADING_TABLES}
    for row in rows:
        if row.get("status"):
            labels = [value for key, value in row.items() if key not in HIDDEN_KEYS and isinstance(value, str)]
            what = ", ".join(labels[:FAILURE_LABEL_CELLS])
            where = f"{row.get('part', '')}: {row.get('item', '')}"
            failure_row = {"where": where, "what": what, "status": row["status"], "reason": row.get("note", "")}
            tables["Failed and left out"].append(failure_row)
        if "table" in row and row.get("status") != "left out" and any(key not in HIDDEN_KEYS for key in row):
            tables.setdefault(str(row["table"]), []).append(row)
    for name, table_rows in tables.items():
        if table_rows:
            lines += [f"## {name}", "", format_table(table_rows), ""]
        elif name == "Failed and left out":
            lines += ["Nothing failed and nothing was left out.", ""]
    return "\n".join(lines)


def format_table(rows: Sequence[Row]) -> str:
    """Format rows as a Markdown table: one column for each key, in order of appearance; numbers to the right."""
    hidden = set(HIDDEN_KEYS) - ({"status"} if any("where" in row for row in rows) else set())
    keys = list(dict.fromkeys(key for row in rows for key in row if key not in hidden))
    keys = [key for key in keys if any(row.get(key) is not None for row in rows)]
    if any(row.get("status") for row in rows) and "status" not in keys:
        keys.append("status")
    ruler = ["--:" if any(isinstance(row.get(key), (int, float)) for row in rows) else "---" for key in keys]
    cells = [[format_cell(row.get(key)).replace("|", "\\|").replace("\n", " ") for key in keys] for row in rows]
    return markdown_table(keys, cells, ruler)


def _first_output_line(*command: str) -> str | None:
    try:
        process = subprocess.run(command, capture_output=True, text=True, timeout=20)
    except (OSError, subprocess.TimeoutExpired):
        return None
    lines = process.stdout.split("\n")
    return lines[0].strip() or None
