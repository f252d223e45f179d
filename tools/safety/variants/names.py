"""Photos under other names than the poses say: endings, capitals, folders, accents, missing ones, copies."""

from __future__ import annotations

import unicodedata
from collections.abc import Callable, Iterator
from pathlib import PurePosixPath

from PIL import Image

from tools.safety.variants.variant import ALL, Variant
from tools.safety.variants.working_set import WorkingSet

JSON = ("nerfstudio", "blender")
LOOSE = "called otherwise"


def variants() -> Iterator[Variant]:
    for ending in (".Jpg", ".JPG", ".jpeg", ".JPEG"):
        yield Variant(
            f"names: {ending} on disk", lambda s, e=ending: s.encode(e, quality=95, subsampling="4:4:4"), layouts=ALL
        )
    for ending in (".png", ".PNG", ".bmp", ".tif", ".TIF", ".tiff", ".jp2"):
        yield Variant(f"names: {ending} on disk", lambda s, e=ending: s.encode(e), layouts=ALL)
    for ending in (".webp", ".WEBP", ".avif", ".heic", ".HEIC"):
        yield Variant(
            f"names: {ending} on disk", lambda s, e=ending: s.encode(e, quality=95, subsampling="4:4:4"), layouts=ALL
        )
    yield Variant(
        "names: capitals on disk", lambda s: _move(s, lambda f: str(f.with_name(f.name.upper()))), layouts=ALL
    )
    yield Variant("names: capitals in the poses", lambda s: s.relist(str.upper), layouts=ALL, note=LOOSE)
    yield Variant("names: .png added on disk", lambda s: (s.encode(".png"), _move(s, _doubled)))
    yield Variant(
        "names: no ending in the poses",
        lambda s: s.relist(lambda n: str(PurePosixPath(n).with_suffix(""))),
        layouts=ALL,
    )
    yield Variant(
        "names: .NEF in the poses", lambda s: s.relist(lambda n: str(PurePosixPath(n).with_suffix(".NEF"))), note=LOOSE
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
        yield Variant(f"names: {prefix} before them", lambda s, p=prefix: s.relist(lambda n: p + n))
        if not prefix.startswith("."):
            yield Variant(f"names: {prefix} before them", lambda s, p=prefix: s.relist(lambda n: p + n), layouts=JSON)
    for text in (False, True):
        as_text = "text" if text else "binary"
        for what, part in (
            ("spaces", "my photo (1) "),
            ("two spaces", "a  b "),
            ("a hash", "#1 "),
            ("accents", "Zoë_ß_"),
            ("kanji", "写真"),
        ):
            yield Variant(f"names: {what}, {as_text}", lambda s, p=part, t=text: _renamed(s, lambda n: p + n, t))
    yield Variant(
        "names: NFD on disk, NFC in the poses",
        lambda s: (_renamed(s, lambda n: f"Müller é {n}"), _move(s, lambda f: _nfd(str(f)))),
        note=LOOSE,
    )
    yield Variant(
        "names: NFC on disk, NFD in the poses",
        lambda s: (_renamed(s, lambda n: f"Müller é {n}"), s.relist(_nfd)),
        note=LOOSE,
    )
    yield Variant(
        "names: NFD on disk, NFC in the poses",
        lambda s: (_move(s, lambda f: _nfd(_accented(f))), s.relist(_accented)),
        layouts=JSON,
        note=LOOSE,
    )
    yield Variant("names: in a folder on disk alone", lambda s: _move(s, lambda f: f"images/left/{f.name}"), note=LOOSE)
    yield Variant("names: in a folder in the poses alone", lambda s: s.relist(lambda n: f"left/{n}"), note=LOOSE)
    yield Variant(
        "names: folders of one name each", lambda s: _renamed(s, lambda n: f"{PurePosixPath(n).stem}/photo.jpg")
    )
    yield Variant(
        "names: a folder for each, of one name, absolute",
        lambda s: (_renamed(s, lambda n: f"{PurePosixPath(n).stem}/photo.jpg"), s.relist(lambda n: f"/x/{n}")),
        note=LOOSE,
    )
    yield Variant(
        "names: folders of one name each, flat on disk",
        lambda s: (s.relist(lambda n: f"{PurePosixPath(n).stem}/photo.jpg"), _move(s, _one_photo)),
        "none of the",
    )
    yield Variant(
        "names: two files for each",
        lambda s: (s.encode(".png"), _beside(s, ".webp"), s.relist(lambda n: f"{PurePosixPath(n).stem}.jpg")),
        "is unclear",
        layouts=("colmap",),
    )
    yield Variant("names: a copy beside each", lambda s: _beside(s, ".webp"))
    yield Variant(
        "names: a third is missing",
        lambda s: [file.unlink() for file in s.photos[1::3]],
        layouts=ALL,
        note="not on disk",
    )
    yield Variant(
        "names: of other photos",
        lambda s: _move(s, lambda f: str(f.with_name(f"other {f.stem[::-1]}.jpg"))),
        "nearest by name|holds no file",
        layouts=ALL,
    )


def _doubled(file: PurePosixPath) -> str:
    return f"{file.with_suffix('.jpg')}.png"


def _one_photo(file: PurePosixPath) -> str:
    return "images/photo.jpg"


def _renamed(s: WorkingSet, change: Callable[[str], str], text: bool = False) -> None:
    """On disk and in the poses."""
    _move(s, lambda file: f"images/{change(file.relative_to('images').as_posix())}")
    s.relist(change, text=text)


def _beside(s: WorkingSet, ending: str) -> None:
    """Another, black, picture of the same name with another ending."""
    for file in s.photos:
        Image.new("RGB", (8, 8)).save(file.with_suffix(ending))


def _nfd(text: str) -> str:
    return unicodedata.normalize("NFD", text)


def _accented(file: PurePosixPath | str) -> str:
    path = PurePosixPath(file)
    return str(path.with_name(f"Müller é {path.name}"))


def _move(s: WorkingSet, change: Callable[[PurePosixPath], str]) -> None:
    """Give photo files other paths below the set's folder."""
    moves = [(file, s.root / change(PurePosixPath(file.relative_to(s.root)))) for file in s.photos]
    for number, (file, _) in enumerate(moves):
        file.rename(s.root / f"moving {number}")
    for number, (_, target) in enumerate(moves):
        target.parent.mkdir(parents=True, exist_ok=True)
        (s.root / f"moving {number}").rename(target)
