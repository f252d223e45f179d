"""Writers of the capture layouts that other programs export.

They follow the documents of those programs, and use other algebra than the readers. Each layout has one function,
`write(root, cameras, points, colors)`. `photo_path` says where the photos lie.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

# Converts OpenCV camera axes to OpenGL axes and back.
OPENGL_FROM_OPENCV = np.diag([1.0, -1, -1, 1])


@dataclass(frozen=True)
class PhotoCamera:
    """The name of a photo and its OpenCV pinhole camera."""

    name: str
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    camera_from_world: np.ndarray

    @property
    def world_from_camera(self) -> np.ndarray:
        return np.linalg.inv(self.camera_from_world)


def photo_path(layout: str, index: int, name: str) -> str:
    """Return the path of a photo below the root of a set, for a layout."""
    if layout == "polycam":
        return f"keyframes/corrected_images/{Path(name).stem}.jpg"
    if layout == "record3d":
        return f"rgbd/{index}.jpg"
    return f"images/{name}"


def write_llff(root: Path, cameras: list[PhotoCamera], points: np.ndarray, colors: np.ndarray) -> None:
    rows = []
    for camera in cameras:
        right, down, forward, position = camera.world_from_camera[:3].T
        hwf = np.array([camera.height, camera.width, camera.fx])
        rows.append([*np.column_stack((down, right, -forward, position, hwf)).ravel(), 1.0, 10.0])
    np.save(root / "poses_bounds.npy", np.array(rows))


def write_bundler(root: Path, cameras: list[PhotoCamera], points: np.ndarray, colors: np.ndarray) -> None:
    lines = ["# Bundle file v0.3", f"{len(cameras)} {len(points)}"]
    for camera in cameras:
        seen = OPENGL_FROM_OPENCV @ camera.camera_from_world
        lines.append(f"{camera.fx!r} 0 0")
        lines += [" ".join(map(repr, row)) for row in [*seen[:3, :3].tolist(), seen[:3, 3].tolist()]]
    for point, color in zip(points, colors, strict=True):
        lines += [" ".join(map(repr, point.tolist())), " ".join(str(round(c * 255)) for c in color), "1 0 0 0.5 0.5"]
    (root / "bundle.out").write_text("\n".join(lines) + "\n")
    (root / "list.txt").write_text("".join(f"./{camera.name} 0 {camera.fx:.3f}\n" for camera in cameras))


def write_metashape(root: Path, cameras: list[PhotoCamera], points: np.ndarray, colors: np.ndarray) -> None:
    """Write a Metashape project whose component is rotated, shifted and scaled against the world."""
    rotation, scale, shift = (
        Rotation.from_euler("xyz", [10, 20, 30], degrees=True).as_matrix(),
        2.5,
        np.array([1, 2, 3.0]),
    )
    sensors, listed = [], []
    for index, camera in enumerate(cameras):
        sensors.append(
            f'<sensor id="{index}" label="unknown" type="frame"><resolution width="{camera.width}" '
            f'height="{camera.height}"/><calibration type="frame" class="adjusted"><resolution width="{camera.width}" '
            f'height="{camera.height}"/><f>{camera.fy!r}</f><cx>{camera.cx - camera.width / 2!r}</cx>'
            f"<cy>{camera.cy - camera.height / 2!r}</cy><b1>{camera.fx - camera.fy!r}</b1></calibration></sensor>"
        )
        inside = camera.world_from_camera
        inside[:3, :3] = rotation.T @ inside[:3, :3]
        inside[:3, 3] = rotation.T @ (inside[:3, 3] - shift) / scale
        numbers = " ".join(map(repr, inside.ravel().tolist()))
        listed.append(
            f'<camera id="{index}" sensor_id="{index}" component_id="0" label="{Path(camera.name).stem}">'
            f"<transform>{numbers}</transform><orientation>1</orientation></camera>"
        )
    words = [" ".join(map(repr, part)) for part in (rotation.ravel().tolist(), shift.tolist())]
    (root / "cameras.xml").write_text(
        '<?xml version="1.0" encoding="UTF-8"?>\n<document version="2.0.0">\n<chunk label="Chunk 1" enabled="true">'
        f'<sensors next_id="1">{"".join(sensors)}</sensors><components next_id="1" active_id="0"><component id="0" '
        f'label="Component 1"><transform><rotation locked="true">{words[0]}</rotation><translation>{words[1]}'
        f'</translation><scale>{scale}</scale></transform></component></components><cameras next_id="1">'
        f"{''.join(listed)}</cameras></chunk></document>\n"
    )
    write_ply(root / "points.ply", points, colors)


def write_realityscan(root: Path, cameras: list[PhotoCamera], points: np.ndarray, colors: np.ndarray) -> None:
    lines = ["#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2"]
    for camera in cameras:
        pose = camera.world_from_camera @ OPENGL_FROM_OPENCV
        angles = Rotation.from_matrix(pose[:3, :3]).as_euler("ZXY", degrees=True)
        side = max(camera.width, camera.height)
        lens = (camera.fx * 36 / side, (camera.cx - camera.width / 2) / side, (camera.cy - camera.height / 2) / side)
        values = (*pose[:3, 3].tolist(), -float(angles[0]), *angles[1:].tolist(), *lens, 0, 0, 0, 0, 0, 0)
        lines.append(",".join((camera.name, *map(repr, values))))
    (root / "registration.csv").write_text("\ufeff" + "\r\n".join(lines) + "\r\n", encoding="utf-8")
    write_ply(root / "sparse.ply", points, colors)


def write_polycam(root: Path, cameras: list[PhotoCamera], points: np.ndarray, colors: np.ndarray) -> None:
    folder = root / "keyframes" / "corrected_cameras"
    folder.mkdir(parents=True, exist_ok=True)
    for camera in cameras:
        pose = camera.world_from_camera @ OPENGL_FROM_OPENCV
        content = {f"t_{row}{column}": pose[row, column] for row in range(3) for column in range(4)}
        content |= {key: getattr(camera, key) for key in ("fx", "fy", "cx", "cy", "width", "height")}
        (folder / f"{Path(camera.name).stem}.json").write_text(json.dumps(content | {"blur_score": 100.0}))


def write_record3d(root: Path, cameras: list[PhotoCamera], points: np.ndarray, colors: np.ndarray) -> None:
    poses = [camera.world_from_camera @ OPENGL_FROM_OPENCV for camera in cameras]
    first = cameras[0]
    content = {
        "w": first.width,
        "h": first.height,
        "K": [first.fx, 0, 0, 0, first.fy, 0, first.cx, first.cy, 1],
        "poses": [[*Rotation.from_matrix(p[:3, :3]).as_quat().tolist(), *p[:3, 3].tolist()] for p in poses],
        "perFrameIntrinsicCoeffs": [[camera.fx, camera.fy, camera.cx, camera.cy] for camera in cameras],
    }
    (root / "metadata").write_text(json.dumps(content))


def write_ply(file: Path, points: np.ndarray, colors: np.ndarray) -> None:
    names = [*(f"property double {axis}" for axis in "xyz"), *(f"property uchar {c}" for c in ("red", "green", "blue"))]
    header = ["ply", "format ascii 1.0", f"element vertex {len(points)}", *names, "end_header"]
    rows = np.column_stack((points, np.round(np.asarray(colors) * 255)))
    lines = ["{!r} {!r} {!r} {:.0f} {:.0f} {:.0f}".format(*row) for row in rows.tolist()]
    file.write_text("\n".join((*header, *lines)) + "\n")


WRITERS_BY_LAYOUT = {
    "llff": write_llff,
    "metashape": write_metashape,
    "bundler": write_bundler,
    "realityscan": write_realityscan,
    "polycam": write_polycam,
    "record3d": write_record3d,
}
