"""Reading and writing of splat files, by the formats that their endings name."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from hyrfpack.choices import DEFAULT_SPZ_VERSION
from hyrfpack.errors import HyrfDataError
from hyrfpack.scene import MAX_WORLD_COORDINATE, Camera
from hyrfpack.splats.formats import sog
from hyrfpack.splats.formats.hints import Hints
from hyrfpack.splats.names import find_sog_folder
from hyrfpack.splats.splats import Splats
from hyrfpack.splats.table import FORMATS

# ".ply" covers ".compressed.ply".
READABLE_ENDINGS = tuple(ending for ending, row in FORMATS.items() if row.is_readable)
MAX_HEADER_BYTES_SEARCHED = 65536
MAX_LISTED_NAMES = 4
MAX_FILE_BYTES = 1 << 32  # a PLY of this size holds 17 million Gaussians


def encode_splats(
    splats: Splats, extension: str, *, up: np.ndarray, camera: Camera | None, spz_version: int = DEFAULT_SPZ_VERSION
) -> bytes:
    """Encode splats as the bytes of a file.

    Args:
        splats: the splats, in the axes and units of the file.
        extension: ending of the format, one of FORMATS. ".splat" holds no harmonics beyond degree 0.
        up: (3,) unit vector in world axes that points up, for the formats that store it (glTF, USD).
        camera: initial camera, for the formats that store one (USD).
        spz_version: version of ".spz" files, 3 or 4, see `Hints`.

    Raises:
        HyrfError: the format's package is missing.
    """
    return FORMATS[extension].encode(splats, Hints(up, camera, spz_version))


def read_splats(path: str | os.PathLike[str]) -> Splats:
    """Read a file of 3D Gaussians: .ply (plain or compressed), .splat, .spz, .sog, or the folder of an unbundled SOG.

    Raises:
        HyrfDataError: the file does not exist, has none of these formats, or is damaged.
    """
    splats = _read_any_splats(Path(path))
    for part, values in (("position", splats.positions), ("scale", splats.scales)):
        if (is_large := (np.abs(values) > MAX_WORLD_COORDINATE).any(axis=1)).any():
            raise HyrfDataError(
                f"{path}: the {part} of Gaussian {int(is_large.argmax()):,} of {len(values):,} is beyond "
                f"{MAX_WORLD_COORDINATE:g} units, because the file is damaged or its training failed",
                fix="export it again, or remove such Gaussians",
            )
    return splats


def _read_any_splats(path: Path) -> Splats:
    """Read splats of any place and size; the errors are those of `read_splats`."""
    if path.name == sog.META_NAME:
        path = path.parent
    extension = path.suffix.lower()
    try:
        if path.is_dir():
            return sog.decode_files(_read_unbundled_sog(path), str(path))
        if extension == ".hyrf" and path.exists():
            raise HyrfDataError(
                f"{path}: this is a model already, not splats of another program",
                fix="use it as it is, or write splats with 'hyrfpack export'",
            )
        if path.exists() and extension not in READABLE_ENDINGS:
            raise HyrfDataError(
                f"{path}: files with this extension are not supported",
                fix=f"give a file that ends in {', '.join(READABLE_ENDINGS)}",
            )
        data = _read_bytes(path)
        return FORMATS[extension].decode(data, str(path))
    except OSError as error:
        raise HyrfDataError(
            f"{error.filename or path}: the file cannot be read ({error.strerror or error})",
            fix="check the path",
        ) from error


def list_source_files(path: str | os.PathLike[str]) -> list[Path]:
    """List the files that `read_splats` reads: one file, or the meta.json of a SOG's folder and the pictures it names.

    Raises:
        HyrfDataError: the meta.json is damaged.
        OSError: the meta.json of a folder cannot be read.
    """
    folder = find_sog_folder(path)
    if folder is None:
        return [Path(path)]
    meta = folder / sog.META_NAME
    return [meta, *(folder / name for name in sog.picture_names(_read_bytes(meta), str(folder)))]


def bytes_on_disk(path: str | os.PathLike[str]) -> int:
    """Return the size in bytes of a file of splats, or of all files of an unbundled SOG."""
    return sum(file.stat().st_size for file in list_source_files(path))


def _read_unbundled_sog(folder: Path) -> dict[str, bytes]:
    """Read the files of an unbundled SOG by name: meta.json and the pictures that it names."""
    names = os.listdir(folder)
    if sog.META_NAME not in names:
        splat_names = sorted(name for name in names if name.lower().endswith(READABLE_ENDINGS))
        splat_names = [name for name in splat_names if (folder / name).is_file() and _may_hold_gaussians(folder / name)]
        level_names = sorted(name for name in names if (folder / name / sog.META_NAME).is_file())
        default_fix = "name another folder, or use 'hyrfpack make' if it holds photos"
        raise HyrfDataError(
            f"{folder}: a folder of splats is an unbundled SOG, {sog.META_NAME} with its pictures, but this one holds "
            f"{_format_names(names)}",
            fix=f"name {(splat_names or level_names)[0]} in it" if splat_names or level_names else default_fix,
        )
    return {file.name: _read_bytes(file) for file in list_source_files(folder) if file.name in names}


def _may_hold_gaussians(file: Path) -> bool:
    """Return whether a file may hold Gaussians: its header names their properties, or it is no PLY file."""
    if file.suffix.lower() != ".ply":
        return True
    with file.open("rb") as stream:
        header = stream.read(MAX_HEADER_BYTES_SEARCHED)
    return b" f_dc_0" in header or b" packed_position" in header


def _format_names(names: list[str]) -> str:
    """Format the first few names of a folder's files, and the number of the others."""
    others = f" and {len(names) - MAX_LISTED_NAMES} more" if len(names) > MAX_LISTED_NAMES else ""
    return (", ".join(sorted(names)[:MAX_LISTED_NAMES]) or "nothing") + others


def _read_bytes(path: Path) -> bytes:
    if path.stat().st_size > MAX_FILE_BYTES:
        raise HyrfDataError(f"{path}: the file is larger than {MAX_FILE_BYTES:,} bytes", fix="split it first")
    return path.read_bytes()
