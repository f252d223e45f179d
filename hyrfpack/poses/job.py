"""What one estimation is about, as the processes that work on it pass it on."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path

from hyrfpack.atomic import write_atomic
from hyrfpack.data.pictures import fit_size

LARGEST = 1600  # pixels of the longer side of the pictures that features are found in
GUESS = 0.8  # focal length in longer sides where nothing is known: between a phone's wide and its normal lens


@dataclass(frozen=True)
class Device:
    """Photos that share one camera.

    Attributes:
        size: (width, height) of its photos in pixels.
        focal: in pixels of the photos, or None where EXIF does not tell.
    """

    size: tuple[int, int]
    focal: float | None = None

    @property
    def working_size(self) -> tuple[int, int]:
        """(width, height) of the pictures that features are found in."""
        return fit_size(*self.size, LARGEST)

    @property
    def working_focal(self) -> float:
        """Focal length in pixels of these, a guess where it is not known."""
        focal = GUESS * max(self.size) if self.focal is None else self.focal
        return focal * max(self.working_size) / max(self.size)


@dataclass(frozen=True)
class Job:
    """One estimation.

    Attributes:
        images: folder of the photos.
        work: folder of products in progress.
        names: of the photos, sorted; image n of the database is names[n - 1].
        devices: of camera n of the database at n - 1.
        device_of: for each photo, an index into `devices`.
        masks: the file of each photo's mask by name, for those that have one.
        matching: "exhaustive", "sequential" or "retrieval".
        seed: of everything random.
    """

    images: Path
    work: Path
    names: tuple[str, ...]
    devices: tuple[Device, ...]
    device_of: tuple[int, ...]
    masks: dict[str, str]
    matching: str
    seed: int

    @property
    def database(self) -> Path:
        """Features and matches, as pycolmap keeps them."""
        return self.work / "database.db"

    def working_name(self, number: int) -> str:
        """What image `number` is called in the database, and its working copy.

        Not as its photo is: pycolmap's lists of pairs end names at spaces, and file systems names at 255 bytes.
        """
        return f"{number:06d}.png"

    def model(self, name: str) -> Path:
        """The folder of a mapper's pieces, numbered from 0."""
        return self.work / name

    def save(self, path: Path) -> None:
        """Write it as JSON."""
        values = asdict(self) | {"images": str(self.images), "work": str(self.work)}
        write_atomic(path, json.dumps(values).encode())

    @staticmethod
    def load(path: Path) -> Job:
        """Read what `save` wrote."""
        values = json.loads(path.read_text())
        devices = tuple(Device(tuple(device["size"]), device["focal"]) for device in values["devices"])
        places = {"images": Path(values["images"]), "work": Path(values["work"])}
        lists = {key: tuple(values[key]) for key in ("names", "device_of")}
        return Job(**{**values, **places, **lists, "devices": devices})


def chunks(items: list, size: int) -> Iterable[list]:
    """The items in order, `size` at a time."""
    return (items[start : start + size] for start in range(0, len(items), size))
