"""Make the copy of a set that a variant changes: its photos, poses, model and masks."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path, PurePosixPath

import numpy as np
from PIL import Image

TRANSFORMS_FILE_NAMES = ("transforms.json", "transforms_train.json", "transforms_test.json", "transforms_val.json")


class WorkingSet:
    """A copy of a data set to be changed, with links to the photos and copies of the poses.

    Attributes:
        root: the folder of the copy.
        source_path: the path to read; it is `root` unless a variant changes it.
        layout: "colmap", "nerfstudio" or "blender".
        masked_share: share of each photo that a mask of the variant removes; None without masks.
    """

    def __init__(self, source: Path, root: Path, layout: str) -> None:
        self.root, self.layout, self.source_path, self.masked_share = root, layout, root, None
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
        """The folder of the COLMAP model."""
        return self.root / "sparse" / "0"

    def read_reconstruction(self):
        """Return the COLMAP model as a pycolmap reconstruction."""
        import pycolmap

        return pycolmap.Reconstruction(str(self.model))

    @property
    def photos(self) -> list[Path]:
        """The photo files with poses that still have their original folder and name; endings may differ."""
        files = (path for path in sorted(self.root.rglob("*")) if path.is_file() or path.is_symlink())
        pose_names = {PurePosixPath(name).with_suffix("").as_posix() for name in self.list_pose_names()}
        top = self.root / "images" if self.layout == "colmap" else self.root
        return [
            path
            for path in files
            if path.is_relative_to(top) and path.relative_to(top).with_suffix("").as_posix() in pose_names
        ]

    def list_pose_names(self) -> list[str]:
        """Return the names of the photos in the poses."""
        if self.layout == "colmap":
            return [image.name for image in self.read_reconstruction().images.values()]
        return [
            str(frame["file_path"])
            for file in self._list_transforms_files()
            for frame in json.loads(file.read_text())["frames"]
        ]

    def rename_in_poses(self, change: Callable[[str], str], *, text: bool = False) -> None:
        """Change the names of the photos in the poses; `text` writes a COLMAP model as text."""
        if self.layout == "colmap":
            model = self.read_reconstruction()
            for image in model.images.values():
                image.name = change(image.name)
            self.write_model(model, text=text)
            return
        for file in self._list_transforms_files():
            content = json.loads(file.read_text())
            for frame in content["frames"]:
                frame["file_path"] = change(frame["file_path"])
            file.write_text(json.dumps(content))

    def write_model(self, model=None, *, text: bool = False) -> None:
        """Write the COLMAP model as text or binary, without the tables that older versions lack."""
        model = model or self.read_reconstruction()
        for file in self.model.iterdir():
            file.unlink()
        (model.write_text if text else model.write_binary)(str(self.model))
        for table in ("rigs", "frames"):
            (self.model / f"{table}{'.txt' if text else '.bin'}").unlink(missing_ok=True)

    def encode(self, ending: str, **options) -> None:
        """Re-encode the photo files with another ending; `options` are those of Pillow's writer."""
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

    def write_masks(self, name: Callable[[PurePosixPath], str], size: tuple[int, int] | None = None) -> None:
        """Write masks that remove the upper quarter; `name` returns a mask's path from its photo's path."""
        self.masked_share = 0.25
        for file in self.photos:
            with Image.open(file) as image:
                width, height = size or image.size
            photo_path = PurePosixPath(file.relative_to(self.root))
            target = self.root / name(photo_path)
            target.parent.mkdir(parents=True, exist_ok=True)
            mask = np.full((height, width), 255, np.uint8)
            mask[: height // 4] = 0
            Image.fromarray(mask).save(target)

    def _list_transforms_files(self) -> Iterator[Path]:
        return (self.root / name for name in TRANSFORMS_FILE_NAMES if (self.root / name).is_file())
