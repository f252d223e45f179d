"""Writers of small scene folders, independent of the readers under test."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

PHOTO_WIDTH = 32
PHOTO_HEIGHT = 24


def rotation_of(quaternion: np.ndarray) -> np.ndarray:
    """Return the (3, 3) rotation matrix of a unit quaternion wxyz."""
    w, x, y, z = quaternion
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def poses_of(count: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return random camera-from-world poses as (quaternion wxyz, translation)."""
    rng = np.random.default_rng(5)
    quaternions = rng.normal(size=(count, 4))
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    return list(zip(quaternions, rng.normal(size=(count, 3)), strict=True))


def write_pictures(folder: Path, names: list[str], size: tuple[int, int] = (PHOTO_WIDTH, PHOTO_HEIGHT)) -> None:
    for index, name in enumerate(names):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        pixels = np.random.default_rng(index).integers(0, 256, (size[1], size[0], 3), dtype=np.uint8)
        Image.fromarray(pixels).save(folder / name)


class ColmapFolder:
    """A COLMAP model written byte by byte as COLMAP documents its format."""

    points = np.array([[0.0, 0, 1], [0.5, -0.5, 2], [1, 1, 3]])
    colors = np.array([[10, 20, 30], [255, 0, 128], [1, 2, 3]])

    def __init__(self, root: Path, count: int = 9, model: int = 1, params=(30.0, 31.0, 17.0, 11.0), extra: bool = True):
        self.root, self.count, self.model_id, self.params = root, count, model, params
        self.names = [f"{index:03d}.png" for index in range(count)]
        self.poses = poses_of(count)
        self.model = root / "sparse" / "0"
        self.model.mkdir(parents=True, exist_ok=True)
        if extra:
            write_pictures(root / "images", self.names)
        for table, content in self.tables().items():
            (self.model / table).write_bytes(content)

    def tables(self) -> dict[str, bytes]:
        cameras = (
            struct.pack("<QIiQQ", 1, 7, self.model_id, PHOTO_WIDTH, PHOTO_HEIGHT)
            + np.array(self.params, "<f8").tobytes()
        )
        images = struct.pack("<Q", self.count)
        for index, (quaternion, translation) in enumerate(self.poses):
            images += struct.pack("<I4d3dI", index + 1, *quaternion, *translation, 7)
            images += self.names[index].encode() + b"\0" + struct.pack("<Q", len(self.points))
            for point in range(len(self.points)):
                images += struct.pack("<ddQ", 3.0 * point, 5.0, point + 1)
        points = struct.pack("<Q", len(self.points))
        for index, (point, color) in enumerate(zip(self.points, self.colors, strict=True)):
            points += struct.pack("<Q3d3BdQ", index + 1, *point, *(int(c) for c in color), 0.5, self.count)
            for image in range(self.count):
                points += struct.pack("<II", image + 1, index)
        return {"cameras.bin": cameras, "images.bin": images, "points3D.bin": points}

    def camera_from_world(self, index: int) -> np.ndarray:
        quaternion, translation = self.poses[index]
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation_of(quaternion), translation
        return pose


@pytest.fixture
def colmap_folder():
    """The class ColmapFolder: colmap_folder(root, count, model, params)."""
    return ColmapFolder


@pytest.fixture
def opengl_frames():
    """A function frames(names) that returns transforms frames and the OpenCV camera_from_world of each."""

    def frames(names: list[str]) -> tuple[list[dict], list[np.ndarray]]:
        listed, poses = [], []
        for name, (quaternion, translation) in zip(names, poses_of(len(names)), strict=True):
            pose = np.eye(4)
            pose[:3, :3], pose[:3, 3] = rotation_of(quaternion), translation
            world_from_camera = np.linalg.inv(pose) @ np.diag([1.0, -1, -1, 1])
            listed.append({"file_path": name, "transform_matrix": world_from_camera.tolist()})
            poses.append(pose)
        return listed, poses

    return frames


@pytest.fixture
def nerfstudio_folder(tmp_path, opengl_frames):
    """A function write(count, **entries) that returns the root of a set; entries go to the top of transforms.json."""

    def write(count: int = 4, **entries) -> Path:
        names = [f"images/{index:03d}.png" for index in range(count)]
        write_pictures(tmp_path, names)
        intrinsics = {"fl_x": 30.0, "fl_y": 31.0, "cx": 17.0, "cy": 11.0, "w": PHOTO_WIDTH, "h": PHOTO_HEIGHT}
        content = {**intrinsics, "frames": opengl_frames(names)[0], **entries}
        (tmp_path / "transforms.json").write_text(json.dumps(content))
        return tmp_path

    return write


@pytest.fixture
def pictures():
    """The function write_pictures."""
    return write_pictures


@pytest.fixture
def random_poses():
    """A function random_poses(count) that returns rotations and translations, camera from world."""
    return lambda count: [(rotation_of(quaternion), translation) for quaternion, translation in poses_of(count)]
