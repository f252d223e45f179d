"""Variants with photos, models or whole sets in other folders, with smaller photos, and with missing folders."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator

from PIL import Image

from tools.safety.variants.variant import ALL_LAYOUTS, Variant
from tools.safety.variants.working_set import WorkingSet


def list_variants() -> Iterator[Variant]:
    """Yield the variants of this module."""

    def move_folders(*moves: tuple[str, str]) -> Callable[[WorkingSet], None]:
        def make(s: WorkingSet) -> None:
            for old, new in moves:
                temporary = s.root.with_name("temporary")
                (s.root / old).rename(temporary)
                (s.root / new).parent.mkdir(parents=True, exist_ok=True)
                if new == ".":
                    for entry in list(temporary.iterdir()):
                        entry.rename(s.root / entry.name)
                    temporary.rmdir()
                else:
                    temporary.rename(s.root / new)

        return make

    flat = ("sparse/0", ".")
    for name in ("Images", "IMAGES", "image", "input", "rgb", "photos", "pictures", "frames", "imgs", "kitchen"):
        yield Variant(f"folders: photos in {name}", move_folders(("images", name)))
    yield Variant("folders: model beside photos", move_folders(("images", "."), flat))
    yield Variant("folders: model in the root", move_folders(flat))
    yield Variant("folders: photos in the root", move_folders(("images", ".")))
    yield Variant(
        "folders: images empty, photos in the root",
        lambda s: (move_folders(("images", "."))(s), (s.root / "images").mkdir()),
    )
    for folder in (
        "sparse/1",
        "sparse/model",
        "colmap/sparse/0",
        "colmap",
        "colmap/0/sparse",
        "dense/sparse",
        "dense/0/sparse",
        "undistorted/sparse",
        "distorted/sparse/0",
    ):
        yield Variant(f"folders: model in {folder}", move_folders(("sparse/0", "moved model"), ("moved model", folder)))
    yield Variant(
        "folders: dense/",
        move_folders(("sparse/0", "moved model"), ("moved model", "dense/sparse"), ("images", "dense/images")),
    )
    yield Variant(
        "folders: dense/0/",
        move_folders(("sparse/0", "moved model"), ("moved model", "dense/0/sparse"), ("images", "dense/0/images")),
    )
    yield Variant(
        "folders: dense/ beside sparse/ without photos",
        lambda s: (shutil.copytree(s.model, s.root / "dense" / "sparse"), move_folders(("images", "dense/images"))(s)),
    )
    yield Variant(
        "folders: convert.py's input/ and distorted/",
        lambda s: (
            shutil.copytree(s.model, s.root / "distorted" / "sparse" / "0"),
            (s.root / "input").mkdir(),
            [Image.new("RGB", (9, 9)).save(s.root / "input" / f.name) for f in s.photos],
        ),
    )
    for depth in ("set", "a/set", "a/b/set"):
        yield Variant(
            f"folders: all of it in {depth}", lambda s, d=depth: _nest_set(s, d), layouts=ALL_LAYOUTS, note="are used"
        )
    yield Variant("folders: four deep", lambda s: _nest_set(s, "a/b/c/set"), "no poses found", layouts=ALL_LAYOUTS)
    yield Variant(
        "folders: two sets",
        lambda s: (_nest_set(s, "a"), shutil.copytree(s.root / "a", s.root / "b", symlinks=True)),
        "holds 2 sets",
        layouts=ALL_LAYOUTS,
    )
    for number in (2, 4, 8):
        yield Variant(
            f"folders: images_{number} alone",
            lambda s, n=number: _shrink_photos(s, n),
            layouts=("colmap", "nerfstudio"),
            note=f"images_{number}",
        )
    yield Variant(
        "folders: images empty, images_4 not",
        lambda s: (_shrink_photos(s, 4), (s.root / "images").mkdir(exist_ok=True)),
        layouts=("colmap", "nerfstudio"),
    )
    yield Variant(
        "folders: images_2 and images_4",
        lambda s: (_shrink_photos(s, 4), shutil.copytree(s.root / "images_4", s.root / "images_2")),
        note="images_2",
    )
    yield Variant(
        "folders: two that might be",
        lambda s: (shutil.copytree(s.root / "images", s.root / "a", symlinks=True), move_folders(("images", "b"))(s)),
        "there are the folders a, b, sparse",
    )
    yield Variant(
        "folders: no photos at all",
        lambda s: shutil.rmtree(s.root / "images"),
        "no photo folder|none of the",
        layouts=("colmap", "nerfstudio"),
    )
    yield Variant("folders: poses alone are missing", lambda s: shutil.rmtree(s.root / "sparse"), "no poses found")
    yield Variant("folders: the model's given", lambda s: setattr(s, "source_path", s.model), "no photo folder")


def _nest_set(s: WorkingSet, folder: str) -> None:
    away = s.root.with_name("away")
    s.root.rename(away)
    (s.root / folder).parent.mkdir(parents=True)
    away.rename(s.root / folder)


def _shrink_photos(s: WorkingSet, divisor: int) -> None:
    for file in s.photos:
        with Image.open(file) as image:
            picture = image.convert("RGB").resize([max(1, round(side / divisor)) for side in image.size])
        target = s.root / f"images_{divisor}" / file.name
        target.parent.mkdir(exist_ok=True)
        picture.save(target, quality=95, subsampling=0)
    shutil.rmtree(s.root / "images")
