"""Prepare a folder for a GPU machine that has no network and lacks packages, and print the command to run there.

    python -m tools.gpu.prepare --data ../shared/data/mipnerf360_bonsai

It downloads wheels of the packages that training on real photos needs, copies a small data set beside them, and checks
that folder and repository together are small enough to be copied to the machine. The folder lies in build/, which git
ignores, so name it where the machine asks for extra paths.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

REPOSITORY_ROOT = Path(__file__).parents[2]
PACKAGES = ("zstandard", "trimesh", "dahuffman", "pycolmap")
# pip's names of wheels for x86-64 Linux with glibc 2.28 or newer.
PLATFORMS = tuple(f"{name}_x86_64" for name in ("manylinux_2_28", "manylinux_2_27", "manylinux_2_17", "manylinux2014"))
MAX_MEGABYTES = 64.0
WHEELS_FOLDER, DATA_FOLDER = "wheels", "data"


def download_command(folder: Path, python: str) -> list[str]:
    """Return pip's command that downloads the wheels, without their dependencies, for another Python."""
    command = [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", "--only-binary=:all:"]
    platforms = [f"--platform={name}" for name in PLATFORMS]
    return [*command, "--python-version", python, *platforms, "--dest", str(folder), *PACKAGES]


def check_commands(folder: Path, commit: str, out: str) -> list[str]:
    """Return the two commands for the GPU machine: first the default parts, then training on the data set.

    Args:
        folder: the prepared folder, relative to the repository's root.
        commit: the commit that is checked.
        out: the folder for results, as the shell there writes it.
    """
    packages = f"/tmp/{folder.name}-packages"
    wheels, data = (folder / name for name in (WHEELS_FOLDER, DATA_FOLDER))
    install = f"python3 -m pip install --quiet --no-index --no-deps --target {packages} {wheels.as_posix()}/*.whl"
    check = f"PYTHONPATH={packages} timeout 590 python3 -m tools.gpu.check --commit {commit} --out {out}"
    return [f"{install}; {check}", f"{install}; {check} --parts quality --data {data.as_posix()}"]


def folder_bytes(folder: Path) -> int:
    """Return the size of all files below a folder."""
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


def tree_bytes() -> int:
    """Return the size of the files of the repository that git knows."""
    listed = _git("ls-files", "-z").split("\0")
    return sum(path.stat().st_size for path in (REPOSITORY_ROOT / name for name in listed if name) if path.is_file())


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, help="a small data set to copy")
    parser.add_argument("--folder", type=Path, default=Path("build/gpu"), help="the folder, in the repository")
    parser.add_argument("--python", default="3.12", help="Python's version on the GPU machine (3.12)")
    parser.add_argument("--out", default="$OUT", help="the folder for results there ($OUT)")
    args = parser.parse_args(arguments)
    folder = REPOSITORY_ROOT / args.folder
    shutil.rmtree(folder, ignore_errors=True)
    (folder / WHEELS_FOLDER).mkdir(parents=True)
    subprocess.run(download_command(folder / WHEELS_FOLDER, args.python), check=True)
    if args.data:
        shutil.copytree(args.data, folder / DATA_FOLDER, copy_function=shutil.copyfile)
    megabytes = (folder_bytes(folder) + tree_bytes()) / 2**20
    print(f"{args.folder}: {folder_bytes(folder) / 2**20:.1f} MiB; with the repository {megabytes:.1f} MiB")
    if megabytes > MAX_MEGABYTES:
        print(f"tools.gpu.prepare: that is more than {MAX_MEGABYTES:.0f} MiB; use a smaller data set", file=sys.stderr)
        return 1
    print("On the GPU machine, in the repository's root, one command each:")
    for command in check_commands(
        args.folder, _git("describe", "--always", "--dirty", "--abbrev=12").strip(), args.out
    ):
        print(f"    {command}")
    return 0


def _git(*words: str) -> str:
    return subprocess.run(["git", *words], cwd=REPOSITORY_ROOT, capture_output=True, text=True, check=True).stdout


if __name__ == "__main__":
    sys.exit(main())
