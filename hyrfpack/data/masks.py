"""Masks beside photos: which is of which photo, and one that is of all."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from hyrfpack.data.names import PictureIndex
from hyrfpack.data.pictures import is_picture_name, read_header, same_aspect


@dataclass(frozen=True)
class Masks:
    """Attributes:
    of: photo's name -> file.
    notes: sentences about masks of no photo, and about a mask for all.
    """

    of: dict[str, Path] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)


def mask_folder(root: Path, picture_folder: str) -> Path:
    """Where the masks of photos in a folder are: `masks/`, or "masks_2" for "images_2" if there is one."""
    suffix = picture_folder.removeprefix("images")
    return root / f"masks{suffix}" if suffix and (root / f"masks{suffix}").is_dir() else root / "masks"


def find_masks(folder: Path, photos: Sequence[tuple[str, tuple[int, int]]], used: set[Path]) -> Masks:
    """Masks by the names of their photos: the same, that with ".png" added or with another ending, and what else
    `PictureIndex` knows to be the same; or the one mask there is for all photos.

    Args:
        folder: of masks; it may be missing, and one for all is then looked for beside it, called "mask".
        photos: name and (width, height) of each photo that wants one.
        used: masks that the poses name themselves.
    """
    index = PictureIndex(folder, photos=False)
    stray = [file for file in index.files if file not in used]
    names = [name for name, _ in photos]
    of = index.match(names).found if stray else {}
    given = set(of.values())
    stray = [file for file in stray if file not in given]
    if of or used:
        return Masks(of, _stray_notes(folder, stray, len(index.files), names))
    for_all = stray
    if not folder.is_dir():
        for_all = [file for file in folder.parent.glob("[mM][aA][sS][kK].*") if is_picture_name(file.name)]
    if len(for_all) == 1 and len(photos) > 1:
        header, path = read_header(for_all[0]), for_all[0].relative_to(folder.parent)
        if all(same_aspect(*header.size, *size) for _, size in photos):
            return Masks(dict.fromkeys(names, for_all[0]), [f"{path} is the one mask and taken for all photos"])
        return Masks(
            {},
            [
                f"the mask {path} is {header.width} x {header.height}, which is not the shape of all photos, and is "
                "not used; make it their size, or name it as its photo"
            ],
        )
    if not folder.is_dir() and (folder.parent / "mask").is_dir():
        return Masks({}, [f"the folder mask is not read; masks belong into {folder.name}"])
    return Masks({}, _stray_notes(folder, stray, len(index.files), names))


def _stray_notes(folder: Path, stray: list[Path], count: int, names: list[str]) -> list[str]:
    if not stray:
        return []
    return [
        f"{len(stray)} of {count} masks in {folder.name} are of no posed photo, {stray[0].relative_to(folder)} first; "
        f"masks are named as their photos{f', {names[0]} for one' if names else ''}"
    ]
