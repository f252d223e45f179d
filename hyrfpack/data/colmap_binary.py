"""Walks COLMAP's binary tables before pycolmap is let at them.

pycolmap trusts the counts in these files: a cut-off file gives silent zeros, a forged count an endless loop.
The walk checks that every count fits the bytes that are there; little-endian throughout, layouts as COLMAP
documents them (src/colmap/scene/reconstruction_io).
"""

from __future__ import annotations

import struct
from pathlib import Path

from hyrfpack.errors import HyrfDataError

_U32 = struct.Struct("<I")
_U64 = struct.Struct("<Q")
_CAMERA = struct.Struct("<IiQQ")  # id, model, width, height; then the parameters as float64
_POSE_BYTES = 7 * 8
_SENSOR_BYTES = 4 + 4
_PARAMETERS = {0: 3, 1: 4, 2: 4, 3: 5, 4: 8, 5: 8, 6: 12, 7: 5, 8: 4, 9: 5, 10: 12, 11: 16}  # by COLMAP's model id


def check_binary_model(model: Path) -> None:
    """Check the tables of a binary model (and its rigs and frames, if any).

    Raises:
        HyrfDataError: a table ends early, goes on after its last record, or names an unknown camera model.
    """
    walks = {
        "cameras.bin": _walk_cameras,
        "images.bin": _walk_images,
        "points3D.bin": _walk_points,
        "rigs.bin": _walk_rigs,
        "frames.bin": _walk_frames,
    }
    for name, walk in walks.items():
        if (model / name).is_file():
            table = _Table(model / name)
            walk(table)
            table.finish()


class _Table:
    """A file read front to back; a step past the end is a HyrfDataError."""

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            self.data = path.read_bytes()
        except OSError as error:
            raise HyrfDataError(f"{path}: cannot be read ({error.strerror}); check its permissions") from error
        self.at = 0

    def skip(self, size: int) -> int:
        """Step over `size` bytes and return where they start."""
        start, self.at = self.at, self.at + size
        if self.at > len(self.data):
            raise HyrfDataError(
                f"{self.path}: the file ends after {len(self.data)} bytes, inside a record that goes on to "
                f"{self.at}; it is truncated or damaged, export the model again"
            )
        return start

    def read(self, layout: struct.Struct) -> tuple:
        return layout.unpack_from(self.data, self.skip(layout.size))

    def count(self, layout: struct.Struct = _U64) -> range:
        return range(self.read(layout)[0])

    def skip_name(self) -> None:
        end = self.data.find(b"\0", self.at)
        name = self.data[self.at : end]
        self.skip(end + 1 - self.at if end >= 0 else len(self.data) + 1 - self.at)
        try:
            name.decode()
        except UnicodeDecodeError as error:
            raise HyrfDataError(f"{self.path}: a photo's name is not UTF-8 text; export the model again") from error

    def finish(self) -> None:
        if self.at != len(self.data):
            raise HyrfDataError(
                f"{self.path}: {len(self.data) - self.at} bytes follow the last record that its count announces; "
                "it is damaged, export the model again"
            )


def _walk_cameras(table: _Table) -> None:
    for _ in table.count():
        _, model, _, _ = table.read(_CAMERA)
        if model not in _PARAMETERS:
            raise HyrfDataError(
                f"{table.path}: camera model number {model} is not supported; undistort the photos with COLMAP first"
            )
        table.skip(8 * _PARAMETERS[model])


def _walk_images(table: _Table) -> None:
    for _ in table.count():
        table.skip(4 + _POSE_BYTES + 4)  # id, pose, camera
        table.skip_name()
        table.skip(24 * table.read(_U64)[0])  # x, y, 3D point


def _walk_points(table: _Table) -> None:
    for _ in table.count():
        table.skip(8 + 24 + 3 + 8)  # id, position, colour, error
        table.skip(8 * table.read(_U64)[0])  # image, index of its 2D point


def _walk_rigs(table: _Table) -> None:
    for _ in table.count():
        table.skip(4)
        sensors = table.count(_U32)
        if sensors:
            table.skip(_SENSOR_BYTES)  # the reference sensor has no pose
        for _ in sensors[1:]:
            table.skip(_SENSOR_BYTES)
            has_pose = table.data[table.skip(1)]
            table.skip(_POSE_BYTES if has_pose else 0)


def _walk_frames(table: _Table) -> None:
    for _ in table.count():
        table.skip(4 + 4 + _POSE_BYTES)  # id, rig, pose
        table.skip((_SENSOR_BYTES + 8) * table.read(_U32)[0])
