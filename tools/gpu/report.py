"""The results as a JSON file and as a Markdown page, and what machine they belong to."""

from __future__ import annotations

import json
import platform
import re
import subprocess
from collections.abc import Sequence
from datetime import datetime, timezone
from pathlib import Path

import torch

from hyrfpack.measure.machine import format_machine, package_versions
from tools.gpu.rows import Row
from tools.tables import cell, markdown

ROOT = Path(__file__).parents[2]
HIDDEN = ("table", "part", "item", "status", "note")
FIRST = ("Goals", "Failed and left out")
WORDS_TOLD = 2  # of a row that failed: enough to say which it is


def machine(device: torch.device) -> dict[str, object]:
    """What the numbers belong to: the card and its driver, package_versions, the commit, the day."""
    facts: dict[str, object] = {"device": machine_name(device)}
    if device.type == "cuda":
        properties = torch.cuda.get_device_properties(device)
        facts["memory GB"] = round(properties.total_memory / 1e9, 1)
        facts["multiprocessors"] = properties.multi_processor_count
        facts["driver"] = _output("nvidia-smi", "--query-gpu=driver_version", "--format=csv,noheader")
        facts["cuda or rocm"] = torch.version.cuda or torch.version.hip
    facts |= {"python": platform.python_version(), "torch": torch.__version__}
    facts |= package_versions("triton", "numpy", "numba", "gsplat")
    facts["commit"] = _output("git", "-C", str(ROOT), "describe", "--always", "--dirty", "--abbrev=12")
    facts["date"] = datetime.now(timezone.utc).strftime("%Y-%m-%d %H:%M UTC")
    return facts


def machine_name(device: torch.device) -> str:
    """The card as its driver calls it."""
    return torch.cuda.get_device_name(device) if device.type == "cuda" else f"{platform.machine()} CPU"


def file_name(name: str) -> str:
    """A machine's name as that of a file: "NVIDIA H200" becomes "nvidia-h200"."""
    return re.sub(r"[^a-z0-9]+", "-", name.lower()).strip("-")


def write(folder: Path, facts: dict[str, object], settings: dict[str, object], rows: Sequence[Row]) -> Path:
    """Write `<machine>.json` and `<machine>.md`; returns the path of the page."""
    folder.mkdir(parents=True, exist_ok=True)
    page = folder / f"{file_name(str(facts['device']))}.md"
    content = {"machine": facts, "settings": settings, "rows": list(rows)}
    page.with_suffix(".json").write_text(json.dumps(content, indent=1) + "\n")
    page.write_text(text(facts, rows))
    return page


def text(facts: dict[str, object], rows: Sequence[Row]) -> str:
    """The page: the machine, the goals, what failed, then a table for each kind of row."""
    told = format_machine({key: value for key, value in facts.items() if key != "device" and value is not None})
    lines = [f"# {facts['device']}", "", f"Written by `python -m tools.gpu.check`: {told}.", ""]
    lines += ["How to read it: [README.md](README.md).", ""]
    tables: dict[str, list[Row]] = {name: [] for name in FIRST}
    for row in rows:
        if row.get("status"):
            words = [value for key, value in row.items() if key not in HIDDEN and isinstance(value, str)]
            what = ", ".join(words[:WORDS_TOLD])
            where = f"{row.get('part', '')}: {row.get('item', '')}"
            told_row = {"where": where, "what": what, "status": row["status"], "reason": row.get("note", "")}
            tables["Failed and left out"].append(told_row)
        if "table" in row and row.get("status") != "left out" and any(key not in HIDDEN for key in row):
            tables.setdefault(str(row["table"]), []).append(row)
    for name, here in tables.items():
        if here:
            lines += [f"## {name}", "", table(here), ""]
        elif name == "Failed and left out":
            lines += ["Nothing failed, nothing was left out.", ""]
    return "\n".join(lines)


def table(rows: Sequence[Row]) -> str:
    """Rows as a Markdown table: a column for each key, in order of appearance; numbers to the right."""
    hidden = set(HIDDEN) - ({"status"} if any("where" in row for row in rows) else set())
    keys = list(dict.fromkeys(key for row in rows for key in row if key not in hidden))
    keys = [key for key in keys if any(row.get(key) is not None for row in rows)]
    if any(row.get("status") for row in rows) and "status" not in keys:
        keys.append("status")
    ruler = ["--:" if any(isinstance(row.get(key), (int, float)) for row in rows) else "---" for key in keys]
    cells = [[cell(row.get(key)).replace("|", "\\|").replace("\n", " ") for key in keys] for row in rows]
    return markdown(keys, cells, ruler)


def _output(*command: str) -> str | None:
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=20)
    except (OSError, subprocess.TimeoutExpired):
        return None
    lines = done.stdout.split("\n")
    return lines[0].strip() or None
