"""Reuse a stored result of a study only if this version made it, with the same settings and from the same data."""

from __future__ import annotations

import hashlib
import json
import shutil
import subprocess
from functools import cache
from pathlib import Path

from hyrfpack.errors import HyrfError
from tools.json_files import write_json

REPOSITORY_ROOT = Path(__file__).parents[2]
ORIGIN_FILE = "origin.json"
DIGEST_CHARACTERS = 8
SOURCE_FOLDERS = ("hyrfpack", "tools")  # Other files do not change results, or are results themselves.

Origin = dict[str, object]


def describe_version(folder: Path) -> str:
    """Return the last commit that changed the sources of a work tree, with a digest of what is not committed.

    Raises:
        HyrfError: there is no such folder, or it is no work tree of git.
    """
    if not folder.is_dir():
        raise HyrfError(f"{folder}: there is no such folder", fix="make it with git worktree add")

    def run_git(*words: str) -> str:
        process = subprocess.run(["git", *words], cwd=folder, capture_output=True, text=True, check=False)
        if process.returncode:
            problem = f"{folder}: git cannot tell the version ({process.stderr.strip()})"
            raise HyrfError(problem, fix="make the folder with git worktree add")
        return process.stdout.strip()

    name = run_git("log", "-1", "--format=%h", "--abbrev=12", "--", *SOURCE_FOLDERS)
    listed = run_git("ls-files", "--others", "--exclude-standard", "-z", "--", *SOURCE_FOLDERS).split("\0")
    untracked = [folder / path for path in sorted(listed) if (folder / path).is_file()]
    changes = run_git("diff", "HEAD", "--", *SOURCE_FOLDERS)
    if changes or untracked:
        digest = hashlib.sha256(changes.encode())
        for path in untracked:
            digest.update(str(path.relative_to(folder)).encode() + path.read_bytes())
        name += f"-dirty-{digest.hexdigest()[:DIGEST_CHARACTERS]}"
    return name


@cache
def describe_own_version() -> str:
    """Return the version that this process runs; without git, as on a GPU machine, a digest of the sources."""
    try:
        return describe_version(REPOSITORY_ROOT)
    except (HyrfError, FileNotFoundError):
        digest = hashlib.sha256()
        for path in sorted(path for folder in SOURCE_FOLDERS for path in REPOSITORY_ROOT.glob(f"{folder}/**/*.py")):
            digest.update(str(path.relative_to(REPOSITORY_ROOT)).encode() + path.read_bytes())
        return f"sources-{digest.hexdigest()[:DIGEST_CHARACTERS]}"


def describe_origin(data: Path, version: str | None = None, **settings: object) -> Origin:
    """Return all that a result depends on, as it is stored beside the result.

    Args:
        data: the data set.
        version: the version that makes the result; None for this one.
        settings: what else the result depends on; values of JSON.
    """
    origin = {"version": version or describe_own_version(), "data": str(data.resolve()), **settings}
    return json.loads(json.dumps(origin))  # as it is read again, where tuples are lists


def find_differences(folder: Path, origin: Origin) -> list[str]:
    """Return how the stored origin of a folder's result differs from `origin`, one sentence for each difference."""
    path = folder / ORIGIN_FILE
    if not path.exists():
        return [f"it has no {ORIGIN_FILE}, which says how it was made"]
    stored = json.loads(path.read_text())
    keys = dict.fromkeys([*origin, *stored])
    return [f"{key} was {stored.get(key)}, now {origin.get(key)}" for key in keys if stored.get(key) != origin.get(key)]


def check_origin(folder: Path, origin: Origin) -> None:
    """Refuse a folder whose result has another origin.

    Raises:
        HyrfError: it has.
    """
    if differences := find_differences(folder, origin):
        problem = f"{folder}: this run is not one of the same version, settings and data: {'; '.join(differences)}"
        raise HyrfError(problem, fix="name another folder with `out`, or remove this one")


def remove_outdated(folder: Path, origin: Origin) -> None:
    """Remove a folder whose result has another origin, and store `origin` in a folder that is new or was removed.

    Raises:
        HyrfError: the folder has files but no origin, so that they may be anyone's.
    """
    if folder.exists() and any(folder.iterdir()) and not (folder / ORIGIN_FILE).exists():
        raise HyrfError(f"{folder}: it has files but no {ORIGIN_FILE}", fix="name another folder, or remove this one")
    if find_differences(folder, origin):
        shutil.rmtree(folder, ignore_errors=True)
        write_origin(folder, origin)


def write_origin(folder: Path, origin: Origin) -> None:
    """Store how the result in a folder is made."""
    write_json(folder / ORIGIN_FILE, origin)
