"""Read the PLY container (Turk 1994), and write points: a header names elements and properties, their rows follow."""

from __future__ import annotations

import io
import re
from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from hyrfpack.errors import HyrfDataError

MAX_HEADER_BYTES = 1 << 16
_END_OF_HEADER = re.compile(rb"^end_header\r?\n", re.MULTILINE)
_BYTE_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "="}
_NUMPY_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4",
    "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "float32": "f4", "float64": "f8",
}  # fmt: skip


@dataclass(frozen=True)
class Element:
    """One element of a PLY header.

    Attributes:
        count: number of rows.
        properties: maps the name of each property to numpy's name of its type without byte order, or "" for a list.
    """

    count: int
    properties: dict[str, str]


@dataclass(frozen=True)
class PlyHeader:
    """The header of a PLY file.

    Attributes:
        order: byte order of binary rows, "<" or ">"; "=" for text rows.
        elements: the elements by name, in the order of the file.
        length: size of the header in bytes; the rows follow.
    """

    order: str
    elements: dict[str, Element]
    length: int


def read_header(data: bytes, name: str) -> PlyHeader:
    """Read the header of a PLY file.

    Args:
        data: the whole file, or at least its header.
        name: name of the file in error messages.

    Raises:
        HyrfDataError: this is not a PLY file, or its header is malformed.
    """
    if not re.match(rb"ply\r?\n", data):
        raise HyrfDataError(
            f"{name}: this is not a PLY file, because its first line is not 'ply'", fix="check the path"
        )
    end = _END_OF_HEADER.search(data, 0, MAX_HEADER_BYTES)
    if end is None:
        raise HyrfDataError(
            f"{name}: its PLY header has no end within {MAX_HEADER_BYTES:,} bytes",
            fix="the file is damaged, export it again",
        )
    order, elements = "", dict[str, Element]()
    properties: dict[str, str] | None = None
    for line in data[: end.start()].decode("utf-8", "replace").split("\n")[1:]:
        match line.split():
            case [] | ["comment" | "obj_info", *_]:
                pass
            case ["format", kind, _] if kind in _BYTE_ORDERS:
                order = _BYTE_ORDERS[kind]
            case ["element", element, count] if re.fullmatch("[0-9]{1,15}", count) and element not in elements:
                properties = {}
                elements[element] = Element(int(count), properties)
            case ["property", kind, label] if (
                kind in _NUMPY_TYPES and properties is not None and label not in properties
            ):
                properties[label] = _NUMPY_TYPES[kind]
            case ["property", "list", _, _, label] if properties is not None and label not in properties:
                properties[label] = ""
            case _:
                raise HyrfDataError(
                    f"{name}: the line '{line[:80]}' of its PLY header is not understood", fix="export it again"
                )
    if not order:
        raise HyrfDataError(
            f"{name}: its PLY header does not say in which format its rows are",
            fix="the file is damaged, export it again",
        )
    return PlyHeader(order, elements, end.end())


def read_elements(data: bytes, header: PlyHeader, wanted: set[str], name: str) -> dict[str, np.ndarray]:
    """Read the rows of the `wanted` elements, as far as the file has them, and skip the other elements.

    Args:
        data: the whole file.
        header: its header.
        wanted: names of elements.
        name: name of the file in error messages.

    Returns:
        The rows of each element by its name, a structured array (count,) with the file's property names. Text rows are
        float64.

    Raises:
        HyrfDataError: the file ends too early, a text row does not consist of numbers, or a wanted element, or a binary
            one before it, has list properties.
    """
    rows, place = dict[str, np.ndarray](), header.length
    text = io.StringIO(data[place:].decode("ascii", "replace")) if header.order == "=" else None
    for label, element in header.elements.items():
        if wanted <= rows.keys():
            break
        kinds = element.properties
        if "" in kinds.values() and element.count and (text is None or label in wanted):
            raise HyrfDataError(
                f"{name}: its element '{label}' has properties that are lists, which are not read",
                fix="export it again without lists",
            )
        if text is not None:
            lines = (line for line in text if not line.isspace())
            taken = [line for _, line in zip(range(element.count), lines, strict=False)]
            if len(taken) < element.count:
                raise _truncated_error(name, label, element.count)
            if label in wanted:
                rows[label] = _parse_rows(taken, kinds, label, name)
            continue
        layout = np.dtype([(key, header.order + kind) for key, kind in kinds.items()])
        if element.count * layout.itemsize > len(data) - place:
            raise _truncated_error(name, label, element.count)
        if label in wanted:
            rows[label] = np.ndarray(element.count if kinds else 0, layout, data, place)
        place += element.count * layout.itemsize
    return rows


def stack_columns(rows: np.ndarray, names: Collection[str]) -> np.ndarray:
    """Return the properties `names` of rows as one array (count, len(names)) of their widest type."""
    fields = rows.dtype.names or ()
    kinds = {rows.dtype[name] for name in fields}
    if len(kinds) == 1:  # This holds for most files, and viewing their rows as one table is many times faster.
        table = rows.view(kinds.pop()).reshape(len(rows), len(fields))
        return table[:, [fields.index(name) for name in names]]
    return np.stack([rows[name] for name in names], axis=1)


def encode_colored_points(points: np.ndarray, colors: np.ndarray) -> bytes:
    """Encode points as a binary PLY file with float32 positions.

    Args:
        points: (P, 3) positions.
        colors: (P, 3) RGB, whole numbers from 0 to 255.
    """
    vertices = np.empty(len(points), [("position", "<f4", 3), ("color", "u1", 3)])
    vertices["position"], vertices["color"] = points, colors
    fields = [f"property float {axis}" for axis in "xyz"] + [f"property uchar {c}" for c in ("red", "green", "blue")]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(points)}", *fields, "end_header", ""]
    return "\n".join(header).encode() + vertices.tobytes()


def _parse_rows(lines: list[str], kinds: dict[str, str], label: str, name: str) -> np.ndarray:
    layout = np.dtype([(key, "f8") for key in kinds])
    if not lines or not kinds:
        return np.zeros(0, layout)
    try:
        table = np.loadtxt(lines, np.float64, comments=None, ndmin=2)
    except ValueError as error:
        for line in lines:
            if (width := len(line.split())) != len(kinds):
                raise _width_error(name, label, width, len(kinds)) from error
        raise HyrfDataError(
            f"{name}: a row of its element '{label}' is not made of numbers",
            fix="the file is damaged, export it again",
        ) from error
    if table.shape != (len(lines), len(kinds)):
        raise _width_error(name, label, table.shape[1], len(kinds))
    return np.ascontiguousarray(table).view(layout)[:, 0]


def _width_error(name: str, label: str, width: int, expected: int) -> HyrfDataError:
    return HyrfDataError(
        f"{name}: the number of values in a row of element '{label}' is {width:,}, and the header says {expected:,}",
        fix="the file is damaged, export it again",
    )


def _truncated_error(name: str, label: str, count: int) -> HyrfDataError:
    return HyrfDataError(
        f"{name}: the file ends before the {count:,} rows of its element '{label}'",
        fix="the file is truncated, export it again",
    )
