"""Names by which files of pictures, videos, archives and poses are recognised."""

from __future__ import annotations

# Suffixes of pictures that count as photos. A photo's name without a suffix means the first file with one of these.
READABLE_PICTURE_SUFFIXES = (
    ".png",
    ".jpg",
    ".jpeg",
    ".webp",
    ".tif",
    ".tiff",
    ".bmp",
    ".avif",
    ".jp2",
    ".heic",
    ".heif",
    ".hif",
)
# Suffixes of cameras' raw photos. They are never read, but counted and reported to the user.
RAW_PHOTO_SUFFIXES = (
    *(".3fr", ".arw", ".cr2", ".cr3", ".crw", ".dcr", ".dng", ".erf", ".fff", ".gpr", ".iiq", ".kdc", ".mos", ".mrw"),
    *(".nef", ".nrw", ".orf", ".pef", ".raf", ".rw2", ".rwl", ".sr2", ".srf", ".srw", ".x3f"),
)
PICTURE_SUFFIXES = (*READABLE_PICTURE_SUFFIXES, *RAW_PHOTO_SUFFIXES)
VIDEO_SUFFIXES = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".3gp", ".mts", ".m2ts", ".mpg", ".mpeg", ".wmv")
ARCHIVE_SUFFIXES = (".zip", ".r3d")  # An archive may hold a whole set of photos and poses.
COLMAP_TABLE_NAMES = tuple(f"{table}{kind}" for table in ("cameras", "images", "points3D") for kind in (".bin", ".txt"))
# Names of files and folders that hold poses, besides the tables of COLMAP.
POSE_FILE_NAMES = (
    *("transforms.json", "transforms_train.json", "transforms_val.json", "transforms_test.json"),
    *("poses_bounds.npy", "bundle.out", "cameras.xml", "metadata", "keyframes"),
)
COLMAP_MODEL_FOLDERS = ("sparse", "colmap/sparse")
