"""Take the permissions of a folder away, also from root, who runs some tests and may read everything."""

from __future__ import annotations

import os
from pathlib import Path

import pytest


def deny_access(patch: pytest.MonkeyPatch, folder: Path) -> None:
    """Let calls that list or search the folder fail, as those for a folder of mode 0 do."""

    def denied(usual, is_denied):
        def call(path=".", *arguments, **options):
            if isinstance(path, str | os.PathLike) and is_denied(Path(path)):
                raise PermissionError(13, "Permission denied", os.fspath(path))
            return usual(path, *arguments, **options)

        return call

    for name in ("stat", "lstat"):
        patch.setattr(os, name, denied(getattr(os, name), lambda path: folder in path.parents))
    for name in ("listdir", "scandir"):
        patch.setattr(os, name, denied(getattr(os, name), lambda path: path == folder))
    usual_access = os.access

    def access(path, *arguments, **options):
        return folder not in (Path(path), *Path(path).parents) and usual_access(path, *arguments, **options)

    patch.setattr(os, "access", access)
