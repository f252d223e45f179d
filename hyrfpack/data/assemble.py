"""Build a checked Scene from the photos that a reader lists: sizes, poses, masks and the split into views."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Sequence, Set
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath

import numpy as np

from hyrfpack.cameras.files import MAX_IMAGE_SIDE_PIXELS
from hyrfpack.counts import format_count
from hyrfpack.data.equirectangular import CUBE_FACES, Face, FaceFile, face_lens, face_size
from hyrfpack.data.folder import is_raw_name, list_pictures
from hyrfpack.data.masks import MaskedPhoto, choose_mask_orientations, find_masks
from hyrfpack.data.names import find_similar_file
from hyrfpack.data.pictures import (
    PhotoFile,
    PictureHeader,
    fit_size,
    has_same_aspect,
    read_header,
    read_orientation,
    read_pixels,
)
from hyrfpack.data.undistort import Lens
from hyrfpack.data.unusable import raw_photos_notes
from hyrfpack.errors import HyrfDataError
from hyrfpack.scene import Camera, Scene, View, evenly_spaced, rigid_pose

_MAX_PHOTOS_CHECKED_FOR_ALPHA = 4


@dataclass(frozen=True)
class PosedPhoto:
    """A photo with a pose, as its dataset describes it.

    Attributes:
        name: path below the picture folder.
        path: the file, which exists.
        header: size and kind of the picture after `orientation` is applied.
        lens: the calibrated lens; its size may differ from the file's by a uniform scale.
        camera_from_world: (4, 4) OpenCV pose, not yet checked.
        mask: the file of the mask, if the poses name one.
        orientation: EXIF orientation to apply to the stored pixels; 1 unless the camera was calibrated on the upright
            picture.
        mask_orientation: EXIF orientation to apply to the mask; 1 if it is upright.
        face: the face of a panorama that this photo is cut from, with its own name, header and lens; None otherwise.
        visible_points: (M,) int64 rows of the points that the format lists for the photo; None if it lists none.
    """

    name: str
    path: Path
    header: PictureHeader
    lens: Lens
    camera_from_world: np.ndarray
    mask: Path | None = None
    orientation: int = 1
    mask_orientation: int = 1
    face: Face | None = None
    visible_points: np.ndarray | None = None


def assemble_scene(
    path: Path,
    layout: str,
    photos: list[PosedPhoto],
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
    """Check every photo and split the photos into training and held-out views.

    Args:
        path: the scene folder.
        layout: the format's name.
        photos: photos found on disk, in any order.
        test_every: hold out every n-th photo of the sorted names, beginning with the first; 0 holds out none.
        max_size: shrink photos to at most this many pixels on the longer side; 0 keeps the stored size.
        test_names: names held out by the dataset's own split, which is then used instead of `test_every`.
        points: (P, 3) world positions; None if there are none.
        point_colors: (P, 3) RGB in [0, 1].
        tables: the files that poses and points were read from.
        masks: the folder to search for masks, which may not exist; None for formats without masks.
        notes: sentences for the user; more are added.

    Raises:
        HyrfDataError: there is no photo, a name occurs twice or is that of a panorama's face, a pose, lens or size is
            not valid, or no view is left for training.
    """
    if not photos:
        raise HyrfDataError(
            f"{path}: there are no photos for these poses",
            fix="repeat the reconstruction, or correct the lists of file names",
        )
    photos = _apply_orientations(sorted(photos, key=lambda photo: photo.name), notes)
    for first, second in zip(photos, photos[1:], strict=False):
        if first.name == second.name:
            raise HyrfDataError(f"{path}: photo {first.name} is listed twice", fix="remove one of the entries")
    if test_names is None:
        test_names = {photo.name for photo in photos[::test_every]} if test_every else set()
    photos, mask_notes = (photos, []) if masks is None else _assign_masks(photos, masks)
    photos = _orient_masks(photos)
    photos, test_names = _cut_panoramas(photos, test_names)
    _check_face_names(photos, path)
    views = [_make_view(photo, max_size) for photo in photos]
    train = [view for view in views if view.name not in test_names]
    test = [view for view in views if view.name in test_names]
    if not train:
        raise HyrfDataError(
            f"{path}: {format_count(len(test), 'photo is', 'photos are')} held out for testing, and none is "
            "left to train on",
            fix="add photos, or hold out fewer with `test_every` (0 holds out none)",
        )
    raw_photos = _list_raw_photos_beside(photos)
    notes += [*_shared_pose_notes(views), *_loading_notes(photos, max_size, mask_notes), *raw_photos_notes(raw_photos)]
    points, point_colors, tracks = _drop_nonfinite_points(points, point_colors, photos, notes)
    pictures = [file for photo in photos for file in (photo.path, photo.mask) if file is not None]
    files = tuple(str(file) for file in (*tables, *pictures))
    has_alpha = _has_transparency(photos, max_size)
    return Scene(str(path), layout, train, test, points, point_colors, has_alpha, notes, files, max_size, tracks)


def _assign_masks(photos: list[PosedPhoto], folder: Path) -> tuple[list[PosedPhoto], list[str]]:
    """Assign masks from a folder to the photos whose poses name none; also return notes about unmatched masks."""
    used = {photo.mask for photo in photos if photo.mask is not None}
    found = find_masks(folder, [(photo.name, photo.header.size) for photo in photos if photo.mask is None], used)
    return [replace(photo, mask=found.by_photo.get(photo.name, photo.mask)) for photo in photos], found.notes


def _orient_masks(photos: list[PosedPhoto]) -> list[PosedPhoto]:
    """Check the shapes of the masks, and choose by which orientation each is turned."""
    masked = {
        # Panoramas are cut into faces as they are stored.
        photo.name: MaskedPhoto(photo.mask, photo.header.size, 1 if _is_panorama(photo) else photo.orientation)
        for photo in photos
        if photo.mask is not None
    }
    orientations = dict(zip(masked, choose_mask_orientations(list(masked.values())), strict=True))
    return [replace(photo, mask_orientation=orientations.get(photo.name, 1)) for photo in photos]


def _is_panorama(photo: PosedPhoto) -> bool:
    """Return whether a photo is a whole panorama, which is not yet cut into faces."""
    return photo.lens.model == "equirectangular"


def _cut_panoramas(photos: list[PosedPhoto], held_out: Set[str]) -> tuple[list[PosedPhoto], set[str]]:
    """Replace panoramas by the photos of their faces, and return these photos and the names of held-out ones."""
    faces_by_name = {photo.name: _panorama_faces(photo) if _is_panorama(photo) else [photo] for photo in photos}
    names = {face.name for name in held_out for face in faces_by_name.get(name, ())}
    return [face for faces in faces_by_name.values() for face in faces], names


def _check_face_names(photos: list[PosedPhoto], path: Path) -> None:
    """Raise HyrfDataError if a face of a panorama has the name of another photo."""
    panoramas = {photo.name: photo.path for photo in photos if photo.face is not None}
    for photo in photos:
        panorama = panoramas.get(photo.name)
        if panorama is not None and panorama != photo.path:
            raise HyrfDataError(
                f"{path}: photo {photo.name} has the name of a face of the panorama {panorama.name}",
                fix="rename the photo, in its folder and in the poses",
            )


def _list_raw_photos_beside(photos: list[PosedPhoto]) -> list[Path]:
    """List the raw files in the folders of the photos, as far as these folders may be listed."""
    found: list[Path] = []
    for folder in sorted({photo.path.parent for photo in photos}):
        with suppress(OSError):
            found += [folder / name for name in os.listdir(folder) if is_raw_name(name)]
    return found


def _loading_notes(photos: list[PosedPhoto], max_size: int, mask_notes: list[str]) -> list[str]:
    """Return notes about how photos are changed when they are loaded."""
    notes = []
    of_photos = f"of {len(photos):,} photos"
    masked = sum(photo.mask is not None for photo in photos)
    if masked:
        notes.append(f"{format_count(masked, f'{of_photos} has', f'{of_photos} have')} a mask")
    notes += mask_notes
    distorted = sum(photo.lens.is_distorted for photo in photos)
    if distorted:
        undistorted = f"{of_photos} is undistorted as it is loaded", f"{of_photos} are undistorted as they are loaded"
        notes.append(format_count(distorted, *undistorted))
    shrunk = [photo.header.size for photo in photos if max(photo.header.size) > max_size > 0]
    if shrunk:
        width, height = max(shrunk, key=max)
        notes.append(
            f"{format_count(len(shrunk), f'{of_photos} is', f'{of_photos} are')} shrunk from up to {width} x {height} "
            f"to {max_size} pixels on the longer side; `max_size=0` keeps them"
        )
    return notes


def missing_photos_notes(
    path: Path, photos: list[PosedPhoto], missing: list[str], where: str, ambiguous: Sequence[str] = ()
) -> list[str]:
    """Return a list of one note about listed photos that are not on disk; an empty list if none is missing.

    Args:
        path: the scene folder.
        photos: listed photos that were found.
        missing: paths below `path` of listed photos that were not found.
        where: the file that lists the photos, for the note.
        ambiguous: names of missing photos that fit more than one file, see `NameMatches`.

    Raises:
        HyrfDataError: no photo was found; the message says what was looked for and what is there instead.
    """
    if ambiguous and not photos:
        raise HyrfDataError(
            f"{path}: the {format_count(len(missing), 'photo')} that {where} lists cannot be assigned to files, "
            f"because {min(ambiguous)} matches more than one file, or its file more than one name",
            fix="use the same file names as the poses",
        )
    if missing and not photos:
        raise HyrfDataError(
            f"{path}: none of the {len(missing)} photos that {where} lists is on disk (looked for "
            f"{min(missing)}; {_describe_folder(path, min(missing))})",
            fix="put them at the paths that the poses name, as JPEG or PNG",
        )
    # Photos that fit several files are listed by another note.
    absent = [file for file in missing if not any(f"/{file}".endswith(f"/{name}") for name in ambiguous)]
    if not absent:
        return []
    listed = f"of {len(missing) + len(photos):,} photos listed in {where}"
    skipped = format_count(len(absent), f"{listed} is not on disk and was", f"{listed} are not on disk and were")
    return [f"{skipped} skipped (such as {min(absent)})"]


def unregistered_note(count: int) -> str:
    """Return a note about photos that a reconstruction has not registered."""
    return f"{format_count(count, 'photo is not registered and was', 'photos are not registered and were')} skipped"


def _describe_folder(path: Path, name: str) -> str:
    """Describe the content of the folder where a photo was expected, for an error message."""
    folder = PurePosixPath(name).parent
    similar = find_similar_file(name, list_pictures(path))
    near = f"; the nearest by name is {similar.relative_to(path)}" if similar else ""
    try:
        endings = Counter(entry.suffix or "other" for entry in (path / folder).iterdir() if entry.is_file())
    except (OSError, ValueError):  # ValueError: no folder can have this name
        return f"there is no folder {folder}{near}"
    held = ", ".join(format_count(count, f"{ending} file") for ending, count in endings.most_common(3))
    return f"{'that folder' if folder.parts else 'the folder'} holds {held or 'no file'}{near}"


def _shared_pose_notes(views: list[View]) -> list[str]:
    """Return a list of one note if photos have exactly the same pose, a common mistake; an empty list otherwise."""
    names_by_pose: dict[bytes, list[str]] = {}
    for view in views:
        names_by_pose.setdefault(view.camera.camera_from_world.tobytes(), []).append(view.name)
    shared = [names for names in names_by_pose.values() if len(names) > 1]
    if not shared:
        return []
    return [
        f"{sum(map(len, shared))} photos have exactly the same pose as another (such as {shared[0][0]} and "
        f"{shared[0][1]}); unless they were taken from one place, the poses are wrong"
    ]


def _apply_orientations(photos: list[PosedPhoto], notes: list[str]) -> list[PosedPhoto]:
    """Apply EXIF orientations to the photos whose cameras were calibrated on upright pictures.

    The sizes show which photos these are: the stored picture does not fit the camera, but the picture after a quarter
    turn does. The sizes of upside-down and square photos fit both ways. Such photos are treated like those whose sizes
    decide.
    """

    def fits(photo: PosedPhoto) -> bool:
        return has_same_aspect(*photo.header.size, photo.lens.width, photo.lens.height)

    def fits_turned(photo: PosedPhoto) -> bool:
        return has_same_aspect(*photo.header.size[::-1], photo.lens.width, photo.lens.height)

    if all(fits(photo) for photo in photos):
        return photos
    orientations = {photo.path: read_orientation(photo.path) for photo in photos}
    upright = {p.path for p in photos if orientations[p.path] >= 5 and fits_turned(p) and not fits(p)}
    stored = {p.path for p in photos if orientations[p.path] >= 5 and fits(p) and not fits_turned(p)}
    if upright and not stored:
        upright |= {photo.path for photo in photos if orientations[photo.path] != 1 and fits(photo)}
    if upright:
        of_photos = f"of {len(photos):,} photos"
        notes.append(
            f"{format_count(len(upright), f'{of_photos} is', f'{of_photos} are')} rotated by their EXIF orientation, "
            "because their cameras were calibrated on upright pictures"
        )
    return [
        replace(photo, header=photo.header.turned(orientations[photo.path]), orientation=orientations[photo.path])
        if photo.path in upright
        else photo
        for photo in photos
    ]


def _panorama_faces(photo: PosedPhoto) -> list[PosedPhoto]:
    """Split a panorama into photos of its six faces: "street.jpg" becomes "street_front.jpg" and so on."""
    size = face_size(photo.header.width)
    faces = []
    for face in CUBE_FACES:
        pose = photo.camera_from_world.copy()
        with np.errstate(invalid="ignore", over="ignore"):
            pose[:3] = face.rotation @ pose[:3]
        faces.append(
            replace(
                photo,
                name=face.photo_name(photo.name, photo.path.suffix),
                header=PictureHeader(size, size, False),
                lens=face_lens(size),
                camera_from_world=pose,
                face=face,
                visible_points=None,
            )
        )
    return faces


def _make_view(photo: PosedPhoto, max_size: int) -> View:
    """Check a photo's lens, size and pose, and make a view of it."""
    lens, header = photo.lens, photo.header
    if not _is_plausible(lens):
        raise HyrfDataError(
            f"{photo.path}: the camera of this photo has unusable intrinsics (size {lens.width} x {lens.height}, "
            f"focal lengths {lens.fx:g} and {lens.fy:g}, centre {lens.cx:g}, {lens.cy:g})",
            fix="calibrate it again",
        )
    if not has_same_aspect(header.width, header.height, lens.width, lens.height):
        raise HyrfDataError(
            f"{photo.path}: the picture is {header.width} x {header.height} but its camera says {lens.width} x "
            f"{lens.height}, which is not a uniform rescaling",
            fix="use the pictures that were calibrated (unrotated)",
        )
    size = fit_size(*header.size, max_size)
    if max(size) > MAX_IMAGE_SIDE_PIXELS:
        raise HyrfDataError(
            f"{photo.path}: {size[0]:,} x {size[1]:,} pixels; the cameras of a model may have up to "
            f"{MAX_IMAGE_SIDE_PIXELS:,} on a side",
            fix=f"shrink the photos with `max_size`, to {MAX_IMAGE_SIDE_PIXELS} or less",
        )
    if size != (lens.width, lens.height):
        lens = lens.scaled(*size)
    pose = _orthonormal_pose(photo.camera_from_world, photo.path)
    camera = Camera(*size, lens.fx, lens.fy, lens.cx, lens.cy, pose)
    if photo.face is not None:
        whole = read_header(photo.path).size
        return View(photo.name, camera, FaceFile(photo.path, whole, photo.face, size[0], photo.mask), is_resampled=True)
    load = PhotoFile(photo.path, header.size, lens, photo.mask, photo.orientation, photo.mask_orientation)
    return View(photo.name, camera, load, is_resampled=lens.is_distorted or photo.orientation != 1)


def _is_plausible(lens: Lens) -> bool:
    """Return whether all numbers are finite and the field of view lies within bounds far wider than of real lenses."""
    size = max(lens.width, lens.height)
    return (
        bool(np.isfinite((lens.fx, lens.fy, lens.cx, lens.cy, lens.skew, *lens.coefficients)).all())
        and min(lens.width, lens.height) >= 1
        and all(1e-3 * size <= focal <= 1e5 * size for focal in (lens.fx, lens.fy))
        and max(abs(lens.cx), abs(lens.cy)) <= 1e3 * size
    )


def _orthonormal_pose(pose: np.ndarray, path: Path) -> np.ndarray:
    """Check a pose and make its rotation exactly orthonormal, because text files round it."""
    try:
        pose = rigid_pose(pose)
    except ValueError as error:
        raise HyrfDataError(f"{path}: {error}", fix="correct it, or register this photo again") from error
    u, _, vt = np.linalg.svd(pose[:3, :3])
    rigid = np.eye(4)
    rigid[:3, :3] = u @ vt
    rigid[:3, 3] = pose[:3, 3]
    return rigid


def _has_transparency(photos: list[PosedPhoto], max_size: int) -> bool:
    """Return whether any of a few photos with an alpha channel has a transparent pixel.

    The pixels decide, because many alpha channels are opaque throughout.
    """

    def read_alpha(photo: PosedPhoto) -> np.ndarray:
        size = fit_size(*photo.header.size, max_size)
        _, alpha = read_pixels(photo.path, None if size == photo.header.size else size, photo.orientation)
        assert alpha is not None  # only photos with an alpha channel are read
        return alpha

    candidates = [photo for photo in photos if photo.header.has_alpha]
    return any(read_alpha(photo).min() < 255 for photo in evenly_spaced(candidates, _MAX_PHOTOS_CHECKED_FOR_ALPHA))


def _drop_nonfinite_points(
    points: np.ndarray | None, colors: np.ndarray | None, photos: Sequence[PosedPhoto], notes: list[str]
) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]:
    """Return the finite points, their colours, and for each photo the rows of the points that it shows."""
    if points is None or colors is None:
        return np.zeros((0, 3)), np.zeros((0, 3), np.float32), {}
    with np.errstate(over="ignore"):  # training uses the points in float32
        finite = np.all(np.isfinite(points.astype(np.float32)), axis=1)
    if not finite.all():
        of_points = f"of {len(points):,} points"
        dropped = format_count(
            (~finite).sum(), f"{of_points} is not finite and was", f"{of_points} are not finite and were"
        )
        notes.append(f"{dropped} dropped")
    new_row = np.cumsum(finite) - 1  # row of each finite point after the others are dropped
    visible = {p.name: np.unique(p.visible_points) for p in photos if p.visible_points is not None}
    tracks = {name: new_row[rows[finite[rows]]] for name, rows in visible.items()}
    return points[finite].astype(np.float64), colors[finite].astype(np.float32), tracks
