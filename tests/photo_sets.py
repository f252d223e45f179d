"""Sets of photos with poses in three layouts, and every path in them that commands read."""

from __future__ import annotations

import json
import math
import shutil
from pathlib import Path

import numpy as np
from PIL import Image

from hyrfpack.data import load_scene
from hyrfpack.demo.scene import write_demo_scene
from hyrfpack.export.cameras import write_colmap
from hyrfpack.scene import Camera

# Folders of photos and poses (COLMAP, NeRF-synthetic, nerfstudio), and the paths below them that commands read.
READ_PATHS_BY_SET = {
    "hall": (
        "",
        "/images",
        "/masks",
        "/sparse/0",
        "/images/0001.png",
        "/masks/0001.png",
        "/sparse/0/images.bin",
    ),
    "blender": (
        "",
        "/train",
        "/test",
        "/transforms_train.json",
        "/transforms_test.json",
        "/train/0.png",
        "/test/0.png",
    ),
    "nerfstudio": ("", "/images", "/masks", "/transforms.json", "/points.ply", "/images/0001.png", "/masks/0001.png"),
}


def write_photo_sets(folder: Path) -> list[tuple[str, Camera]]:
    """Write the sets of READ_PATHS_BY_SET, a link to one, and one with photos in `views`; return names and cameras."""
    nerfstudio = write_demo_scene(folder / "nerfstudio", views=4, size=16)
    poses = json.loads((nerfstudio / "transforms.json").read_text())
    (nerfstudio / poses["ply_file_path"]).rename(nerfstudio / "points.ply")
    poses["ply_file_path"] = "points.ply"
    (nerfstudio / "transforms.json").write_text(json.dumps(poses))
    photos = sorted((nerfstudio / "images").iterdir())

    _add_masks(nerfstudio, photos)
    scene = load_scene(nerfstudio)
    named = [(f"{Path(view.name).stem}.png", view.camera) for view in scene.views]
    for name, images in (("hall", "images"), ("views-of-its-own", "views")):
        write_colmap(named, folder / name, None)
        shutil.copytree(nerfstudio / "images", folder / name / images)
    _add_masks(folder / "hall", photos)
    _make_blender(folder / "blender", photos, poses["frames"])
    (folder / "link-to-set").symlink_to("hall")
    return named


def _add_masks(root: Path, photos: list[Path]) -> None:
    (root / "masks").mkdir()
    for photo in photos:
        Image.fromarray(np.full((16, 16), 255, np.uint8)).save(root / "masks" / photo.name)


def _make_blender(root: Path, photos: list[Path], frames: list[dict]) -> None:
    """Write a NeRF-synthetic set with two splits."""
    angle = 2 * math.atan(8 / frames[0]["fl_x"])
    for split, numbers in (("train", (0, 1, 2)), ("test", (3,))):
        (root / split).mkdir(parents=True)
        listed = []
        for place, number in enumerate(numbers):
            shutil.copy(photos[number], root / split / f"{place}.png")
            matrix = frames[number]["transform_matrix"]
            listed.append({"file_path": f"./{split}/{place}", "transform_matrix": matrix})
        content = {"camera_angle_x": angle, "frames": listed}
        (root / f"transforms_{split}.json").write_text(json.dumps(content))
