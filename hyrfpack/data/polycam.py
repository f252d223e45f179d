"""Polycam's raw export: keyframes/ with photos and a JSON file of the camera for each.

`t_00` to `t_23` are the rows of a 3 x 4 world_from_camera in ARKit's axes: the camera's are OpenGL's (x right, y up, z
backward) for the picture as it is stored, and the world's y is up. Photos in `corrected_images` are undistorted, and
poses in `corrected_cameras` optimised; a session too large for that has just `images` and `cameras`, with ARKit's
poses. Depth maps, and the mesh (in a frame of its own), are not read.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from hyrfpack.data.assemble import make_scene
from hyrfpack.data.beside import Entry, photos_beside
from hyrfpack.data.transforms import number, pose_from_opengl, read_object
from hyrfpack.data.undistort import Lens
from hyrfpack.errors import HyrfDataError
from hyrfpack.scene import Scene

CORRECTED = ("keyframes/corrected_cameras", "keyframes/corrected_images")
AS_RECORDED = ("keyframes/cameras", "keyframes/images")


def holds_polycam(path: Path) -> bool:
    """Whether there are cameras of a raw export in a folder."""
    return any(_tables(path / cameras) for cameras, _ in (CORRECTED, AS_RECORDED))


def read_polycam(path: Path, *, test_every: int, max_size: int) -> Scene:
    """Read a raw export, in metres with y up; there are no points.

    Args:
        path: the folder that `keyframes/` is in.
        test_every, max_size: see `load_scene`.

    Raises:
        HyrfDataError: a camera or the photos cannot be used.
    """
    notes: list[str] = []
    cameras, images = CORRECTED
    if not _tables(path / cameras) or not (path / images).is_dir():
        cameras, images = AS_RECORDED
        notes.append(
            "there are no corrected_cameras in keyframes; the poses are those that the phone tracked, and drift"
        )
    if not (path / images).is_dir():
        raise HyrfDataError(f"{path}: there is {cameras} but no {images}; export the raw data again")
    tables = _tables(path / cameras)
    entries: list[Entry] = []
    for table in tables:
        content = read_object(table)
        lens = Lens(*(_needed(content, key, table) for key in ("width", "height", "fx", "fy", "cx", "cy")))
        rows = [[_needed(content, f"t_{row}{column}", table) for column in range(4)] for row in range(3)]
        pose = pose_from_opengl({"file_path": table.stem, "transform_matrix": rows}, table)
        entries.append((table.stem, lens, pose))
    photos, masks, found = photos_beside(path, path / images, entries, cameras)
    return make_scene(
        path,
        "polycam",
        photos,
        test_every=test_every,
        max_size=max_size,
        tables=tables,
        masks=masks,
        notes=notes + found,
    )


def _tables(folder: Path) -> list[Path]:
    """The JSON files of a folder, by name; none where it is not there."""
    try:
        return sorted(f for f in folder.iterdir() if f.suffix.lower() == ".json" and not f.name.startswith("."))
    except OSError:
        return []


def _needed(content: dict[str, Any], key: str, table: Path) -> Any:
    value = number(content, key, table)
    if value is None:
        raise HyrfDataError(f"{table}: has no '{key}'; export the raw data again")
    if key in ("width", "height"):
        return round(value)
    return value
