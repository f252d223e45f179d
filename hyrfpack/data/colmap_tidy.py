"""COLMAP models as other programs and hands leave them, made such that pycolmap reads them.

Its reader of text takes a photo's name to end at the first space and stumbles over a byte-order mark, and it refuses
a model without points.
"""

from __future__ import annotations

import codecs
import struct
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from hyrfpack.errors import HyrfDataError

_U64 = struct.Struct("<Q")
_NO_POINTS = {".bin": _U64.pack(0), ".txt": b"# Number of points: 0\n"}
_BEFORE_NAME = 64  # bytes of a photo in images.bin: id, pose, camera


@contextmanager
def tidied(model: Path, kind: str) -> Iterator[Path]:
    """A folder that pycolmap can read: the model itself, or a copy for the time being of one that needs it.

    Args:
        model: its folder, whose binary tables are checked.
        kind: ".bin" or ".txt".
    """
    tables = {name: model / f"{name}{kind}" for name in ("cameras", "images", "points3D", "rigs", "frames")}
    pointless = not tables["points3D"].is_file()
    marked = kind == ".txt" and any(_is_marked(file) for file in tables.values())
    if not (pointless or marked):
        yield model
        return
    with tempfile.TemporaryDirectory(prefix="hyrfpack-") as folder:
        for name, file in tables.items():
            if file.is_file():
                content = file.read_bytes().removeprefix(codecs.BOM_UTF8 if kind == ".txt" else b"")
                if pointless and name == "images":
                    content = _without_observations(content) if kind == ".bin" else _without_marks(content)
                Path(folder, file.name).write_bytes(content)
        if pointless:
            Path(folder, tables["points3D"].name).write_bytes(_NO_POINTS[kind])
        yield Path(folder)


def names_in_text(file: Path) -> dict[int, str]:
    """Image id -> name from images.txt, whatever is after the ninth space of a line, spaces in it, too."""
    names = {}
    for line in _heads(_text(file)):
        fields = line.split(maxsplit=9)
        if len(fields) == 10 and fields[0].isdecimal():
            names[int(fields[0])] = fields[9].strip()
    return names


def _text(file: Path) -> str:
    try:
        content = file.read_bytes().removeprefix(codecs.BOM_UTF8)
    except OSError as error:
        raise HyrfDataError(f"{file}: cannot be read ({error.strerror}); check its permissions") from error
    try:
        return content.decode()
    except UnicodeDecodeError:
        return content.decode("cp1252", errors="replace")  # what Windows wrote before it knew UTF-8


def _heads(text: str) -> Iterator[str]:
    """The first of the two lines that each photo has; the second, of its 2D points, may be empty."""
    lines = iter(text.split("\n"))
    for line in lines:
        if line.strip() and not line.lstrip().startswith("#"):
            yield line
            next(lines, None)


def _without_marks(content: bytes) -> bytes:
    heads = [line.rstrip() for line in _heads(content.decode(errors="replace"))]
    return "".join(f"{head}\n\n" for head in heads).encode()


def _without_observations(content: bytes) -> bytes:
    """images.bin with the same photos and no 2D point, for these name 3D points."""
    (count,) = _U64.unpack_from(content)
    at, kept = 8, [content[:8]]
    for _ in range(count):
        end = content.index(b"\0", at + _BEFORE_NAME) + 1
        (observations,) = _U64.unpack_from(content, end)
        kept += [content[at:end], _U64.pack(0)]
        at = end + 8 + 24 * observations
    return b"".join(kept)


def _is_marked(file: Path) -> bool:
    if not file.is_file():
        return False
    with file.open("rb") as stream:
        return stream.read(3) == codecs.BOM_UTF8
