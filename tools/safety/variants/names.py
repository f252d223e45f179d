"""Variants whose photos have other names than in the poses: endings, letter case, folders, accents, missing, copies."""

from __future__ import annotations

import unicodedata
from collections.abc import Callable, Iterator
from pathlib import PurePosixPath

from PIL import Image

from tools.safety.variants.variant import ALL_LAYOUTS, Variant
from tools.safety.variants.working_set import WorkingSet

JSON_LAYOUTS = ("nerfstudio", "blender")
LOOSE_MATCH_NOTE = "have other names"


def list_variants() -> Iterator[Variant]:
    """Yield the variants of this module."""
    for ending in (".Jpg", ".JPG", ".jpeg", ".JPEG"):
        yield Variant(
            f"names: {ending} on disk",
            lambda s, e=ending: s.encode(e, quality=95, subsampling="4:4:4"),
            layouts=ALL_LAYOUTS,
        )
    for ending in (".png", ".PNG", ".bmp", ".tif", ".TIF", ".tiff", ".jp2"):
        yield Variant(f"names: {ending} on disk", lambda s, e=ending: s.encode(e), layouts=ALL_LAYOUTS)
    for ending in (".webp", ".WEBP", ".avif", ".heic", ".HEIC"):
        yield Variant(
            f"names: {ending} on disk",
            lambda s, e=ending: s.encode(e, quality=95, subsampling="4:4:4"),
            layouts=ALL_LAYOUTS,
        )
    yield Variant(
        "names: capitals on disk",
        lambda s: _move_photos(s, lambda f: str(f.with_name(f.name.upper()))),
        layouts=ALL_LAYOUTS,
    )
    yield Variant(
        "names: capitals in the poses",
        lambda s: s.rename_in_poses(str.upper),
        layouts=ALL_LAYOUTS,
        note=LOOSE_MATCH_NOTE,
    )
    yield Variant("names: .png added on disk", lambda s: (s.encode(".png"), _move_photos(s, _append_png_ending)))
    yield Variant(
        "names: no ending in the poses",
        lambda s: s.rename_in_poses(lambda n: str(PurePosixPath(n).with_suffix(""))),
        layouts=ALL_LAYOUTS,
    )
    yield Variant(
        "names: .NEF in the poses",
        lambda s: s.rename_in_poses(lambda n: str(PurePosixPath(n).with_suffix(".NEF"))),
        note=LOOSE_MATCH_NOTE,
    )
    for prefix in (
        "/home/x/images/",
        "C:\\x\\images\\",
        "\\\\server\\images\\",
        "images/",
        "./",
        "../images/",
        "project/run 1/images/",
    ):
        yield Variant(f"names: {prefix} before them", lambda s, p=prefix: s.rename_in_poses(lambda n: p + n))
        if not prefix.startswith("."):
            yield Variant(
                f"names: {prefix} before them",
                lambda s, p=prefix: s.rename_in_poses(lambda n: p + n),
                layouts=JSON_LAYOUTS,
            )
    for text in (False, True):
        as_text = "text" if text else "binary"
        for what, part in (
            ("spaces", "my photo (1) "),
            ("two spaces", "a  b "),
            ("a hash", "#1 "),
            ("accents", "Zoë_ß_"),
            ("kanji", "写真"),
        ):
            yield Variant(f"names: {what}, {as_text}", lambda s, p=part, t=text: _rename(s, lambda n: p + n, t))
    yield Variant(
        "names: NFD on disk, NFC in the poses",
        lambda s: (_rename(s, lambda n: f"Müller é {n}"), _move_photos(s, lambda f: _to_nfd(str(f)))),
        note=LOOSE_MATCH_NOTE,
    )
    yield Variant(
        "names: NFC on disk, NFD in the poses",
        lambda s: (_rename(s, lambda n: f"Müller é {n}"), s.rename_in_poses(_to_nfd)),
        note=LOOSE_MATCH_NOTE,
    )
    yield Variant(
        "names: NFD on disk, NFC in the poses",
        lambda s: (_move_photos(s, lambda f: _to_nfd(_add_accents(f))), s.rename_in_poses(_add_accents)),
        layouts=JSON_LAYOUTS,
        note=LOOSE_MATCH_NOTE,
    )
    yield Variant(
        "names: in a folder on disk alone",
        lambda s: _move_photos(s, lambda f: f"images/left/{f.name}"),
        note=LOOSE_MATCH_NOTE,
    )
    yield Variant(
        "names: in a folder in the poses alone",
        lambda s: s.rename_in_poses(lambda n: f"left/{n}"),
        note=LOOSE_MATCH_NOTE,
    )
    yield Variant(
        "names: folders of one name each", lambda s: _rename(s, lambda n: f"{PurePosixPath(n).stem}/photo.jpg")
    )
    yield Variant(
        "names: a folder for each, of one name, absolute",
        lambda s: (_rename(s, lambda n: f"{PurePosixPath(n).stem}/photo.jpg"), s.rename_in_poses(lambda n: f"/x/{n}")),
        note=LOOSE_MATCH_NOTE,
    )
    yield Variant(
        "names: folders of one name each, flat on disk",
        lambda s: (
            s.rename_in_poses(lambda n: f"{PurePosixPath(n).stem}/photo.jpg"),
            _move_photos(s, _same_photo_path),
        ),
        "none of the",
    )
    yield Variant(
        "names: two files for each",
        lambda s: (
            s.encode(".png"),
            _add_black_pictures(s, ".webp"),
            s.rename_in_poses(lambda n: f"{PurePosixPath(n).stem}.jpg"),
        ),
        "cannot be assigned",
        layouts=("colmap",),
    )
    yield Variant("names: a copy beside each", lambda s: _add_black_pictures(s, ".webp"))
    yield Variant(
        "names: a third is missing",
        lambda s: [file.unlink() for file in s.photos[1::3]],
        layouts=ALL_LAYOUTS,
        note="not on disk",
        may_lack_photos=True,
    )
    yield Variant(
        "names: of other photos",
        lambda s: _move_photos(s, lambda f: str(f.with_name(f"other {f.stem[::-1]}.jpg"))),
        "nearest by name|holds no file",
        layouts=ALL_LAYOUTS,
    )


def _append_png_ending(file: PurePosixPath) -> str:
    return f"{file.with_suffix('.jpg')}.png"


def _same_photo_path(file: PurePosixPath) -> str:
    return "images/photo.jpg"


def _rename(s: WorkingSet, change: Callable[[str], str], text: bool = False) -> None:
    """Rename the photos on disk and in the poses."""
    _move_photos(s, lambda file: f"images/{change(file.relative_to('images').as_posix())}")
    s.rename_in_poses(change, text=text)


def _add_black_pictures(s: WorkingSet, ending: str) -> None:
    """Add a black picture with the same name and another ending beside each photo."""
    for file in s.photos:
        Image.new("RGB", (8, 8)).save(file.with_suffix(ending))


def _to_nfd(text: str) -> str:
    return unicodedata.normalize("NFD", text)


def _add_accents(file: PurePosixPath | str) -> str:
    path = PurePosixPath(file)
    return str(path.with_name(f"Müller é {path.name}"))


def _move_photos(s: WorkingSet, change: Callable[[PurePosixPath], str]) -> None:
    """Move the photos to other paths below the set's folder."""
    moves = [(file, s.root / change(PurePosixPath(file.relative_to(s.root)))) for file in s.photos]
    for number, (file, _) in enumerate(moves):
        file.rename(s.root / f"moving {number}")
    for number, (_, target) in enumerate(moves):
        target.parent.mkdir(parents=True, exist_ok=True)
        (s.root / f"moving {number}").rename(target)
