"""Read RealityScan's (RealityCapture's) "Internal/External camera parameters": a .csv file beside the photos.

The first line names the columns: #name, x, y, alt, heading, pitch, roll, f, px, py, k1 to k4, t1, t2. The world's axes
are east, north and up. A camera whose three angles are 0 looks down, with the top of its picture to the north, and

    world_from_camera = Rz(-heading) Rx(pitch) Ry(roll)    in OpenGL's axes (x right, y up, z backward).

f refers to a picture whose longer side is 36 mm; px and py are fractions of that side, from the centre. k1 to k4 are
Brown's radial coefficients, as in `undistort`.
"""

from __future__ import annotations

import csv
import io
from functools import partial
from pathlib import Path

import numpy as np

from hyrfpack.data.assemble import assemble_scene
from hyrfpack.data.pictures import PictureHeader
from hyrfpack.data.sidecar_files import (
    PoseEntry,
    find_first_file,
    find_listed_photos,
    find_picture_folder,
    read_sidecar_points,
)
from hyrfpack.data.text_files import read_text
from hyrfpack.data.transforms import pose_from_camera_axes
from hyrfpack.data.undistort import Lens, brown_coefficients
from hyrfpack.errors import HyrfDataError
from hyrfpack.scene import Scene

_POSE_COLUMNS = ("x", "y", "alt", "heading", "pitch", "roll")
_LENS_COLUMNS = ("f", "px", "py", "k1", "k2", "k3", "k4", "t1", "t2")
_FILM_LONGER_SIDE_MM = 36.0
# Distances from the Earth's centre at which photos are taken, with a margin.
_MIN_GEOCENTRIC_RADIUS_METRES = 6.2e6
_MAX_GEOCENTRIC_RADIUS_METRES = 6.5e6
# Positions in degrees lie near each other and far from zero, and heights in metres vary by much larger numbers. Local
# positions in metres, as along a mast, do so to a lesser degree.
_MAX_GEOGRAPHIC_SPREAD_DEGREES = 0.02  # 2.2 km of latitude
_MIN_HEIGHT_RATIO = 100
_MIN_HEIGHT_RATIO_OF_WIDE_SPREADS = 1000
_EXPORT_ADVICE = "export the registration as COLMAP, Bundler or NeRF transforms instead"


def find_realityscan(path: Path) -> Path | None:
    """Find the first file, in order of names, that holds camera parameters."""
    return find_first_file(path, ".csv", _is_parameter_file)


def read_realityscan(path: Path, *, test_every: int, images: str | None, max_size: int) -> Scene:
    """Read camera parameters, and the points of a `.ply` file beside them if it has the same coordinates.

    Args:
        path: the scene folder.
        test_every, max_size: see `load_scene`.
        images: the folder of photos; None takes the one that `find_picture_folder` finds.

    Raises:
        HyrfDataError: the parameters or the photos cannot be used.
    """
    table = find_realityscan(path)
    if table is None:
        raise HyrfDataError(f"{path}: there is no table of RealityScan camera parameters (.csv)", fix=_EXPORT_ADVICE)
    names, values = _read_table(table)
    poses = np.array([[row[column] for column in _POSE_COLUMNS] for row in values])
    _check_units(poses[:, :3], table)
    entries: list[PoseEntry] = []
    for name, row, pose in zip(names, values, poses, strict=True):
        entries.append((name, partial(_lens, row), _pose(pose)))
    photos, masks, notes = find_listed_photos(path, find_picture_folder(path, images), entries, table.name)
    points, colors, tables = read_sidecar_points(path, photos, notes)
    return assemble_scene(
        path,
        "realityscan",
        photos,
        test_every=test_every,
        max_size=max_size,
        points=points,
        point_colors=colors,
        tables=[table, *tables],
        masks=masks,
        notes=notes,
    )


def _is_parameter_file(file: Path) -> bool:
    """Return whether the first line of a file names the columns of camera parameters."""
    try:
        with file.open("rb") as stream:
            return _parse_header(stream.read(4096).decode("utf-8-sig", errors="replace").split("\n")[0]) is not None
    except OSError:
        return False


def _parse_header(header: str) -> list[str] | None:
    """Return the names of the columns, None if a required one is missing."""
    columns = [name.strip().lstrip("#").lower() for name in header.strip().split(",")]
    return columns if {"name", *_POSE_COLUMNS, "f"} <= set(columns) else None


def _read_table(table: Path) -> tuple[list[str], list[dict[str, float]]]:
    """Read the photos' names and the parameters of each; missing columns are 0.

    Lines that start with # are comments, unless all their numbers can be read: a photo's name may start with #, too.
    """
    header, _, body = read_text(table).partition("\n")
    columns = _parse_header(header) or []
    names, values = [], []
    try:
        rows = list(csv.reader(io.StringIO(body)))
    except csv.Error as error:
        raise HyrfDataError(f"{table}: not a table that can be read ({error})", fix="export it again") from error
    for number, row in enumerate(rows, 2):
        if not row or (row[0].startswith("#") and not any(cell.strip() for cell in row[1:])):
            continue
        cells = dict(zip(columns, row, strict=False))
        try:
            line = {key: float(cells.get(key) or 0.0) for key in (*_POSE_COLUMNS, *_LENS_COLUMNS)}
        except ValueError:
            line = {"f": np.nan}
        if len(row) < len(columns) or not np.isfinite(list(line.values())).all():
            if row[0].startswith("#"):
                continue
            raise HyrfDataError(
                f"{table}: line {number} is incomplete or has text in place of a number",
                fix="export it again",
            )
        if line["t1"] or line["t2"]:
            raise HyrfDataError(
                f"{table}: {cells['name'][:80]!r} has tangential distortion, which is not supported",
                fix=_EXPORT_ADVICE,
            )
        names.append(cells["name"].strip())
        values.append(line)
    if not names:
        raise HyrfDataError(f"{table}: lists no photo", fix="align the photos, then export again")
    return names, values


def _check_units(positions: np.ndarray, table: Path) -> None:
    """Raise HyrfDataError for geographic and geocentric positions, with which the angles have another meaning."""
    with np.errstate(all="ignore"):
        spread, middle = np.ptp(positions, axis=0), positions.mean(axis=0)
        geocentric = _MIN_GEOCENTRIC_RADIUS_METRES < np.linalg.norm(middle) < _MAX_GEOCENTRIC_RADIUS_METRES
    across = max(spread[:2])
    is_wide = across > _MAX_GEOGRAPHIC_SPREAD_DEGREES
    min_ratio = _MIN_HEIGHT_RATIO_OF_WIDE_SPREADS if is_wide else _MIN_HEIGHT_RATIO
    in_range = abs(middle[0]) <= 180 and abs(middle[1]) <= 90
    degrees = in_range and np.hypot(*middle[:2]) > 100 * across and spread[2] > min_ratio * across
    if geocentric or (len(positions) > 1 and degrees):
        raise HyrfDataError(
            f"{table}: the cameras are in {'geocentric' if geocentric else 'geographic'} coordinates",
            fix="export them again in grid-plane or local Euclidean coordinates",
        )


def _pose(pose: np.ndarray) -> np.ndarray:
    """Return the (4, 4) OpenCV camera_from_world for x, y, alt, and heading, pitch, roll in degrees."""
    sines, cosines = np.sin(np.radians(pose[3:])), np.cos(np.radians(pose[3:]))
    (sh, sp, sr), (ch, cp, cr) = sines, cosines
    about_z = np.array([[ch, sh, 0], [-sh, ch, 0], [0, 0, 1]])
    about_x = np.array([[1, 0, 0], [0, cp, -sp], [0, sp, cp]])
    about_y = np.array([[cr, 0, sr], [0, 1, 0], [-sr, 0, cr]])
    return pose_from_camera_axes(about_z @ about_x @ about_y * (1, -1, -1), pose[:3])


def _lens(row: dict[str, float], _: Path, header: PictureHeader) -> Lens:
    """Return the lens of a photo; the size comes from the photo's file, because the table does not state it."""
    width, height = header.size
    side = max(width, height)
    focal = row["f"] * side / _FILM_LONGER_SIDE_MM
    cx, cy = width / 2 + row["px"] * side, height / 2 + row["py"] * side
    coefficients = brown_coefficients(row["k1"], row["k2"], 0, 0, row["k3"], 0, 0, 0, row["k4"])
    return Lens(width, height, focal, focal, cx, cy, "brown", coefficients)
