"""The files below `hyrfpack/web` that pages are made of."""

from __future__ import annotations

from collections.abc import Iterator
from importlib.resources import files


def read_web_file(path: str) -> str:
    """Return the text of a file below `hyrfpack/web`, with "\\n" at the ends of lines."""
    return files("hyrfpack.web").joinpath(*path.split("/")).read_text("utf-8")


def list_web_files(folder: str, *suffixes: str) -> list[str]:
    """Return the sorted paths, relative to `hyrfpack/web`, of the files with these suffixes in a folder and below."""

    def walk(path: str) -> Iterator[str]:
        for entry in files("hyrfpack.web").joinpath(*path.split("/")).iterdir():
            if entry.is_dir():
                yield from walk(f"{path}/{entry.name}")
            elif entry.name.endswith(suffixes):
                yield f"{path}/{entry.name}"

    return sorted(walk(folder))
