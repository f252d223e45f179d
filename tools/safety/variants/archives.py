"""Sets as one ZIP archive, as programs write them, cut short, or made to do harm."""

from __future__ import annotations

import re
import shutil
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path

from tools.safety.variants.variant import ALL, Variant
from tools.safety.variants.working_set import WorkingSet


def variants() -> Iterator[Variant]:
    unpacked = "was unpacked"
    yield Variant("zip: flat", _zipped, layouts=ALL, note=unpacked)
    yield Variant("zip: one folder", lambda s: _zipped(s, "my set/"), layouts=ALL, note=unpacked)
    yield Variant("zip: of a Mac", lambda s: _zipped(s, "set/", before=_mac), layouts=ALL, note=unpacked)
    yield Variant("zip: with backslashes", lambda s: _backslashes(_zipped(s, "set/")), note=unpacked)
    yield Variant(
        "zip: a file leads out",
        lambda s: _zipped(s, before=lambda z: z.writestr("../evil.txt", "")),
        "outside its folder",
    )
    yield Variant(
        "zip: an absolute file",
        lambda s: _zipped(s, before=lambda z: z.writestr("/evil.txt", "")),
        "outside its folder",
    )
    yield Variant("zip: a link", lambda s: _zipped(s, before=_link), "holds a link")
    yield Variant("zip: a bomb", lambda s: _zipped(s, before=_bomb), "no likely set")
    yield Variant("zip: encrypted", lambda s: _encrypted(_zipped(s)), "encrypted")
    yield Variant("zip: cut", lambda s: _cut(_zipped(s)), "damaged")
    yield Variant("zip: a byte is wrong", lambda s: _flipped(_zipped(s)), "damaged|cannot|ends after|not a")
    yield Variant("zip: empty", lambda s: (shutil.rmtree(s.root), s.root.mkdir(), _zipped(s)), "holds no file")
    yield Variant("zip: photos alone", lambda s: (shutil.rmtree(s.root / "sparse"), _zipped(s)), "no poses found")


def _zipped(s: WorkingSet, top: str = "", *, before: Callable[[zipfile.ZipFile], None] = lambda archive: None) -> Path:
    """The set as one archive, and no folder any more."""
    s.given = s.root.with_suffix(".zip")
    with zipfile.ZipFile(s.given, "w", zipfile.ZIP_DEFLATED) as archive:
        before(archive)
        for file in sorted(path for path in s.root.rglob("*") if path.is_file()):
            archive.write(file, top + file.relative_to(s.root).as_posix())
    shutil.rmtree(s.root)
    return s.given


def _mac(archive: zipfile.ZipFile) -> None:
    archive.writestr("__MACOSX/set/._a.jpg", "x")
    archive.writestr("set/.DS_Store", "x")


def _link(archive: zipfile.ZipFile) -> None:
    info = zipfile.ZipInfo("images/link.jpg")
    info.external_attr = 0o120777 << 16
    archive.writestr(info, "/etc/passwd")


def _bomb(archive: zipfile.ZipFile) -> None:
    """A file that is said to be of a terabyte."""
    archive.writestr("zeros", bytes(1000))
    archive.filelist[-1].file_size = 1 << 40


def _backslashes(archive: Path) -> None:
    content = archive.read_bytes()
    for name in zipfile.ZipFile(archive).namelist():
        content = content.replace(name.encode(), name.replace("/", "\\").encode())
    archive.write_bytes(content)


def _encrypted(archive: Path) -> None:
    """The flag alone; what is behind it is never looked at."""
    content = bytearray(archive.read_bytes())
    for found in re.finditer(rb"PK\x03\x04", bytes(content)):
        content[found.start() + 6] |= 1
    for found in re.finditer(rb"PK\x01\x02", bytes(content)):
        content[found.start() + 8] |= 1
    archive.write_bytes(bytes(content))


def _cut(archive: Path) -> None:
    archive.write_bytes(archive.read_bytes()[:-200])


def _flipped(archive: Path) -> None:
    content = bytearray(archive.read_bytes())
    content[len(content) // 2] ^= 0xFF
    archive.write_bytes(bytes(content))
