"""Read Polycam's raw export: keyframes/ with photos and a JSON file of the camera for each.

`t_00` to `t_23` are the rows of a 3 x 4 world_from_camera in ARKit's axes. The camera's axes are OpenGL's (x right, y
up, z backward) for the picture as stored, and the world's y is up. Photos in `corrected_images` are undistorted, and
poses in `corrected_cameras` are optimised. Sessions that are too large to be optimised have only `images` and
`cameras`, with ARKit's poses. Depth maps and the mesh, which has a frame of its own, are not read.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from hyrfpack.data.assemble import assemble_scene
from hyrfpack.data.sidecar_files import PoseEntry, find_listed_photos
from hyrfpack.data.transforms import finite_number, pose_from_opengl, read_json_object
from hyrfpack.data.undistort import Lens
from hyrfpack.errors import HyrfDataError
from hyrfpack.scene import Scene

# The folders of the cameras and of the photos.
CORRECTED_FOLDERS = ("keyframes/corrected_cameras", "keyframes/corrected_images")
UNCORRECTED_FOLDERS = ("keyframes/cameras", "keyframes/images")


def has_polycam_cameras(path: Path) -> bool:
    """Return whether a folder holds the cameras of Polycam's raw export."""
    return any(_camera_files(path / cameras) for cameras, _ in (CORRECTED_FOLDERS, UNCORRECTED_FOLDERS))


def read_polycam(path: Path, *, test_every: int, max_size: int) -> Scene:
    """Read Polycam's raw export. The world is in metres with y up, and there are no points.

    Args:
        path: the folder that contains `keyframes/`.
        test_every, max_size: see `load_scene`.

    Raises:
        HyrfDataError: a camera or the photos cannot be used.
    """
    notes: list[str] = []
    cameras, images = CORRECTED_FOLDERS
    if not _camera_files(path / cameras) or not (path / images).is_dir():
        cameras, images = UNCORRECTED_FOLDERS
        notes.append(
            "there are no corrected_cameras in keyframes; the poses are those tracked by the phone, which drift"
        )
    if not (path / images).is_dir():
        raise HyrfDataError(f"{path}: there is {cameras} but no {images}", fix="export the raw data again")
    tables = _camera_files(path / cameras)
    entries: list[PoseEntry] = []
    for table in tables:
        content = read_json_object(table)
        lens = Lens(*(_required_number(content, key, table) for key in ("width", "height", "fx", "fy", "cx", "cy")))
        rows = [[_required_number(content, f"t_{row}{column}", table) for column in range(4)] for row in range(3)]
        pose = pose_from_opengl({"file_path": table.stem, "transform_matrix": rows}, table)
        entries.append((table.stem, lens, pose))
    photos, masks, found = find_listed_photos(path, path / images, entries, cameras)
    return assemble_scene(
        path,
        "polycam",
        photos,
        test_every=test_every,
        max_size=max_size,
        tables=tables,
        masks=masks,
        notes=notes + found,
    )


def _camera_files(folder: Path) -> list[Path]:
    """List the JSON files of a folder by name; the list is empty if the folder does not exist."""
    try:
        return sorted(f for f in folder.iterdir() if f.suffix.lower() == ".json" and not f.name.startswith("."))
    except OSError:
        return []


def _required_number(content: dict[str, Any], key: str, table: Path) -> Any:
    """Return the number under a key, rounded for sizes; raise HyrfDataError if it is missing."""
    value = finite_number(content, key, table)
    if value is None:
        raise HyrfDataError(f"{table}: has no '{key}'", fix="export the raw data again")
    if key in ("width", "height"):
        return round(value)
    return value
