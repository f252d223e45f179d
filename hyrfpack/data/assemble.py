"""From what a format says about each photo to a checked Scene: sizes, poses, the split. Shared by all readers."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Sequence, Set
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath

import numpy as np

from hyrfpack.data.equirectangular import FACES, Face, FaceFile, face_lens, face_size
from hyrfpack.data.folder import is_raw_name, list_pictures
from hyrfpack.data.masks import find_masks
from hyrfpack.data.names import nearest
from hyrfpack.data.pictures import (
    Header,
    PhotoFile,
    read_header,
    read_orientation,
    read_pixels,
    same_aspect,
    shrunk_size,
)
from hyrfpack.data.undistort import Lens
from hyrfpack.data.unusable import raw_photos_note
from hyrfpack.errors import HyrfDataError
from hyrfpack.scene import Camera, Scene, View, evenly_spaced, rigid_pose

_ALPHA_LOOKED_AT = 4  # photos, spread over the set; the first with transparency ends the search


@dataclass(frozen=True)
class Photo:
    """One photo as a format describes it; `path` exists.

    Attributes:
        name: its path below the picture folder.
        path: the file.
        header: what the file says, of the picture turned as `orientation` says.
        lens: as calibrated; its size may differ from the file's by a uniform scale.
        camera_from_world: (4, 4) OpenCV pose, not yet checked.
        mask: the file of its mask, if the poses name one.
        orientation: of EXIF, that stored pixels are turned by because the camera was calibrated so.
        face: of the panorama that the file holds, once it is cut; name, header and lens are then the face's.
        sees: (M,) int64 rows of the points that the format says are in the photo; None where it does not say.
    """

    name: str
    path: Path
    header: Header
    lens: Lens
    camera_from_world: np.ndarray
    mask: Path | None = None
    orientation: int = 1
    face: Face | None = None
    sees: np.ndarray | None = None


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
    photos = _turned(sorted(photos, key=lambda photo: photo.name), notes)
    for first, second in zip(photos, photos[1:], strict=False):
        if first.name == second.name:
            raise HyrfDataError(f"{path}: photo {first.name} is listed twice; remove one of the entries")
    if test_names is None:
        test_names = {photo.name for photo in photos[::test_every]} if test_every else set()
    photos, mask_notes = (photos, []) if masks is None else _masked(photos, masks)
    photos, test_names = _cut(photos, test_names)
    views = [_make_view(photo, max_size) for photo in photos]
    train = [view for view in views if view.name not in test_names]
    test = [view for view in views if view.name in test_names]
    if not train:
        raise HyrfDataError(
            f"{path}: all {len(test)} photos are held out for testing and none is left to train on; "
            "add photos or hold out fewer (0 holds out none)"
        )
    notes += [*_same_poses(views), *_told(photos, max_size, mask_notes), *raw_photos_note(_raw_photos_beside(photos))]
    points, point_colors, tracks = _finite_points(points, point_colors, photos, notes)
    read = [file for photo in photos for file in (photo.path, photo.mask) if file is not None]
    files = tuple(str(file) for file in (*tables, *read))
    see_through = _see_through(photos, max_size)
    return Scene(str(path), layout, train, test, points, point_colors, see_through, notes, files, max_size, tracks)


def _masked(photos: list[Photo], folder: Path) -> tuple[list[Photo], list[str]]:
    """Photos with their masks from a folder, where the poses name none; notes about masks of no photo."""
    used = {photo.mask for photo in photos if photo.mask is not None}
    found = find_masks(folder, [(photo.name, photo.header.size) for photo in photos if photo.mask is None], used)
    return [replace(photo, mask=found.of.get(photo.name, photo.mask)) for photo in photos], found.notes


def _cut(photos: list[Photo], held_out: Set[str]) -> tuple[list[Photo], set[str]]:
    """Photos with the faces of panoramas in place of these, and the names of those of them that are held out."""
    parts = {photo.name: _faces(photo) if photo.lens.model == "equirectangular" else [photo] for photo in photos}
    names = {part.name for name in held_out for part in parts.get(name, ())}
    return [part for cut in parts.values() for part in cut], names


def _raw_photos_beside(photos: list[Photo]) -> list[Path]:
    """Raw files in the folders that photos lie in."""
    folders = sorted({photo.path.parent for photo in photos})
    return [folder / name for folder in folders for name in os.listdir(folder) if is_raw_name(name)]


def _told(photos: list[Photo], max_size: int, about_masks: list[str]) -> list[str]:
    """Notes about what is done to photos as they are loaded."""
    notes = []
    masked = sum(photo.mask is not None for photo in photos)
    if masked:
        notes.append(f"{masked} of {len(photos)} photos have a mask")
    notes += about_masks
    bent = sum(photo.lens.distorted for photo in photos)
    if bent:
        notes.append(f"{bent} of {len(photos)} photos are undistorted as they are loaded")
    shrunk = [photo.header.size for photo in photos if max(photo.header.size) > max_size > 0]
    if shrunk:
        width, height = max(shrunk, key=max)
        notes.append(
            f"{len(shrunk)} of {len(photos)} photos are shrunk from up to {width} x {height} to {max_size} pixels on "
            "the longer side; `max_size=0` keeps them"
        )
    return notes


def check_found(
    path: Path, photos: list[Photo], missing: list[str], where: str, unclear: Sequence[str] = ()
) -> list[str]:
    """The note about listed photos that are not on disk; no note when none is missing.

    Args:
        path: the scene folder.
        photos: found.
        missing: those that are not, as paths below `path`.
        where: they are listed.
        unclear: those of the missing that `names.Matches` calls so.

    Raises:
        HyrfDataError: no photo was found; the sentence says what was looked for and what is there instead.
    """
    if unclear and not photos:
        raise HyrfDataError(
            f"{path}: which file is which of the {len(missing)} photos that {where} lists is unclear, because "
            f"{min(unclear)} fits more than one file, or its file more than one name; name the files as the poses do"
        )
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
    like = nearest(name, list_pictures(path))
    near = f"; the nearest by name is {like.relative_to(path)}" if like else ""
    try:
        endings = Counter(entry.suffix or "other" for entry in (path / folder).iterdir() if entry.is_file())
    except (OSError, ValueError):  # ValueError: no folder can be called so
        return f"there is no folder {folder}{near}"
    held = ", ".join(f"{count} {ending} files" for ending, count in endings.most_common(3))
    return f"{'that folder' if folder.parts else 'the folder'} holds {held or 'no file'}{near}"


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


def _turned(photos: list[Photo], notes: list[str]) -> list[Photo]:
    """Photos turned by EXIF where the cameras were calibrated on upright pictures, which sizes tell.

    Where a quarter turn makes a photo fit its camera, and as it is stored it does not, that is how it was calibrated.
    Upside-down and square photos fit either way: they are taken as those of the set that do tell.
    """

    def fits(photo: Photo) -> bool:
        return same_aspect(*photo.header.size, photo.lens.width, photo.lens.height)

    def fits_turned(photo: Photo) -> bool:
        return same_aspect(*photo.header.size[::-1], photo.lens.width, photo.lens.height)

    if all(fits(photo) for photo in photos):
        return photos
    told = {photo.path: read_orientation(photo.path) for photo in photos}
    upright = {p.path for p in photos if told[p.path] >= 5 and fits_turned(p) and not fits(p)}
    stored = {p.path for p in photos if told[p.path] >= 5 and fits(p) and not fits_turned(p)}
    if upright and not stored:
        upright |= {photo.path for photo in photos if told[photo.path] != 1 and fits(photo)}
    if upright:
        notes.append(
            f"{len(upright)} of {len(photos)} photos are turned as their EXIF orientation says, for their cameras were "
            "calibrated on upright pictures"
        )
    return [
        replace(photo, header=photo.header.turned(told[photo.path]), orientation=told[photo.path])
        if photo.path in upright
        else photo
        for photo in photos
    ]


def _faces(photo: Photo) -> list[Photo]:
    """A panorama as photos of its six faces: "street.jpg" becomes "street_front.jpg" and so on."""
    size = face_size(photo.header.width)
    name = photo.name.removesuffix(photo.path.suffix)
    faces = []
    for face in FACES:
        pose = photo.camera_from_world.copy()
        with np.errstate(invalid="ignore", over="ignore"):
            pose[:3] = face.rotation @ pose[:3]
        called, header = f"{name}_{face.name}{photo.path.suffix}", Header(size, size, False)
        faces.append(
            replace(
                photo, name=called, header=header, lens=face_lens(size), camera_from_world=pose, face=face, sees=None
            )
        )
    return faces


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
    whole = header.size if photo.face is None else read_header(photo.path).size
    if photo.mask is not None:
        mask = read_header(photo.mask)
        sizes = {mask.size, mask.turned(photo.orientation).size}
        if not any(same_aspect(*shape, *whole) for shape in sizes):
            raise HyrfDataError(
                f"{photo.mask}: the mask is {mask.width} x {mask.height} but its photo {whole[0]} x "
                f"{whole[1]}; make it the photo's size"
            )
    pose = _rigid(photo.camera_from_world, photo.path)
    camera = Camera(*size, lens.fx, lens.fy, lens.cx, lens.cy, pose)
    if photo.face is not None:
        return View(photo.name, camera, FaceFile(photo.path, whole, photo.face, size[0], photo.mask))
    return View(photo.name, camera, PhotoFile(photo.path, header.size, lens, photo.mask, photo.orientation))


def _is_sane(lens: Lens) -> bool:
    """Finite numbers and a field of view that a lens can have: far wider bounds than any real one needs."""
    size = max(lens.width, lens.height)
    return (
        bool(np.isfinite((lens.fx, lens.fy, lens.cx, lens.cy, lens.skew, *lens.coefficients)).all())
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
        pixels = read_pixels(photo.path, None if size == photo.header.size else size, photo.orientation)[1]
        assert pixels is not None  # only photos with an alpha channel are asked
        return pixels

    candidates = [photo for photo in photos if photo.header.has_alpha]
    return any(alpha(photo).min() < 255 for photo in evenly_spaced(candidates, _ALPHA_LOOKED_AT))


def _finite_points(
    points: np.ndarray | None, colors: np.ndarray | None, photos: Sequence[Photo], notes: list[str]
) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]:
    """Points that are finite, their colours, and the rows of them that each photo sees."""
    if points is None or colors is None:
        return np.zeros((0, 3)), np.zeros((0, 3), np.float32), {}
    with np.errstate(over="ignore"):  # float32 is what they are used in
        finite = np.all(np.isfinite(points.astype(np.float32)), axis=1)
    if not finite.all():
        notes.append(f"{(~finite).sum()} of {len(points)} points are not finite and were dropped")
    row = np.cumsum(finite) - 1  # that each point has among those that stay
    seen = {photo.name: np.unique(photo.sees) for photo in photos if photo.sees is not None}
    tracks = {name: row[rows[finite[rows]]] for name, rows in seen.items()}
    return points[finite].astype(np.float64), colors[finite].astype(np.float32), tracks
