"""What the header of a PLY file says about its Gaussians. It imports no torch, so that `hyrfpack view` starts fast."""

from __future__ import annotations

from hyrfpack.errors import HyrfDataError
from hyrfpack.ply import PlyHeader, read_header

POSITION_PROPERTIES = ("x", "y", "z")
COLOR_PROPERTIES = ("f_dc_0", "f_dc_1", "f_dc_2")
SCALE_PROPERTIES = ("scale_0", "scale_1", "scale_2")
ROTATION_PROPERTIES = ("rot_0", "rot_1", "rot_2", "rot_3")
_REQUIRED_PROPERTIES = (*POSITION_PROPERTIES, *COLOR_PROPERTIES, "opacity", *SCALE_PROPERTIES, *ROTATION_PROPERTIES)


def is_compressed(header: PlyHeader) -> bool:
    """Return whether the header is that of a compressed PLY file."""
    return "vertex" in header.elements and "packed_position" in header.elements["vertex"].properties


def find_properties(header: PlyHeader, name: str) -> dict[str, str]:
    """Return the types of the properties of uncompressed Gaussians, as in `hyrfpack.ply.Element`.

    Args:
        header: the header of the file.
        name: the file's name in error messages.

    Raises:
        HyrfDataError: the file holds no Gaussians.
    """
    vertex = header.elements.get("vertex")
    properties = vertex.properties if vertex else {}
    missing = [label for label in _REQUIRED_PROPERTIES if not properties.get(label)]
    if missing:
        missing_text = ", ".join(missing[:4]) + (f" and {len(missing) - 4} more" if len(missing) > 4 else "")
        raise HyrfDataError(
            f"{name}: this PLY file holds no Gaussians, because its vertices have no {missing_text}",
            fix="give one that a program for 3D Gaussian Splatting wrote",
        )
    return properties


def check_gaussians(start: bytes, name: str) -> None:
    """Check by its header that a PLY file, plain or compressed, holds Gaussians.

    Args:
        start: the first `hyrfpack.ply.MAX_HEADER_BYTES` bytes of the file, or all of it.
        name: the file's name in error messages.

    Raises:
        HyrfDataError: the file is not a PLY file, or holds no Gaussians.
    """
    header = read_header(start, name)
    if not is_compressed(header):
        find_properties(header, name)
