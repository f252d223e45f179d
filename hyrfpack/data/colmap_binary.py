"""Validate COLMAP's binary tables before pycolmap reads them.

pycolmap trusts the counts in these files. It reads a truncated file as zeros without an error, and a forged count leads
to an endless loop. This module checks that every count fits the size of the file. All numbers are little-endian, and
the layouts are those that COLMAP documents (src/colmap/scene/reconstruction_io).
"""

from __future__ import annotations

import struct
from pathlib import Path

from hyrfpack.errors import HyrfDataError

_U32_STRUCT = struct.Struct("<I")
_U64_STRUCT = struct.Struct("<Q")
_CAMERA_STRUCT = struct.Struct("<IiQQ")  # id, model, width, height; the parameters follow as float64
_POSE_BYTES = 7 * 8
_SENSOR_BYTES = 4 + 4
# Number of parameters by COLMAP's number of the camera model.
_PARAMETER_COUNTS = {
    0: 3,
    1: 4,
    2: 4,
    3: 5,
    4: 8,
    5: 8,
    6: 12,
    7: 5,
    8: 4,
    9: 5,
    10: 12,
    11: 16,
}


def check_binary_model(model: Path) -> None:
    """Check the tables of a binary model (and its rigs and frames, if any).

    Raises:
        HyrfDataError: a table is truncated, has bytes after its last record, or names an unknown camera model.
    """
    checks = {
        "cameras.bin": _check_cameras,
        "images.bin": _check_images,
        "points3D.bin": _check_points,
        "rigs.bin": _check_rigs,
        "frames.bin": _check_frames,
    }
    for name, check in checks.items():
        if (model / name).is_file():
            table = _TableReader(model / name)
            check(table)
            table.finish()


class _TableReader:
    """Reads a file from front to back; reading past the end raises HyrfDataError."""

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            self.data = path.read_bytes()
        except OSError as error:
            raise HyrfDataError(f"{path}: cannot be read ({error.strerror})", fix="check its permissions") from error
        self.offset = 0

    def skip(self, size: int) -> int:
        """Skip `size` bytes and return the offset at which they start."""
        start, self.offset = self.offset, self.offset + size
        if self.offset > len(self.data):
            raise HyrfDataError(
                f"{self.path}: the file ends after {len(self.data)} bytes, inside a record that extends to byte "
                f"{self.offset}",
                fix="export the model again, because it is truncated or damaged",
            )
        return start

    def read(self, layout: struct.Struct) -> tuple:
        """Read one record."""
        return layout.unpack_from(self.data, self.skip(layout.size))

    def read_count(self, layout: struct.Struct = _U64_STRUCT) -> range:
        """Read the number of records that follow, as a range to iterate over."""
        return range(self.read(layout)[0])

    def skip_name(self) -> None:
        """Skip a zero-terminated name after a check that it is UTF-8."""
        end = self.data.find(b"\0", self.offset)
        name = self.data[self.offset : end]
        self.skip(end + 1 - self.offset if end >= 0 else len(self.data) + 1 - self.offset)
        try:
            name.decode()
        except UnicodeDecodeError as error:
            raise HyrfDataError(
                f"{self.path}: a photo's name is not UTF-8 text",
                fix="export the model again",
            ) from error

    def finish(self) -> None:
        """Check that no bytes follow the last record."""
        if self.offset != len(self.data):
            raise HyrfDataError(
                f"{self.path}: {len(self.data) - self.offset} bytes follow the last record that its count announces",
                fix="export the model again, because it is damaged",
            )


def _check_cameras(table: _TableReader) -> None:
    for _ in table.read_count():
        _, model, _, _ = table.read(_CAMERA_STRUCT)
        if model not in _PARAMETER_COUNTS:
            raise HyrfDataError(
                f"{table.path}: camera model number {model} is not supported",
                fix="undistort the photos with COLMAP first",
            )
        table.skip(8 * _PARAMETER_COUNTS[model])


def _check_images(table: _TableReader) -> None:
    for _ in table.read_count():
        table.skip(4 + _POSE_BYTES + 4)  # id, pose, camera
        table.skip_name()
        table.skip(24 * table.read(_U64_STRUCT)[0])  # x, y, 3D point


def _check_points(table: _TableReader) -> None:
    for _ in table.read_count():
        table.skip(8 + 24 + 3 + 8)  # id, position, colour, error
        table.skip(8 * table.read(_U64_STRUCT)[0])  # image, index of its 2D point


def _check_rigs(table: _TableReader) -> None:
    for _ in table.read_count():
        table.skip(4)
        sensors = table.read_count(_U32_STRUCT)
        if sensors:
            table.skip(_SENSOR_BYTES)  # the reference sensor has no pose
        for _ in sensors[1:]:
            table.skip(_SENSOR_BYTES)
            has_pose = table.data[table.skip(1)]
            table.skip(_POSE_BYTES if has_pose else 0)


def _check_frames(table: _TableReader) -> None:
    for _ in table.read_count():
        table.skip(4 + 4 + _POSE_BYTES)  # id, rig, pose
        table.skip((_SENSOR_BYTES + 8) * table.read(_U32_STRUCT)[0])
