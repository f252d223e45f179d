"""Write results of tools as JSON files, so that an interrupted call loses none that were stored before."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

from hyrfpack.atomic import write_atomic


def write_json(path: Path, content: object) -> None:
    """Write a value as JSON in one piece, and its folder if it is missing; a file of this name is replaced.

    Raises:
        HyrfError: the file or its folder cannot be written.
    """
    write_atomic(path, (json.dumps(content, indent=1) + "\n").encode())


def merge_rows(path: Path, rows: Sequence[dict], keys: Sequence[str]) -> None:
    """Add rows to a JSON file of rows; each replaces the one with the same values of `keys`."""
    stored = json.loads(path.read_text()) if path.exists() else []
    merged = {tuple(row.get(key) for key in keys): row for row in (*stored, *rows)}
    write_json(path, list(merged.values()))
