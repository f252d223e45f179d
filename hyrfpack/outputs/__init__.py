"""Outputs: which files may be written, folders that an index names, and names of pictures, videos and poses."""

from hyrfpack.outputs.checks import Outputs, StrPath
from hyrfpack.outputs.names import (
    ARCHIVE_SUFFIXES,
    COLMAP_MODEL_FOLDERS,
    COLMAP_TABLE_NAMES,
    PICTURE_SUFFIXES,
    POSE_FILE_NAMES,
    RAW_PHOTO_SUFFIXES,
    READABLE_PICTURE_SUFFIXES,
    VIDEO_SUFFIXES,
)

__all__ = [
    "ARCHIVE_SUFFIXES",
    "COLMAP_MODEL_FOLDERS",
    "COLMAP_TABLE_NAMES",
    "PICTURE_SUFFIXES",
    "POSE_FILE_NAMES",
    "RAW_PHOTO_SUFFIXES",
    "READABLE_PICTURE_SUFFIXES",
    "VIDEO_SUFFIXES",
    "Outputs",
    "StrPath",
]
