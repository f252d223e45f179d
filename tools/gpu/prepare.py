"""Prepare a real data set for a GPU machine that has no network and lacks packages, and print the commands to run.

    python -m tools.gpu.prepare --data ../shared/data/mipnerf360_bonsai

It copies the set with the poses of a COLMAP model as a transforms.json, which hyrfpack reads without pycolmap, and
checks that folder and repository together are small enough to be copied to the machine. The folder lies in build/,
which git ignores, so name it where the machine asks for extra paths. What it held before is replaced.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from hyrfpack.data import load_scene
from hyrfpack.errors import HyrfError
from hyrfpack.export.cameras import encode_transforms
from hyrfpack.ply import encode_colored_points
from hyrfpack.scene import Scene
from tools.command import run_command

REPOSITORY_ROOT = Path(__file__).parents[2]
BUILD_FOLDER = REPOSITORY_ROOT / "build"
MAX_MEGABYTES = 64.0
POINTS_FILE = "points.ply"


def copy_dataset(source: Path, target: Path) -> None:
    """Copy a data set; a COLMAP model becomes a transforms.json with the same split.

    Raises:
        HyrfError: the copy would be another scene, as where photos are distorted.
    """
    scene = load_scene(source)
    if scene.layout != "colmap":
        shutil.copytree(source, target, copy_function=shutil.copyfile)
        return
    views = sorted(scene.train + scene.test, key=lambda view: view.name)
    for view in views:
        photo = target / "images" / view.name
        photo.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(source / "images" / view.name, photo)
    content = json.loads(encode_transforms([(f"images/{view.name}", view.camera) for view in views]))
    content["ply_file_path"] = POINTS_FILE
    (target / "transforms.json").write_text(json.dumps(content))
    (target / POINTS_FILE).write_bytes(encode_colored_points(scene.points, np.round(255 * scene.point_colors)))
    if not is_same_scene(scene, load_scene(target)):
        raise HyrfError(f"{source}: the copy differs, maybe because the photos are distorted", fix="use another set")


def is_same_scene(first: Scene, second: Scene) -> bool:
    """Return whether two scenes have the same photos for training and tests, cameras and points, but for rounding."""
    views, second_views = first.train + first.test, second.train + second.test
    if [v.name for v in views] != [v.name for v in second_views] or len(first.train) != len(second.train):
        return False
    return np.allclose(first.points, second.points, rtol=1e-6) and all(
        np.allclose(view.camera.camera_from_world, second_view.camera.camera_from_world)
        and np.allclose(view.camera.intrinsics, second_view.camera.intrinsics)
        and np.array_equal(view.load().rgb, second_view.load().rgb)
        for view, second_view in zip(views, second_views, strict=True)
    )


def list_check_commands(data: Path, commit: str, out: str) -> list[str]:
    """Return the commands for the GPU machine: the default parts, then short and long training.

    Args:
        data: the copied set, relative to the repository's root.
        commit: the commit that is checked.
        out: the folder for results, as the shell there writes it.
    """
    check = f"timeout 590 python3 -m tools.gpu.check --commit {commit} --out {out}"
    return [check, *(f"{check} --parts {parts} --data {data.as_posix()}" for parts in ("quality ranks", "full-run"))]


def measure_folder_bytes(folder: Path) -> int:
    """Return the size of all files below a folder."""
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


def measure_tree_bytes() -> int:
    """Return the size of the files of the repository that git knows."""
    listed = _git("ls-files", "-z").split("\0")
    return sum(path.stat().st_size for path in (REPOSITORY_ROOT / name for name in listed if name) if path.is_file())


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help="a small data set to copy")
    parser.add_argument("--folder", type=Path, default=Path("build/gpu"), help="a folder below build/ (build/gpu)")
    parser.add_argument("--out", default="$OUT", help="the folder for results there ($OUT)")
    args = parser.parse_args(arguments)
    folder = (REPOSITORY_ROOT / args.folder).resolve()
    if BUILD_FOLDER.resolve() not in folder.parents:
        parser.error(f"--folder {args.folder} would be replaced; name a folder below build/, such as build/gpu")
    BUILD_FOLDER.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory(dir=BUILD_FOLDER) as temporary:
        # The report names the set by its folder.
        copy_dataset(args.data, Path(temporary, "copy", args.data.name))
        shutil.rmtree(folder, ignore_errors=True)
        folder.parent.mkdir(parents=True, exist_ok=True)
        Path(temporary, "copy").rename(folder)
    megabytes = (measure_folder_bytes(folder) + measure_tree_bytes()) / 2**20
    print(f"{args.folder}: {measure_folder_bytes(folder) / 2**20:.1f} MiB; with the repository {megabytes:.1f} MiB")
    if megabytes > MAX_MEGABYTES:
        print(f"tools.gpu.prepare: that is more than {MAX_MEGABYTES:.0f} MiB; use a smaller data set", file=sys.stderr)
        return 1
    print("On the GPU machine, in the repository's root, one command each:")
    commit = _git("describe", "--always", "--dirty", "--abbrev=12").strip()
    for command in list_check_commands(args.folder / args.data.name, commit, args.out):
        print(f"    {command}")
    return 0


def _git(*words: str) -> str:
    return subprocess.run(["git", *words], cwd=REPOSITORY_ROOT, capture_output=True, text=True, check=True).stdout


if __name__ == "__main__":
    run_command(main)
