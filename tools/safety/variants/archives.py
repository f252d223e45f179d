"""Variants as one ZIP archive: as various programs write it, truncated, or malicious."""

from __future__ import annotations

import re
import shutil
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path

from tools.safety.variants.variant import ALL_LAYOUTS, Variant
from tools.safety.variants.working_set import WorkingSet


def list_variants() -> Iterator[Variant]:
    """Yield the variants of this module."""
    note = "was unpacked"
    yield Variant("zip: flat", _zip_set, layouts=ALL_LAYOUTS, note=note)
    yield Variant("zip: one folder", lambda s: _zip_set(s, "my set/"), layouts=ALL_LAYOUTS, note=note)
    yield Variant("zip: of a Mac", lambda s: _zip_set(s, "set/", before=_add_mac_files), layouts=ALL_LAYOUTS, note=note)
    yield Variant("zip: with backslashes", lambda s: _use_backslashes(_zip_set(s, "set/")), note=note)
    yield Variant(
        "zip: a file leads out",
        lambda s: _zip_set(s, before=lambda z: z.writestr("../evil.txt", "")),
        "outside its folder",
    )
    yield Variant(
        "zip: an absolute file",
        lambda s: _zip_set(s, before=lambda z: z.writestr("/evil.txt", "")),
        "outside its folder",
    )
    yield Variant("zip: a link", lambda s: _zip_set(s, before=_add_link), "holds a link")
    yield Variant("zip: a bomb", lambda s: _zip_set(s, before=_add_bomb), "unlikely for a set")
    yield Variant("zip: encrypted", lambda s: _set_encrypted_flags(_zip_set(s)), "encrypted")
    yield Variant("zip: cut", lambda s: _truncate(_zip_set(s)), "damaged")
    yield Variant("zip: a byte is wrong", lambda s: _change_byte(_zip_set(s)), "damaged|cannot|ends after|not a")
    yield Variant("zip: empty", lambda s: (shutil.rmtree(s.root), s.root.mkdir(), _zip_set(s)), "holds no file")
    yield Variant("zip: photos alone", lambda s: (shutil.rmtree(s.root / "sparse"), _zip_set(s)), "no poses found")


def _zip_set(s: WorkingSet, top: str = "", *, before: Callable[[zipfile.ZipFile], None] = lambda archive: None) -> Path:
    """Replace the set's folder by one archive; return its path."""
    s.source_path = s.root.with_suffix(".zip")
    with zipfile.ZipFile(s.source_path, "w", zipfile.ZIP_DEFLATED) as archive:
        before(archive)
        for file in sorted(path for path in s.root.rglob("*") if path.is_file()):
            archive.write(file, top + file.relative_to(s.root).as_posix())
    shutil.rmtree(s.root)
    return s.source_path


def _add_mac_files(archive: zipfile.ZipFile) -> None:
    archive.writestr("__MACOSX/set/._a.jpg", "x")
    archive.writestr("set/.DS_Store", "x")


def _add_link(archive: zipfile.ZipFile) -> None:
    info = zipfile.ZipInfo("images/link.jpg")
    info.external_attr = 0o120777 << 16
    archive.writestr(info, "/etc/passwd")


def _add_bomb(archive: zipfile.ZipFile) -> None:
    """Add a file whose declared size is a terabyte."""
    archive.writestr("zeros", bytes(1000))
    archive.filelist[-1].file_size = 1 << 40


def _use_backslashes(archive: Path) -> None:
    content = archive.read_bytes()
    for name in zipfile.ZipFile(archive).namelist():
        content = content.replace(name.encode(), name.replace("/", "\\").encode())
    archive.write_bytes(content)


def _set_encrypted_flags(archive: Path) -> None:
    """Set the flags of encryption; the reader refuses the archive before it reads the contents."""
    content = bytearray(archive.read_bytes())
    for match in re.finditer(rb"PK\x03\x04", bytes(content)):
        content[match.start() + 6] |= 1
    for match in re.finditer(rb"PK\x01\x02", bytes(content)):
        content[match.start() + 8] |= 1
    archive.write_bytes(bytes(content))


def _truncate(archive: Path) -> None:
    archive.write_bytes(archive.read_bytes()[:-200])


def _change_byte(archive: Path) -> None:
    content = bytearray(archive.read_bytes())
    content[len(content) // 2] ^= 0xFF
    archive.write_bytes(bytes(content))
