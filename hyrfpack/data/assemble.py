"""From what a format says about each photo to a checked Scene: sizes, poses, the split. Shared by all readers."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence, Set
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np

from hyrfpack.data.pictures import (
    Header,
    PhotoFile,
    is_picture_name,
    read_header,
    read_pixels,
    same_aspect,
    shrunk_size,
)
from hyrfpack.data.undistort import Lens
from hyrfpack.errors import HyrfDataError
from hyrfpack.scene import Camera, Scene, View, evenly_spaced, rigid_pose

_ALPHA_LOOKED_AT = 4  # photos, spread over the set; the first with transparency ends the search


@dataclass(frozen=True)
class Photo:
    """One photo as a format describes it; `path` exists.

    Attributes:
        name: its path below the picture folder.
        path: the file.
        header: what the file says.
        lens: as calibrated; its size may differ from the file's by a uniform scale.
        camera_from_world: (4, 4) OpenCV pose, not yet checked.
        mask: the file of its mask, if any.
    """

    name: str
    path: Path
    header: Header
    lens: Lens
    camera_from_world: np.ndarray
    mask: Path | None = None


def make_scene(
    path: Path,
    layout: str,
    photos: list[Photo],
    *,
    test_every: int,
    max_size: int,
    test_names: Set[str] | None = None,
    points: np.ndarray | None = None,
    point_colors: np.ndarray | None = None,
    tables: Sequence[Path],
    masks: Path | None = None,
    notes: list[str],
) -> Scene:
    """Check every photo and split them.

    Args:
        path: the scene folder.
        layout: the format's name.
        photos: found on disk, in any order.
        test_every: every n-th of the sorted names, from the first on, is held out; 0 holds out none.
        max_size: shrink photos to so many pixels on the longer side; 0 keeps them.
        test_names: the set's own split, which then counts instead of `test_every`.
        points: (P, 3) world positions, none when None.
        point_colors: (P, 3) RGB in [0, 1].
        tables: the files that poses and points were read from.
        masks: the folder that masks were looked for in, which may not exist; None for formats without masks.
        notes: sentences for the user; more are added.

    Raises:
        HyrfDataError: no photo, a name twice, a bad pose, intrinsics or size, or nothing left to train on.
    """
    if not photos:
        raise HyrfDataError(
            f"{path}: its poses are of no photo at all; reconstruct again, or correct lists of file names"
        )
    photos = sorted(photos, key=lambda photo: photo.name)
    for first, second in zip(photos, photos[1:], strict=False):
        if first.name == second.name:
            raise HyrfDataError(f"{path}: photo {first.name} is listed twice; remove one of the entries")
    if test_names is None:
        test_names = {photo.name for photo in photos[::test_every]} if test_every else set()
    views = [_make_view(photo, max_size) for photo in photos]
    train = [view for view in views if view.name not in test_names]
    test = [view for view in views if view.name in test_names]
    if not train:
        raise HyrfDataError(
            f"{path}: all {len(test)} photos are held out for testing and none is left to train on; "
            "add photos or hold out fewer (0 holds out none)"
        )
    notes += _same_poses(views)
    masked = sum(photo.mask is not None for photo in photos)
    if masked:
        notes.append(f"{masked} of {len(photos)} photos have a mask")
    if masks is not None:
        notes += _stray_masks(masks, photos)
    bent = sum(photo.lens.distorted for photo in photos)
    if bent:
        notes.append(f"{bent} of {len(photos)} photos are undistorted as they are loaded")
    shrunk = [photo.header.size for photo in photos if max(photo.header.size) > max_size > 0]
    if shrunk:
        width, height = max(shrunk, key=max)
        notes.append(
            f"{len(shrunk)} of {len(photos)} photos are shrunk from up to {width} x {height} to {max_size} pixels on "
            "the longer side; --max-size 0 keeps them"
        )
    points, point_colors = _finite_points(points, point_colors, notes)
    read = [file for photo in photos for file in (photo.path, photo.mask) if file is not None]
    files = tuple(str(file) for file in (*tables, *read))
    see_through = _see_through(photos, max_size)
    return Scene(str(path), layout, train, test, points, point_colors, see_through, notes, files, max_size)


def safe_name(text: str) -> str:
    """A photo's name as a relative path that stays below the folder it is joined to."""
    parts = [part for part in PurePosixPath(text.replace("\\", "/")).parts if part not in ("..", "/")]
    return "/".join(parts)


def check_found(path: Path, photos: list[Photo], missing: list[str], where: str) -> list[str]:
    """The note about listed photos that are not on disk; no note when none is missing.

    Args:
        path: the scene folder.
        photos: found.
        missing: those that are not, as paths below `path`.
        where: they are listed.

    Raises:
        HyrfDataError: no photo was found; the sentence says what was looked for and what is there instead.
    """
    if missing and not photos:
        raise HyrfDataError(
            f"{path}: none of the {len(missing)} photos that {where} lists is on disk (looked for {min(missing)}; "
            f"{_there(path, min(missing))}); put them where the poses name them, as JPEG or PNG"
        )
    if not missing:
        return []
    return [
        f"{len(missing)} of {len(missing) + len(photos)} photos listed in {where} are not on disk and were skipped, "
        f"{min(missing)} first"
    ]


def _there(path: Path, name: str) -> str:
    """What lies where a photo was looked for, in words."""
    folder = PurePosixPath(name).parent
    try:
        endings = Counter(entry.suffix or "other" for entry in (path / folder).iterdir() if entry.is_file())
    except OSError:
        return f"there is no folder {folder}"
    held = ", ".join(f"{count} {ending} files" for ending, count in endings.most_common(3))
    return f"{'that folder' if folder.parts else 'the folder'} holds {held or 'no file'}"


def _same_poses(views: list[View]) -> list[str]:
    """A note about photos that have the pose of another to the last digit: a mistake, more often than not."""
    named: dict[bytes, list[str]] = {}
    for view in views:
        named.setdefault(view.camera.camera_from_world.tobytes(), []).append(view.name)
    shared = [names for names in named.values() if len(names) > 1]
    if not shared:
        return []
    return [
        f"{sum(map(len, shared))} photos have the very pose of another, {shared[0][0]} that of {shared[0][1]} for one; "
        "if they were not taken from one place, the poses are wrong"
    ]


def _stray_masks(folder: Path, photos: list[Photo]) -> list[str]:
    """A note about masks that are of no photo, or about a folder that is nearly called as the one of masks is."""
    used = {photo.mask for photo in photos}
    if folder.is_dir():
        there = sorted(file for file in folder.rglob("*") if is_picture_name(file.name))
        stray = [str(file.relative_to(folder)) for file in there if file not in used]
        if not stray:
            return []
        return [
            f"{len(stray)} of {len(there)} masks in {folder.name} are of no posed photo, {stray[0]} first; "
            "masks are named as their photos"
        ]
    if used == {None} and (folder.parent / "mask").is_dir():
        return [f"the folder mask is not read; masks belong into {folder.name}"]
    return []


def _make_view(photo: Photo, max_size: int) -> View:
    lens, header = photo.lens, photo.header
    if not _is_sane(lens):
        raise HyrfDataError(
            f"{photo.path}: the camera of this photo has unusable intrinsics (size {lens.width} x {lens.height}, "
            f"focal lengths {lens.fx:g} and {lens.fy:g}, centre {lens.cx:g}, {lens.cy:g}); calibrate it again"
        )
    if not same_aspect(header.width, header.height, lens.width, lens.height):
        raise HyrfDataError(
            f"{photo.path}: the picture is {header.width} x {header.height} but its camera says {lens.width} x "
            f"{lens.height}, which is not a uniform rescaling; use the pictures that were calibrated (unrotated)"
        )
    size = shrunk_size(*header.size, max_size)
    if size != (lens.width, lens.height):
        lens = lens.scaled(*size)
    if photo.mask is not None:
        mask = read_header(photo.mask)
        if not same_aspect(mask.width, mask.height, header.width, header.height):
            raise HyrfDataError(
                f"{photo.mask}: the mask is {mask.width} x {mask.height} but its photo {header.width} x "
                f"{header.height}; make it the photo's size"
            )
    pose = _rigid(photo.camera_from_world, photo.path)
    camera = Camera(*size, lens.fx, lens.fy, lens.cx, lens.cy, pose)
    return View(photo.name, camera, PhotoFile(photo.path, header.size, lens, photo.mask))


def _is_sane(lens: Lens) -> bool:
    """Finite numbers and a field of view that a lens can have: far wider bounds than any real one needs."""
    size = max(lens.width, lens.height)
    return (
        bool(np.isfinite((lens.fx, lens.fy, lens.cx, lens.cy, *lens.coefficients)).all())
        and min(lens.width, lens.height) >= 1
        and all(1e-3 * size <= focal <= 1e5 * size for focal in (lens.fx, lens.fy))
        and max(abs(lens.cx), abs(lens.cy)) <= 1e3 * size
    )


def _rigid(pose: np.ndarray, path: Path) -> np.ndarray:
    """The pose with its rotation made exactly orthonormal (text files round it)."""
    try:
        pose = rigid_pose(pose)
    except ValueError as error:
        raise HyrfDataError(f"{path}: {error}; correct it, or register this photo again") from error
    u, _, vt = np.linalg.svd(pose[:3, :3])
    rigid = np.eye(4)
    rigid[:3, :3] = u @ vt
    rigid[:3, 3] = pose[:3, 3]
    return rigid


def _see_through(photos: list[Photo], max_size: int) -> bool:
    """Whether a photo has a transparent pixel: an alpha channel alone says little, many are opaque throughout."""

    def alpha(photo: Photo) -> np.ndarray:
        size = shrunk_size(*photo.header.size, max_size)
        pixels = read_pixels(photo.path, None if size == photo.header.size else size)[1]
        assert pixels is not None  # only photos with an alpha channel are asked
        return pixels

    candidates = [photo for photo in photos if photo.header.has_alpha]
    return any(alpha(photo).min() < 255 for photo in evenly_spaced(candidates, _ALPHA_LOOKED_AT))


def _finite_points(
    points: np.ndarray | None, colors: np.ndarray | None, notes: list[str]
) -> tuple[np.ndarray, np.ndarray]:
    if points is None or colors is None:
        return np.zeros((0, 3)), np.zeros((0, 3), np.float32)
    with np.errstate(over="ignore"):  # float32 is what they are used in
        finite = np.isfinite(points.astype(np.float32)).all(axis=1)
    if not finite.all():
        notes.append(f"{(~finite).sum()} of {len(points)} points are not finite and were dropped")
    return points[finite].astype(np.float64), colors[finite].astype(np.float32)
