"""Splat files by their ending: writing and reading them."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from hyrfpack.errors import HyrfDataError
from hyrfpack.scene import Camera
from hyrfpack.splats.formats import sog
from hyrfpack.splats.formats.hints import Hints
from hyrfpack.splats.splats import Splats
from hyrfpack.splats.table import FORMATS

READ = tuple(ending for ending, row in FORMATS.items() if row.read)  # .compressed.ply is among .ply
LISTED = 4  # names that are told of what a folder holds
MAX_BYTES = 1 << 32  # of a file to be read: 17 million Gaussians as PLY


def encode_splats(
    splats: Splats, extension: str, *, up: np.ndarray, camera: Camera | None, spz_version: int = 3
) -> bytes:
    """Splats as the bytes of a file.

    Args:
        splats: in the input's axes and units.
        extension: one of FORMATS. ".splat" holds no harmonics beyond degree 0.
        up: (3,) unit vector in the world, for the formats that know up (glTF, USD).
        camera: to look from first, for the formats that hold one (USD).
        spz_version: 3 or 4, see `Hints`.

    Raises:
        HyrfError: the format's package is missing.
    """
    return FORMATS[extension].encode(splats, Hints(up, camera, spz_version))


def read_splats(path: str | os.PathLike[str]) -> Splats:
    """Read a file of 3D Gaussians: .ply (plain or compressed), .splat, .spz, .sog, or the folder of a loose SOG.

    Raises:
        HyrfDataError: there is no such file, or it is none of these, or it is damaged.
    """
    path = Path(path)
    if path.name == sog.META_NAME:
        path = path.parent
    extension = path.suffix.lower()
    try:
        if path.is_dir():
            return sog.decode_files(_loose_sog(path), str(path))
        if path.exists() and extension not in READ:
            raise HyrfDataError(f"{path}: files with this ending are not known; name one of {', '.join(READ)}")
        data = _bytes_of(path)
        return FORMATS[extension].decode(data, str(path))
    except OSError as error:
        raise HyrfDataError(f"{path}: the file cannot be read ({error.strerror or error}); check the path") from error


def _loose_sog(folder: Path) -> dict[str, bytes]:
    """The files of a SOG that is not bundled, by name: meta.json and the pictures that it names."""
    names = os.listdir(folder)
    if sog.META_NAME not in names:
        splats = sorted(name for name in names if name.lower().endswith(READ))
        advice = f"name {splats[0]} in it" if splats else "name another"
        raise HyrfDataError(
            f"{folder}: a folder is read as a loose SOG, {sog.META_NAME} with its pictures, and this one holds "
            f"{_listed(names)}; {advice}"
        )
    files = {sog.META_NAME: _bytes_of(folder / sog.META_NAME)}
    for name in sog.picture_names(files[sog.META_NAME], str(folder)):
        files[name] = _bytes_of(folder / name)
    return files


def _listed(names: list[str]) -> str:
    """The first few names of what lies in a folder, and how many more there are."""
    more = f" and {len(names) - LISTED} more" if len(names) > LISTED else ""
    return (", ".join(sorted(names)[:LISTED]) or "nothing") + more


def _bytes_of(path: Path) -> bytes:
    if path.stat().st_size > MAX_BYTES:
        raise HyrfDataError(f"{path}: the file is larger than {MAX_BYTES:,} bytes; split it first")
    return path.read_bytes()
