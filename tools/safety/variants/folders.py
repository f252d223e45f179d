"""Photos, models and whole sets in other folders, smaller photos beside them, and folders that are missing."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator

from PIL import Image

from tools.safety.variants.variant import ALL, Variant
from tools.safety.variants.working_set import WorkingSet


def variants() -> Iterator[Variant]:
    def moved(*moves: tuple[str, str]) -> Callable[[WorkingSet], None]:
        def make(s: WorkingSet) -> None:
            for old, new in moves:
                there = s.root.with_name("there")
                (s.root / old).rename(there)
                (s.root / new).parent.mkdir(parents=True, exist_ok=True)
                if new == ".":
                    for entry in list(there.iterdir()):
                        entry.rename(s.root / entry.name)
                    there.rmdir()
                else:
                    there.rename(s.root / new)

        return make

    flat = ("sparse/0", ".")
    for name in ("Images", "IMAGES", "image", "input", "rgb", "photos", "pictures", "frames", "imgs", "kitchen"):
        yield Variant(f"folders: photos in {name}", moved(("images", name)))
    yield Variant("folders: model beside photos", moved(("images", "."), flat))
    yield Variant("folders: model in the root", moved(flat))
    yield Variant("folders: photos in the root", moved(("images", ".")))
    yield Variant(
        "folders: images empty, photos in the root",
        lambda s: (moved(("images", "."))(s), (s.root / "images").mkdir()),
    )
    for place in (
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
        yield Variant(f"folders: model in {place}", moved(("sparse/0", "taken"), ("taken", place)))
    yield Variant(
        "folders: dense/", moved(("sparse/0", "taken"), ("taken", "dense/sparse"), ("images", "dense/images"))
    )
    yield Variant(
        "folders: dense/0/", moved(("sparse/0", "taken"), ("taken", "dense/0/sparse"), ("images", "dense/0/images"))
    )
    yield Variant(
        "folders: dense/ beside sparse/ without photos",
        lambda s: (shutil.copytree(s.model, s.root / "dense" / "sparse"), moved(("images", "dense/images"))(s)),
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
        yield Variant(f"folders: all of it in {depth}", lambda s, d=depth: _nested(s, d), layouts=ALL, note="was taken")
    yield Variant("folders: four deep", lambda s: _nested(s, "a/b/c/set"), "no poses found", layouts=ALL)
    yield Variant(
        "folders: two sets",
        lambda s: (_nested(s, "a"), shutil.copytree(s.root / "a", s.root / "b", symlinks=True)),
        "holds 2 sets",
        layouts=ALL,
    )
    for number in (2, 4, 8):
        yield Variant(
            f"folders: images_{number} alone",
            lambda s, n=number: _smaller(s, n),
            layouts=("colmap", "nerfstudio"),
            note=f"images_{number}",
        )
    yield Variant(
        "folders: images empty, images_4 not",
        lambda s: (_smaller(s, 4), (s.root / "images").mkdir(exist_ok=True)),
        layouts=("colmap", "nerfstudio"),
    )
    yield Variant(
        "folders: images_2 and images_4",
        lambda s: (_smaller(s, 4), shutil.copytree(s.root / "images_4", s.root / "images_2")),
        note="images_2",
    )
    yield Variant(
        "folders: two that might be",
        lambda s: (shutil.copytree(s.root / "images", s.root / "a", symlinks=True), moved(("images", "b"))(s)),
        "there are the folders a, b, sparse",
    )
    yield Variant(
        "folders: no photos at all",
        lambda s: shutil.rmtree(s.root / "images"),
        "no photo folder|none of the",
        layouts=("colmap", "nerfstudio"),
    )
    yield Variant("folders: poses alone are missing", lambda s: shutil.rmtree(s.root / "sparse"), "no poses found")
    yield Variant("folders: the model's given", lambda s: setattr(s, "given", s.model), "no photo folder")


def _nested(s: WorkingSet, place: str) -> None:
    away = s.root.with_name("away")
    s.root.rename(away)
    (s.root / place).parent.mkdir(parents=True)
    away.rename(s.root / place)


def _smaller(s: WorkingSet, divisor: int) -> None:
    for file in s.photos:
        with Image.open(file) as image:
            picture = image.convert("RGB").resize([max(1, round(side / divisor)) for side in image.size])
        target = s.root / f"images_{divisor}" / file.name
        target.parent.mkdir(exist_ok=True)
        picture.save(target, quality=95, subsampling=0)
    shutil.rmtree(s.root / "images")
