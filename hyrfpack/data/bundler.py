"""Read Bundler's bundle.out (version 0.3), which many programs export, and its list of photos.

After the line `# Bundle file v0.3` and the numbers of cameras and points, each camera has five lines: f k1 k2, three
rows of R, and t. A point X has the camera coordinates P = R X + t. A camera looks along -z with y up. With p = -P /
P.z, a point is imaged f (1 + k1 |p|^2 + k2 |p|^4) p pixels from the picture's centre, y up. f = 0 marks a photo without
a pose. Each point has three lines: position, colour (0 to 255) and observations. Photos are in the order of the list.
The file does not state the size of the photos, so smaller copies cannot be distinguished from the photos themselves.
"""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path

import numpy as np

from hyrfpack.counts import format_count
from hyrfpack.data.assemble import assemble_scene, unregistered_note
from hyrfpack.data.folder import downscale_factor
from hyrfpack.data.pictures import PictureHeader
from hyrfpack.data.sidecar_files import PoseEntry, find_listed_folder, find_listed_photos, find_picture_folder
from hyrfpack.data.text_files import read_text
from hyrfpack.data.undistort import Lens, brown_coefficients
from hyrfpack.errors import HyrfDataError
from hyrfpack.scene import Scene

_FILE_SIGNATURE = b"# Bundle file v0.3"
_MAX_COUNT_DIGITS = 15  # Python does not format numbers of thousands of digits.
_LIST_PATTERNS = ("list.txt", "*.list.txt", "*list*.txt", "*.lst")


def find_bundle(path: Path) -> Path | None:
    """Find the bundle file in a folder or in `bundle/` below it: bundle.out, or the first by name."""
    for folder in (path, path / "bundle"):
        try:
            files = sorted(f for f in folder.iterdir() if f.suffix.lower() == ".out" and f.is_file() and _is_bundle(f))
        except OSError:
            continue
        if files:
            return next((file for file in files if file.name == "bundle.out"), files[0])
    return None


def read_bundler(path: Path, *, test_every: int, max_size: int) -> Scene:
    """Read a bundle file, its list of photos, and the headers of the photos.

    Args:
        path: the scene folder, with the photos in it or in `images/`.
        test_every, max_size: see `load_scene`.

    Raises:
        HyrfDataError: a file is missing or cannot be used.
    """
    bundle = find_bundle(path)
    if bundle is None:
        raise HyrfDataError(f"{path}: no bundle file ('# Bundle file v0.3')", fix="give the folder that holds it")
    names, listing = _read_list(path, bundle)
    cameras, points, colors = _read_bundle(bundle)
    if len(names) != len(cameras):  # a photo's name may start with #, too
        names = [name for name in names if not name.startswith("#")]
    if len(names) != len(cameras):
        raise HyrfDataError(
            f"{bundle}: holds {format_count(len(cameras), 'camera')}, but {listing.name} lists "
            f"{format_count(len(names), 'photo')}",
            fix="export both again",
        )
    entries: list[PoseEntry] = []
    for name, camera in zip(names, cameras, strict=True):
        focal, k1, k2 = camera[0]
        if focal == 0:
            continue
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = camera[1:4], camera[4]
        pose[1:3] *= -1
        entries.append((name, partial(_lens, focal, k1, k2), pose))
    folder = find_listed_folder(path, names) or _check_full_size(find_picture_folder(path, None))
    photos, masks, notes = find_listed_photos(path, folder, entries, bundle.name)
    if len(entries) < len(names):
        notes.append(unregistered_note(len(names) - len(entries)))
    return assemble_scene(
        path,
        "bundler",
        photos,
        test_every=test_every,
        max_size=max_size,
        points=points,
        point_colors=colors,
        tables=[bundle, listing],
        masks=masks,
        notes=notes,
    )


def _check_full_size(folder: Path) -> Path:
    """Return the folder of the photos; raise HyrfDataError if its name is that of a folder of smaller copies."""
    if downscale_factor(folder.name):
        raise HyrfDataError(
            f"{folder}: a Bundler file does not say how large its photos are, so copies of another size cannot be used",
            fix="put the original photos into the folder 'images'",
        )
    return folder


def _lens(focal: float, k1: float, k2: float, _: Path, header: PictureHeader) -> Lens:
    """Return the lens of a photo; the size comes from the photo's file, because the bundle does not state it."""
    width, height = header.size
    return Lens(width, height, focal, focal, width / 2, height / 2, "brown", brown_coefficients(k1, k2))


def _is_bundle(file: Path) -> bool:
    """Return whether a file starts with the signature of a bundle file."""
    try:
        with file.open("rb") as stream:
            return stream.read(len(_FILE_SIGNATURE)) == _FILE_SIGNATURE
    except OSError:
        return False


def _read_list(path: Path, bundle: Path) -> tuple[list[str], Path]:
    """Read the lines of the list of photos without those that are empty; also return the file.

    The lines are the names in the order of the cameras, and perhaps comments.
    """
    folders = dict.fromkeys((bundle.parent, path))
    lists = (file for folder in folders for pattern in _LIST_PATTERNS for file in sorted(folder.glob(pattern)))
    listing = next((file for file in lists if file.is_file()), None)
    if listing is None:
        raise HyrfDataError(
            f"{bundle}: the list of its photos is missing (looked for list.txt and *.lst beside it)",
            fix="export it, too",
        )
    lines = read_text(listing).splitlines()
    # Lists that Bundler itself writes have 0 and the focal length from EXIF after each name.
    names = [re.sub(r"\s+0\s+[\d.eE+-]+$", "", line.strip()) for line in lines]
    return [name for name in names if name], listing


def _read_bundle(file: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Read the (N, 5, 3) rows of the cameras, (P, 3) points and (P, 3) colours in [0, 1]."""
    lines = [line for line in read_text(file).splitlines() if line.strip() and not line.startswith("#")]
    try:
        counts = lines[0].split()[:2]
        if any(len(count) > _MAX_COUNT_DIGITS for count in counts):
            raise ValueError("a number has too many digits")
        cameras, points = map(int, counts)
    except (IndexError, ValueError) as error:
        raise HyrfDataError(
            f"{file}: does not say how many cameras and points it holds",
            fix="export it again",
        ) from error
    needed = 1 + 5 * cameras + 3 * points
    if cameras < 1 or points < 0 or len(lines) < needed:
        raise HyrfDataError(
            f"{file}: {format_count(cameras, 'camera')} and {format_count(points, 'point')} take {needed:,} lines, "
            f"but there are {len(lines):,}",
            fix="the file is truncated, export it again",
        )
    first = 1 + 5 * cameras
    table = _parse_numbers(lines[1:first], file).reshape(cameras, 5, 3)
    if not np.isfinite(table).all():
        raise HyrfDataError(f"{file}: a camera in it has numbers that are not finite", fix="export it again")
    colors = np.clip(_parse_numbers(lines[first + 1 : needed : 3], file) / 255, 0, 1)
    return table, _parse_numbers(lines[first:needed:3], file), np.nan_to_num(colors, nan=0.5)


def _parse_numbers(lines: list[str], file: Path) -> np.ndarray:
    """Parse lines of three numbers each to (N, 3) float64."""
    try:
        rows = [tuple(map(float, line.split())) for line in lines]
    except ValueError:
        rows = [()]
    if any(len(row) != 3 for row in rows):
        raise HyrfDataError(
            f"{file}: a line has no three numbers where the format requires them", fix="export it again"
        )
    return np.array(rows, np.float64).reshape(-1, 3)
