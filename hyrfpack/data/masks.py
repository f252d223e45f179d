"""Match mask files to photos, including one mask for all photos."""

from __future__ import annotations

import logging
import os
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from hyrfpack.counts import format_count
from hyrfpack.data.equirectangular import FaceFile
from hyrfpack.data.names import PictureIndex
from hyrfpack.data.pictures import PhotoFile, has_same_aspect, is_picture_name, read_header
from hyrfpack.errors import HyrfDataError
from hyrfpack.scene import View

_LOG = logging.getLogger(__name__)


@dataclass(frozen=True)
class MaskedPhoto:
    """A photo with a mask, for the choice of the orientation by which the mask is turned.

    Attributes:
        mask: the file of the mask.
        size: (width, height) of the upright photo.
        orientation: EXIF orientation by which the stored photo is turned upright.
    """

    mask: Path
    size: tuple[int, int]
    orientation: int = 1


@dataclass(frozen=True)
class MaskMatches:
    """Masks that were found for photos.

    Attributes:
        by_photo: maps a photo's name to the file of its mask.
        notes: sentences about masks that match no photo, and about a mask for all photos.
    """

    by_photo: dict[str, Path] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)


def find_mask_folder(root: Path, picture_folder: str) -> Path:
    """Return the folder of masks for a folder of photos: `masks/`, or "masks_2" for "images_2" if that exists."""
    suffix = picture_folder.removeprefix("images")
    return root / f"masks{suffix}" if suffix and (root / f"masks{suffix}").is_dir() else root / "masks"


def locate_masks(photos: Path) -> Path | None:
    """Return the folder of masks of photos without poses: masks/ or mask/ in their folder, or masks/ beside it."""
    beside = Path(os.path.abspath(photos)).parent
    return next((folder for folder in (photos / "masks", photos / "mask", beside / "masks") if folder.is_dir()), None)


def find_masks(
    folder: Path, photos: Sequence[tuple[str, tuple[int, int]]], used: set[Path], *, allow_shared: bool = True
) -> MaskMatches:
    """Find the masks of photos by their names, or a single mask for all photos.

    A mask has its photo's name, with ".png" added, with another extension, or in another spelling that `PictureIndex`
    accepts.

    Args:
        folder: the folder of masks. If it does not exist, a file called "mask" beside it is the mask of all photos.
        photos: name and (width, height) of each photo that needs a mask.
        used: masks that the poses name themselves.
        allow_shared: whether a single mask, which has the name of no photo, applies to all photos.
    """
    index = PictureIndex(folder, photos=False)
    unmatched = [file for file in index.files if file not in used]
    names = [name for name, _ in photos]
    by_photo = index.match(names).found if unmatched else {}
    matched = set(by_photo.values())
    unmatched = [file for file in unmatched if file not in matched]
    if by_photo or used or not allow_shared:
        return MaskMatches(by_photo, _unmatched_mask_notes(folder, unmatched, len(index.files), names))
    shared_candidates = unmatched
    if not folder.is_dir():
        shared_candidates = [file for file in folder.parent.glob("[mM][aA][sS][kK].*") if is_picture_name(file.name)]
    if len(shared_candidates) == 1 and len(photos) > 1:
        shared = shared_candidates[0]
        header, path = read_header(shared), shared.relative_to(folder.parent)
        if all(has_same_aspect(*header.size, *size) for _, size in photos):
            return MaskMatches(dict.fromkeys(names, shared), [f"{path} is the only mask and is used for all photos"])
        return MaskMatches(
            {},
            [
                f"the mask {path} is not used, because its aspect ratio ({header.width} x {header.height}) is not that "
                "of all photos; make it their size, or give it the name of its photo"
            ],
        )
    if not folder.is_dir() and (folder.parent / "mask").is_dir():
        return MaskMatches({}, [f"the folder mask is not read; rename it to {folder.name}"])
    return MaskMatches({}, _unmatched_mask_notes(folder, unmatched, len(index.files), names))


def assign_masks(views: Sequence[View], folder: Path, others: Sequence[View] = ()) -> list[View]:
    """Return the views for whose photos a folder has masks, with these masks instead of any others.

    Args:
        views: views of photos on disk.
        folder: the folder of masks, which are found by name as by `find_masks`. A mask of a panorama has the panorama's
            name and applies to all of its faces. Masks that match no photo, also none of `others`, are logged.
        others: views of photos whose masks are not used.

    Raises:
        HyrfDataError: the folder has no mask of these photos, or a mask has another aspect ratio than its photo.
    """
    loaders = {view.name: view.load for view in views if isinstance(view.load, PhotoFile | FaceFile)}
    photo_names = {view.name: _photo_name(view) for view in (*views, *others)}
    sizes = {
        photo_names[view.name]: view.load.stored
        for view in (*views, *others)
        if isinstance(view.load, PhotoFile | FaceFile)
    }
    found = find_masks(folder, [*sizes.items()], set(), allow_shared=False) if folder.is_dir() else MaskMatches()
    mask_by_view = {name: found.by_photo[photo_names[name]] for name in loaders if photo_names[name] in found.by_photo}
    if not mask_by_view:
        example = f", such as {Path(photo_names[views[0].name]).stem}.png" if views else ""
        raise HyrfDataError(
            f"{folder}: {'no mask has the name of a photo' if folder.is_dir() else 'there is no such folder'}",
            fix=f"name a folder with masks that have their photos' names{example}",
        )
    for note in found.notes:
        _LOG.warning(note)
    masked_views = [view for view in views if view.name in mask_by_view]
    masked_photos = []
    for view in masked_views:
        load, mask = loaders[view.name], mask_by_view[view.name]
        if isinstance(load, PhotoFile) and mask.resolve() == load.path.resolve():
            raise HyrfDataError(f"{folder}: it holds the photos themselves", fix="name the folder of their masks")
        masked_photos.append(MaskedPhoto(mask, load.stored, load.orientation if isinstance(load, PhotoFile) else 1))
    orientations = choose_mask_orientations(masked_photos)
    return [
        replace(view, load=_with_mask(loaders[view.name], photo.mask, orientation))
        for view, photo, orientation in zip(masked_views, masked_photos, orientations, strict=True)
    ]


def _photo_name(view: View) -> str:
    """Return the name of a view's photo; of a face, that of its panorama."""
    load = view.load
    return load.face.panorama_name(view.name, load.path.suffix) if isinstance(load, FaceFile) else view.name


def _with_mask(load: PhotoFile | FaceFile, mask: Path, orientation: int) -> PhotoFile | FaceFile:
    """Return the loader of a photo with another mask, which is turned by an EXIF orientation."""
    if isinstance(load, PhotoFile):
        return replace(load, mask=mask, mask_orientation=orientation)
    return replace(load, mask=mask)  # panoramas are never turned


def choose_mask_orientations(photos: Sequence[MaskedPhoto]) -> list[int]:
    """Choose the EXIF orientation by which each mask is turned to fit its upright photo; 1 leaves the mask as it is.

    Programs write masks either for the stored or for the upright photos. The shape of the mask shows which, if its
    photo is turned by a quarter and not square. Masks of upside-down, mirrored and square photos fit both ways; they
    stay as they are if the shapes of others show only upright masks, and are turned with their photos otherwise.

    Raises:
        HyrfDataError: a mask has another aspect ratio than its photo, also when it is turned like the photo.
    """
    fits_upright, fits_stored = [], []
    for photo in photos:
        header = read_header(photo.mask)
        fits_upright.append(has_same_aspect(*header.size, *photo.size))
        fits_stored.append(has_same_aspect(*header.turned(photo.orientation).size, *photo.size))
        if not (fits_upright[-1] or fits_stored[-1]):
            raise HyrfDataError(
                f"{photo.mask}: the mask is {header.width} x {header.height} but its photo {photo.size[0]} x "
                f"{photo.size[1]}",
                fix="resize it to the photo's size",
            )
    fits = list(zip(fits_upright, fits_stored, strict=True))
    are_ambiguous_stored = (False, True) in fits or (True, False) not in fits
    return [
        photo.orientation if stored and (are_ambiguous_stored or not upright) else 1
        for photo, (upright, stored) in zip(photos, fits, strict=True)
    ]


def _unmatched_mask_notes(folder: Path, unmatched: list[Path], count: int, names: list[str]) -> list[str]:
    """Return a list of one note about masks that match no photo; an empty list if there are none."""
    if not unmatched:
        return []
    of_masks = f"of {count} masks in {folder.name}"
    return [
        f"{format_count(len(unmatched), f'{of_masks} matches', f'{of_masks} match')} no photo of the scene (such as "
        f"{unmatched[0].relative_to(folder)}); give each the name of its photo"
        f"{f' (such as {names[0]})' if names else ''}"
    ]
