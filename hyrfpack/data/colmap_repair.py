"""Repair copies of COLMAP models that other programs wrote or people edited, so that pycolmap can read them.

pycolmap's reader of text tables cuts a photo's name at the first space and fails on a byte-order mark. It also rejects
a model without points.
"""

from __future__ import annotations

import codecs
import math
import struct
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from hyrfpack.data.text_files import read_text
from hyrfpack.errors import HyrfDataError

_U64_STRUCT = struct.Struct("<Q")
_EMPTY_POINT_TABLES = {".bin": _U64_STRUCT.pack(0), ".txt": b"# Number of points: 0\n"}
_IMAGE_RECORD_HEADER_BYTES = 64  # id, pose and camera, before the name in images.bin


@contextmanager
def readable_model(model: Path, kind: str) -> Iterator[Path]:
    """Yield a folder that pycolmap can read: the model's own, or a temporary one with a repaired copy.

    Args:
        model: folder of the model, whose binary tables have been checked.
        kind: ".bin" or ".txt".
    """
    tables = {name: model / f"{name}{kind}" for name in ("cameras", "images", "points3D", "rigs", "frames")}
    lacks_points = not tables["points3D"].is_file()
    has_mark = kind == ".txt" and any(_has_byte_order_mark(file) for file in tables.values())
    if not (lacks_points or has_mark):
        yield model
        return
    with tempfile.TemporaryDirectory(prefix="hyrfpack-") as folder:
        for name, file in tables.items():
            if file.is_file():
                content = file.read_bytes().removeprefix(codecs.BOM_UTF8 if kind == ".txt" else b"")
                if lacks_points and name == "images":
                    remove = _remove_binary_observations if kind == ".bin" else _remove_text_observations
                    content = remove(content)
                Path(folder, file.name).write_bytes(content)
        if lacks_points:
            Path(folder, tables["points3D"].name).write_bytes(_EMPTY_POINT_TABLES[kind])
        yield Path(folder)


def read_image_names(file: Path) -> dict[int, str]:
    """Read the names of images.txt by image id. A name is all text after the ninth field, including spaces.

    Raises:
        HyrfDataError: the file cannot be read, or a photo lacks its line of 2D points, so that the next photo's line
            would be taken for it.
    """
    names = {}
    for number, line, points in _image_entries(read_text(file)):
        fields = line.split(maxsplit=9)
        if len(fields) == 10 and fields[0].isdecimal():
            names[int(fields[0])] = fields[9].strip()
        if not _is_list_of_points(points):
            raise HyrfDataError(
                f"{file}: line {number + 1} is not a list of 2D points",
                fix="add a line after each photo's line, which may be empty, or export the model again",
            )
    return names


def _image_entries(text: str) -> Iterator[tuple[int, str, str]]:
    """Yield the two lines of each photo and the number of the first; the second lists 2D points and may be empty."""
    lines = enumerate(text.split("\n"), 1)
    for number, line in lines:
        if line.strip() and not line.lstrip().startswith("#"):
            yield number, line, next(lines, (0, ""))[1]


def _is_list_of_points(line: str) -> bool:
    """Return whether a line may list 2D points, each as x, y and the id of a 3D point, rather than describe a photo."""
    fields = line.split()
    if len(fields) % 3:
        return False
    with suppress(ValueError):
        return not fields or math.isfinite(float(fields[-1]))
    return False


def _remove_text_observations(content: bytes) -> bytes:
    """Return images.txt with the same photos and no 2D points, because 2D points refer to 3D points."""
    lines = [line.rstrip() for _, line, _ in _image_entries(content.decode(errors="replace"))]
    return "".join(f"{line}\n\n" for line in lines).encode()


def _remove_binary_observations(content: bytes) -> bytes:
    """Return images.bin with the same photos and no 2D points, because 2D points refer to 3D points."""
    (count,) = _U64_STRUCT.unpack_from(content)
    offset, kept = 8, [content[:8]]
    for _ in range(count):
        end = content.index(b"\0", offset + _IMAGE_RECORD_HEADER_BYTES) + 1
        (observations,) = _U64_STRUCT.unpack_from(content, end)
        kept += [content[offset:end], _U64_STRUCT.pack(0)]
        offset = end + 8 + 24 * observations
    return b"".join(kept)


def _has_byte_order_mark(file: Path) -> bool:
    """Return whether a file exists and starts with the byte-order mark of UTF-8."""
    if not file.is_file():
        return False
    with file.open("rb") as stream:
        return stream.read(3) == codecs.BOM_UTF8
