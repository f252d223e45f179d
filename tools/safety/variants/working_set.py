"""The copy of a set that a variant changes: its photos, its poses, its model and its masks."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path, PurePosixPath

import numpy as np
from PIL import Image

POSES = ("transforms.json", "transforms_train.json", "transforms_test.json", "transforms_val.json")


class WorkingSet:
    """A copy of a set to be changed: links to its photos, poses of its own.

    Attributes:
        root: its folder.
        given: what to read, the folder unless a variant says otherwise.
        layout: "colmap", "nerfstudio" or "blender".
        masked: pixels of each photo that a mask of the variant takes away, as a share; None without masks.
    """

    def __init__(self, source: Path, root: Path, layout: str) -> None:
        self.root, self.layout, self.given, self.masked = root, layout, root, None
        root.mkdir(parents=True)
        keep = {"colmap": ("images", "sparse"), "nerfstudio": ("images", "transforms.json", "sparse_pc.ply")}
        for file in (path for path in source.rglob("*") if path.is_file()):
            part = file.relative_to(source).parts[0]
            if part in keep.get(layout, (part,)) and not part.startswith("masks"):
                target = root / file.relative_to(source)
                target.parent.mkdir(parents=True, exist_ok=True)
                if file.suffix in (".json", ".bin", ".txt"):
                    shutil.copy(file, target)
                else:
                    os.symlink(file.resolve(), target)

    @property
    def model(self) -> Path:
        return self.root / "sparse" / "0"

    def reconstruction(self):
        """The COLMAP model, as pycolmap reads it."""
        import pycolmap

        return pycolmap.Reconstruction(str(self.model))

    @property
    def photos(self) -> list[Path]:
        """Files that poses are of, while they are where the set has them."""
        there = (path for path in sorted(self.root.rglob("*")) if path.is_file() or path.is_symlink())
        listed = {PurePosixPath(name).with_suffix("").as_posix() for name in self.listed()}
        top = self.root / "images" if self.layout == "colmap" else self.root
        return [
            path
            for path in there
            if path.is_relative_to(top) and path.relative_to(top).with_suffix("").as_posix() in listed
        ]

    def listed(self) -> list[str]:
        """The names that poses give photos."""
        if self.layout == "colmap":
            return [image.name for image in self.reconstruction().images.values()]
        return [
            str(frame["file_path"]) for file in self._transforms() for frame in json.loads(file.read_text())["frames"]
        ]

    def relist(self, change: Callable[[str], str], *, text: bool = False) -> None:
        """Give photos other names in the poses."""
        if self.layout == "colmap":
            model = self.reconstruction()
            for image in model.images.values():
                image.name = change(image.name)
            self.write_model(model, text=text)
            return
        for file in self._transforms():
            content = json.loads(file.read_text())
            for frame in content["frames"]:
                frame["file_path"] = change(frame["file_path"])
            file.write_text(json.dumps(content))

    def write_model(self, model=None, *, text: bool = False) -> None:
        """The COLMAP model anew, as text or not, without tables that older versions did not have."""
        model = model or self.reconstruction()
        for old in self.model.iterdir():
            old.unlink()
        (model.write_text if text else model.write_binary)(str(self.model))
        for table in ("rigs", "frames"):
            (self.model / f"{table}{'.txt' if text else '.bin'}").unlink(missing_ok=True)

    def encode(self, ending: str, **options) -> None:
        """Replace photo files by re-encoded ones."""
        for file in self.photos:
            with Image.open(file) as image:
                picture = image.convert("RGBA" if "A" in image.getbands() else "RGB")
            file.unlink()
            if ending.lower() in (".jpg", ".jpeg", ".bmp", ".heic"):
                picture = picture.convert("RGB")
            if ending.lower() == ".heic":
                import pillow_heif

                pillow_heif.register_heif_opener()
            picture.save(file.with_suffix(ending), **options)

    def masks(self, name: Callable[[PurePosixPath], str], size: tuple[int, int] | None = None) -> None:
        """Masks that take away the upper quarter, each under the name that its photo's path gives."""
        self.masked = 0.25
        for file in self.photos:
            with Image.open(file) as image:
                width, height = size or image.size
            below = PurePosixPath(file.relative_to(self.root))
            target = self.root / name(below)
            target.parent.mkdir(parents=True, exist_ok=True)
            mask = np.full((height, width), 255, np.uint8)
            mask[: height // 4] = 0
            Image.fromarray(mask).save(target)

    def _transforms(self) -> Iterator[Path]:
        return (self.root / name for name in POSES if (self.root / name).is_file())
