"""Description of one pose estimation, passed as a JSON file to the processes that run its stages."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path

from hyrfpack.atomic import write_atomic
from hyrfpack.data.pictures import fit_size

MAX_WORKING_SIDE_PIXELS = 1600  # longer side of the working copies in which features are found
# Focal length over longer side of the picture if EXIF has none, between the wide and the normal lens of a phone.
DEFAULT_FOCAL_RATIO = 0.8


@dataclass(frozen=True)
class Device:
    """Camera that a group of photos shares.

    Attributes:
        size: (width, height) of its photos in pixels.
        focal: focal length in pixels of the photos; None if EXIF has none.
    """

    size: tuple[int, int]
    focal: float | None = None

    @property
    def working_size(self) -> tuple[int, int]:
        """Return the (width, height) in pixels of the working copies in which features are found."""
        return fit_size(*self.size, MAX_WORKING_SIDE_PIXELS)

    @property
    def working_focal(self) -> float:
        """Return the focal length in pixels of the working copies, guessed by DEFAULT_FOCAL_RATIO if unknown."""
        focal = DEFAULT_FOCAL_RATIO * max(self.size) if self.focal is None else self.focal
        return focal * max(self.working_size) / max(self.size)


@dataclass(frozen=True)
class Job:
    """Photos and settings of one estimation.

    Attributes:
        images: folder of the photos.
        work: folder of intermediate products.
        names: photo names, sorted with numbers in their order; image n of the database is names[n - 1].
        devices: cameras; camera n of the database is devices[n - 1].
        device_indices: index of each photo's camera in `devices`.
        masks: path of the mask by photo name, for photos that have one.
        matching: "exhaustive", "sequential" or "retrieval".
        seed: random seed.
    """

    images: Path
    work: Path
    names: tuple[str, ...]
    devices: tuple[Device, ...]
    device_indices: tuple[int, ...]
    masks: dict[str, str]
    matching: str
    seed: int

    @property
    def database_path(self) -> Path:
        """Return the path of pycolmap's database of features and matches."""
        return self.work / "database.db"

    @property
    def matches_path(self) -> Path:
        """Return the path of the answer of the stage that matches photos, see `matching.match_photos`."""
        return self.work / "matches.json"

    def working_name(self, number: int) -> str:
        """Return the name of image `number` in the database, which is also the file name of its working copy.

        The photo's own name is not used, because pycolmap's pair lists cut names at spaces and file systems limit
        names to 255 bytes.
        """
        return f"{number:06d}.png"

    def model_folder(self, name: str) -> Path:
        """Return the folder of a result, which for a mapper has one COLMAP model per piece, numbered from 0."""
        return self.work / name

    def save(self, path: Path) -> None:
        """Write the job as JSON."""
        values = asdict(self) | {"images": str(self.images), "work": str(self.work)}
        write_atomic(path, json.dumps(values).encode())

    @staticmethod
    def load(path: Path) -> Job:
        """Read a job that `save` wrote."""
        values = json.loads(path.read_text())
        devices = tuple(Device(tuple(device["size"]), device["focal"]) for device in values["devices"])
        folders = {"images": Path(values["images"]), "work": Path(values["work"])}
        lists = {key: tuple(values[key]) for key in ("names", "device_indices")}
        return Job(**{**values, **folders, **lists, "devices": devices})


def chunks(items: list, size: int) -> Iterable[list]:
    """Split the items into consecutive lists of at most `size`."""
    return (items[start : start + size] for start in range(0, len(items), size))
