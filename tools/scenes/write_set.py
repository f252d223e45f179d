"""Writes synthetic photo sets of the size that users have, as folders with a COLMAP model.

    python -m tools.scenes.write_set --out DIR                         writes DIR/object, room, street and city
    python -m tools.scenes.write_set --out DIR --scenes room --photos 30 --width 800

Each set has photos in images/ and poses and points in sparse/0/. The same options write the same bytes. Depth maps of
the photos come from `tools.scenes.render.render_depth`.
"""

from __future__ import annotations

import argparse
import io
import os
import re
import shutil
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from hyrfpack.atomic import make_folder, write_atomic
from hyrfpack.errors import HyrfError
from hyrfpack.lock import exclusive_folder
from hyrfpack.parallel.pool import parallel_map
from tools.command import run_command
from tools.scenes.catalog import LAYOUTS, SceneDescription, make_scene
from tools.scenes.colmap_tables import format_tables
from tools.scenes.render import render_picture
from tools.scenes.sparse import Corners, SparsePoints, find_corners, make_sparse_points

DEFAULT_PHOTOS, DEFAULT_WIDTH = 60, 1600
MIN_PHOTOS, MAX_PHOTOS = 3, 9999  # The names of photos have four digits.
MIN_WIDTH, MAX_WIDTH = 48, 8000  # pixels
_JPEG_QUALITY = 92
_SENSOR_NOISE_STD = 1.3 / 255  # in display-referred values
_OWN_FILE_PATTERN = re.compile(r"images/\d{4}\.jpg|sparse/0/(cameras|images|points3D)\.txt")


def write_set(
    folder: Path,
    scene_name: str,
    *,
    photos: int = DEFAULT_PHOTOS,
    width: int = DEFAULT_WIDTH,
    seed: int = 0,
    overwrite: bool = False,
) -> SparsePoints:
    """Write one photo set into a folder, which appears or is replaced when the set is complete.

    Args:
        folder: folder of the set.
        scene_name: one of `catalog.LAYOUTS`.
        photos: number of photos.
        width: picture width in pixels; the height is two thirds of it.
        seed: random seed.
        overwrite: replace a set that an earlier call wrote.

    Returns:
        The sparse points of the set.

    Raises:
        ValueError: an argument is out of range.
        HyrfError: there is something at `folder` that may not be replaced, or it cannot be written.
    """
    if scene_name not in LAYOUTS:
        raise ValueError(f"no scene '{scene_name}'; the scenes are {', '.join(LAYOUTS)}")
    if not (MIN_PHOTOS <= photos <= MAX_PHOTOS and MIN_WIDTH <= width <= MAX_WIDTH and seed >= 0):
        raise ValueError(f"{photos} photos of {width} pixels with the seed {seed} are out of range")
    check_replaceable(folder, overwrite)
    make_folder(folder.parent)
    with exclusive_folder(folder.parent):
        temporary = Path(tempfile.mkdtemp(prefix=f".{folder.name}-", suffix=".tmp", dir=folder.parent))
        try:
            temporary.chmod(0o755)
            scene = make_scene(scene_name, photos, width, width * 2 // 3, seed)
            points = _write_files(temporary, scene, seed)
            check_replaceable(folder, overwrite)
            _move_into_place(temporary, folder)
        finally:
            shutil.rmtree(temporary, ignore_errors=True)
    return points


def _move_into_place(complete: Path, folder: Path) -> None:
    """Give a complete set its name; an earlier set is removed only after that."""
    earlier = complete.with_suffix(".old")
    has_earlier = folder.exists()
    if has_earlier:
        os.rename(folder, earlier)
    try:
        os.rename(complete, folder)
    except BaseException:
        if has_earlier:
            os.rename(earlier, folder)
        raise
    if has_earlier:
        shutil.rmtree(earlier)


def check_replaceable(folder: Path, overwrite: bool) -> None:
    """Check that a set may be written to a folder.

    Raises:
        HyrfError: it exists, and `overwrite` is off or it holds files that this tool does not write.
    """
    if not os.path.lexists(folder):
        return
    if not folder.is_dir() or folder.is_symlink():
        raise HyrfError(f"{folder}: this is not a folder", fix="choose another folder")
    files = [path.relative_to(folder).as_posix() for path in folder.rglob("*") if not path.is_dir()]
    if files and not overwrite:
        raise HyrfError(
            f"{folder}: this folder holds files", fix="choose another folder, or replace it with `overwrite=True`"
        )
    foreign = next((file for file in sorted(files) if not _OWN_FILE_PATTERN.fullmatch(file)), None)
    if foreign is not None:
        raise HyrfError(f"{folder}: '{foreign}' in it is not part of a generated set", fix="choose another folder")


def _write_files(folder: Path, scene: SceneDescription, seed: int) -> SparsePoints:
    names = [f"{number:04d}.jpg" for number in range(len(scene.cameras))]

    def write_photo(number: int) -> Corners:
        picture = render_picture(scene.arrays, scene.cameras[number], scene.exposure)
        noise = np.random.default_rng([seed, 1, number]).standard_normal(picture.shape, np.float32)
        photo = (np.clip(picture + noise * np.float32(_SENSOR_NOISE_STD), 0, 1) * 255 + 0.5).astype(np.uint8)
        encoded = io.BytesIO()
        Image.fromarray(photo).save(encoded, "JPEG", quality=_JPEG_QUALITY)
        write_atomic(folder / "images" / names[number], encoded.getvalue())
        return find_corners(photo)

    corners = parallel_map(write_photo, range(len(names)))
    points = make_sparse_points(scene.arrays, scene.cameras, corners, np.random.default_rng([seed, 2]))
    for name, content in format_tables(scene.cameras, names, points).items():
        write_atomic(folder / "sparse" / "0" / name, content)
    return points


def _parse_arguments(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m tools.scenes.write_set",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--out", type=Path, required=True, help="folder in which each set gets a folder")
    parser.add_argument("--scenes", nargs="+", choices=list(LAYOUTS), default=list(LAYOUTS), help="default: all")
    parser.add_argument("--photos", type=int, default=DEFAULT_PHOTOS, help="photos of each set (%(default)s)")
    parser.add_argument("--width", type=int, default=DEFAULT_WIDTH, help="width in pixels (%(default)s); 3:2")
    parser.add_argument("--seed", type=int, default=0, help="random seed (%(default)s)")
    parser.add_argument("--overwrite", action="store_true", help="replace sets that an earlier call wrote")
    args = parser.parse_args(arguments)
    if not MIN_PHOTOS <= args.photos <= MAX_PHOTOS:
        parser.error(f"--photos {args.photos}: give {MIN_PHOTOS} to {MAX_PHOTOS} photos")
    if not MIN_WIDTH <= args.width <= MAX_WIDTH:
        parser.error(f"--width {args.width}: give {MIN_WIDTH} to {MAX_WIDTH} pixels")
    if args.seed < 0:
        parser.error(f"--seed {args.seed}: give a number of at least 0")
    return args


def main(arguments: Sequence[str] | None = None) -> None:
    args = _parse_arguments(arguments)
    scenes = list(dict.fromkeys(args.scenes))
    for name in scenes:
        check_replaceable(args.out / name, args.overwrite)
    for name in scenes:
        start = time.perf_counter()
        folder = args.out / name
        points = write_set(folder, name, photos=args.photos, width=args.width, seed=args.seed, overwrite=args.overwrite)
        track_length = len(points.point) / max(len(points.positions), 1)
        megabytes = sum(file.stat().st_size for file in folder.glob("images/*.jpg")) / 1e6
        print(
            f"{folder}: {args.photos} photos of {args.width} x {args.width * 2 // 3} pixels, {megabytes:.1f} MB; "
            f"{len(points.positions):,} points, mean track length {track_length:.1f}; "
            f"{time.perf_counter() - start:.0f} s",
            flush=True,
        )
        if not len(points.positions):
            print(f"{folder}: it has no points; render more or larger photos (--photos, --width)", flush=True)


if __name__ == "__main__":
    run_command(main)
