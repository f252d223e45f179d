"""Sets of photos as people have them: about a hundred variants of a given set, and what reading each of them gives.

    python -m tools.safety.variants SET [SET ...] [--only WORD]

Each is built in a temporary folder out of links to the set's files, and read. A table says of each whether it was read,
with the same cameras and pictures as the set itself; refused, with which sentence; or WRONG: read with others, refused
where it should be read, read where it should be refused, or not even a sentence. Exits with 1 if one is.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import sys
import tempfile
import unicodedata
import zipfile
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np
from PIL import Image, ImageOps

from hyrfpack.data import load_scene
from hyrfpack.errors import HyrfError
from hyrfpack.scene import Scene, View, evenly_spaced

READ = ""  # what a variant should be: read; any other text is what the refusal has to say
LOOKED_AT = 4  # photos whose pixels are compared
LEAST_PSNR = 24.0  # dB to the set's own picture: re-encoded and shrunk photos are well above, neighbours far below
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
            return [image.name for image in self._reconstruction().images.values()]
        return [
            str(frame["file_path"]) for file in self._transforms() for frame in json.loads(file.read_text())["frames"]
        ]

    def relist(self, change: Callable[[str], str], *, text: bool = False) -> None:
        """Give photos other names in the poses."""
        if self.layout == "colmap":
            model = self._reconstruction()
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
        model = model or self._reconstruction()
        for old in self.model.iterdir():
            old.unlink()
        (model.write_text if text else model.write_binary)(str(self.model))
        for table in ("rigs", "frames"):
            (self.model / f"{table}{'.txt' if text else '.bin'}").unlink(missing_ok=True)

    def move(self, change: Callable[[PurePosixPath], str]) -> None:
        """Give photo files other paths below the set's folder."""
        moves = [(file, self.root / change(PurePosixPath(file.relative_to(self.root)))) for file in self.photos]
        for number, (file, _) in enumerate(moves):
            file.rename(self.root / f"moving {number}")
        for number, (_, target) in enumerate(moves):
            target.parent.mkdir(parents=True, exist_ok=True)
            (self.root / f"moving {number}").rename(target)

    def encode(
        self, ending: str, change: Callable[[Image.Image], Image.Image] = lambda image: image, **options
    ) -> None:
        """Replace photo files by re-encoded ones."""
        for file in self.photos:
            with Image.open(file) as image:
                picture = change(image.convert("RGBA" if "A" in image.getbands() else "RGB"))
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

    def zipped(self, top: str = "", *, before: Callable[[zipfile.ZipFile], None] = lambda archive: None) -> Path:
        """The set as one archive, and no folder any more."""
        self.given = self.root.with_suffix(".zip")
        with zipfile.ZipFile(self.given, "w", zipfile.ZIP_DEFLATED) as archive:
            before(archive)
            for file in sorted(path for path in self.root.rglob("*") if path.is_file()):
                archive.write(file, top + file.relative_to(self.root).as_posix())
        shutil.rmtree(self.root)
        return self.given

    def _transforms(self) -> Iterator[Path]:
        return (self.root / name for name in POSES if (self.root / name).is_file())

    def _reconstruction(self):
        import pycolmap

        return pycolmap.Reconstruction(str(self.model))


@dataclass(frozen=True)
class Variant:
    """Attributes:
    name: in the table.
    make: changes a working set.
    expect: READ, or what the sentence has to say, as a pattern.
    layouts: that it is of.
    note: a pattern that one of the notes has to have.
    """

    name: str
    make: Callable[[WorkingSet], object]
    expect: str = READ
    layouts: tuple[str, ...] = ("colmap",)
    note: str = ""


ALL, JSON = ("colmap", "nerfstudio", "blender"), ("nerfstudio", "blender")
LOOSE = "called otherwise"


def nfd(text: str) -> str:
    return unicodedata.normalize("NFD", text)


def _accented(file: PurePosixPath | str) -> str:
    path = PurePosixPath(file)
    return str(path.with_name(f"Müller é {path.name}"))


def _names() -> Iterator[Variant]:
    for ending in (".Jpg", ".JPG", ".jpeg", ".JPEG"):
        yield Variant(
            f"names: {ending} on disk", lambda s, e=ending: s.encode(e, quality=95, subsampling="4:4:4"), layouts=ALL
        )
    for ending in (".png", ".PNG", ".bmp", ".tif", ".TIF", ".tiff", ".jp2"):
        yield Variant(f"names: {ending} on disk", lambda s, e=ending: s.encode(e), layouts=ALL)
    for ending in (".webp", ".WEBP", ".avif", ".heic", ".HEIC"):
        yield Variant(
            f"names: {ending} on disk", lambda s, e=ending: s.encode(e, quality=95, subsampling="4:4:4"), layouts=ALL
        )
    yield Variant("names: capitals on disk", lambda s: s.move(lambda f: str(f.with_name(f.name.upper()))), layouts=ALL)
    yield Variant("names: capitals in the poses", lambda s: s.relist(str.upper), layouts=ALL, note=LOOSE)
    yield Variant("names: .png added on disk", lambda s: (s.encode(".png"), s.move(_doubled)))
    yield Variant(
        "names: no ending in the poses",
        lambda s: s.relist(lambda n: str(PurePosixPath(n).with_suffix(""))),
        layouts=ALL,
    )
    yield Variant(
        "names: .NEF in the poses", lambda s: s.relist(lambda n: str(PurePosixPath(n).with_suffix(".NEF"))), note=LOOSE
    )
    for prefix in (
        "/home/x/images/",
        "C:\\x\\images\\",
        "\\\\server\\images\\",
        "images/",
        "./",
        "../images/",
        "project/run 1/images/",
    ):
        yield Variant(f"names: {prefix} before them", lambda s, p=prefix: s.relist(lambda n: p + n))
        if not prefix.startswith("."):
            yield Variant(f"names: {prefix} before them", lambda s, p=prefix: s.relist(lambda n: p + n), layouts=JSON)
    for text in (False, True):
        as_text = "text" if text else "binary"
        for what, part in (
            ("spaces", "my photo (1) "),
            ("two spaces", "a  b "),
            ("a hash", "#1 "),
            ("accents", "Zoë_ß_"),
            ("kanji", "写真"),
        ):
            yield Variant(f"names: {what}, {as_text}", lambda s, p=part, t=text: _renamed(s, lambda n: p + n, t))
    yield Variant(
        "names: NFD on disk, NFC in the poses",
        lambda s: (_renamed(s, lambda n: f"Müller é {n}"), s.move(lambda f: nfd(str(f)))),
        note=LOOSE,
    )
    yield Variant(
        "names: NFC on disk, NFD in the poses",
        lambda s: (_renamed(s, lambda n: f"Müller é {n}"), s.relist(nfd)),
        note=LOOSE,
    )
    yield Variant(
        "names: NFD on disk, NFC in the poses",
        lambda s: (s.move(lambda f: nfd(_accented(f))), s.relist(_accented)),
        layouts=JSON,
        note=LOOSE,
    )
    yield Variant("names: in a folder on disk alone", lambda s: s.move(lambda f: f"images/left/{f.name}"), note=LOOSE)
    yield Variant("names: in a folder in the poses alone", lambda s: s.relist(lambda n: f"left/{n}"), note=LOOSE)
    yield Variant(
        "names: folders of one name each", lambda s: _renamed(s, lambda n: f"{PurePosixPath(n).stem}/photo.jpg")
    )
    yield Variant(
        "names: a folder for each, of one name, absolute",
        lambda s: (_renamed(s, lambda n: f"{PurePosixPath(n).stem}/photo.jpg"), s.relist(lambda n: f"/x/{n}")),
        note=LOOSE,
    )
    yield Variant(
        "names: folders of one name each, flat on disk",
        lambda s: (s.relist(lambda n: f"{PurePosixPath(n).stem}/photo.jpg"), s.move(_one_photo)),
        "none of the",
    )
    yield Variant(
        "names: two files for each",
        lambda s: (s.encode(".png"), _beside(s, ".webp"), s.relist(lambda n: f"{PurePosixPath(n).stem}.jpg")),
        "is unclear",
        layouts=("colmap",),
    )
    yield Variant("names: a copy beside each", lambda s: _beside(s, ".webp"))
    yield Variant(
        "names: a third is missing",
        lambda s: [file.unlink() for file in s.photos[1::3]],
        layouts=ALL,
        note="not on disk",
    )
    yield Variant(
        "names: of other photos",
        lambda s: s.move(lambda f: str(f.with_name(f"other {f.stem[::-1]}.jpg"))),
        "nearest by name|holds no file",
        layouts=ALL,
    )


def _doubled(file: PurePosixPath) -> str:
    return f"{file.with_suffix('.jpg')}.png"


def _one_photo(file: PurePosixPath) -> str:
    return "images/photo.jpg"


def _renamed(s: WorkingSet, change: Callable[[str], str], text: bool = False) -> None:
    """On disk and in the poses."""
    s.move(lambda file: f"images/{change(file.relative_to('images').as_posix())}")
    s.relist(change, text=text)


def _beside(s: WorkingSet, ending: str) -> None:
    """Another, black, picture of the same name with another ending."""
    for file in s.photos:
        Image.new("RGB", (8, 8)).save(file.with_suffix(ending))


def _folders() -> Iterator[Variant]:
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


def _models() -> Iterator[Variant]:
    def text(change: Callable[[str, bytes], bytes | None]) -> Callable[[WorkingSet], None]:
        def make(s: WorkingSet) -> None:
            s.write_model(text=True)
            for table in list(s.model.iterdir()):
                content = change(table.stem, table.read_bytes())
                table.write_bytes(content) if content is not None else table.unlink()

        return make

    def without_points(table: str, content: bytes) -> bytes | None:
        return None if table == "points3D" else content

    pointless = "no points"
    yield Variant("model: text", text(lambda t, b: b))
    yield Variant("model: text, CRLF", text(lambda t, b: b.replace(b"\n", b"\r\n")))
    yield Variant("model: text, BOM", text(lambda t, b: b"\xef\xbb\xbf" + b))
    yield Variant("model: text, BOM and CRLF", text(lambda t, b: b"\xef\xbb\xbf" + b.replace(b"\n", b"\r\n")))
    yield Variant("model: text without comments", text(lambda t, b: re.sub(rb"(?m)^#.*\n", b"", b)))
    yield Variant("model: text with more comments", text(lambda t, b: b"# by hand\n\n" + b))
    yield Variant("model: text, empty lines at the end", text(lambda t, b: b + b"\n\n"))
    yield Variant("model: text without points3D", text(without_points), note=pointless)
    yield Variant("model: text with empty points3D", text(lambda t, b: b"" if t == "points3D" else b), note=pointless)
    yield Variant("model: binary without points3D", lambda s: (s.model / "points3D.bin").unlink(), note=pointless)
    yield Variant("model: points3D.ply alone", _ply_points)
    yield Variant("model: text and points3D.ply", lambda s: (s.write_model(text=True), _ply_points(s)))
    yield Variant("model: with rigs and frames", lambda s: s._reconstruction().write_binary(str(s.model)))
    yield Variant(
        "model: without cameras", lambda s: [file.unlink() for file in s.model.glob("cameras.*")], "cameras.* missing"
    )
    yield Variant(
        "model: without images", lambda s: [file.unlink() for file in s.model.glob("images.*")], "images.* missing"
    )
    yield Variant(
        "model: images.bin cut",
        lambda s: (s.model / "images.bin").write_bytes((s.model / "images.bin").read_bytes()[:-9]),
        "truncated",
    )


def _ply_points(s: WorkingSet) -> None:
    import trimesh

    points = list(s._reconstruction().points3D.values())
    cloud = trimesh.PointCloud([point.xyz for point in points], [(*map(int, point.color), 255) for point in points])
    cloud.export(s.model / "points3D.ply")
    for table in s.model.glob("points3D.*"):
        if table.suffix != ".ply":
            table.unlink()


def _turned() -> Iterator[Variant]:
    def stored(
        orientation: int, every: int = 1, tag: bool = True, ending: str = ".png"
    ) -> Callable[[WorkingSet], None]:
        """Photos stored such that turning them by their EXIF orientation gives what the poses are of."""
        undo = {6: 8, 8: 6}.get(orientation, orientation)

        def make(s: WorkingSet) -> None:
            count = 0

            def turn(image: Image.Image) -> Image.Image:
                nonlocal count
                count += 1
                image.info.clear()
                exif = image.getexif()
                exif.clear()
                if (count - 1) % every:
                    return image
                exif[0x0112] = undo
                image = ImageOps.exif_transpose(image)
                exif = image.getexif()
                if tag:
                    exif[0x0112] = orientation
                return image

            for file in s.photos:
                with Image.open(file) as image:
                    picture = turn(image.convert("RGB"))
                file.unlink()
                picture.save(
                    file.with_suffix(ending), exif=picture.getexif(), **({"quality": 95} if ending != ".png" else {})
                )

        return make

    for orientation in (5, 6, 7, 8):
        yield Variant(
            f"turned: stored as EXIF {orientation} says", stored(orientation), note="are turned", layouts=ALL[:2]
        )
    for ending in (".jpg", ".webp", ".tif", ".avif"):
        yield Variant(f"turned: {ending} stored as EXIF 6 says", stored(6, ending=ending), note="are turned")
    yield Variant("turned: every third alone", stored(8, every=3), note="are turned")
    yield Variant("turned: EXIF lost", stored(6, tag=False), "not a uniform rescaling", layouts=ALL[:2])
    yield Variant(
        "turned: 6 and upside down mixed", lambda s: (stored(6, every=2)(s), _upside_down(s)), note="are turned"
    )
    yield Variant("turned: as calibrated, EXIF says 6", _tagged(6), layouts=ALL)
    yield Variant("turned: as calibrated, EXIF says 3", _tagged(3), layouts=ALL)
    yield Variant(
        "turned: masks as stored",
        lambda s: (s.masks(lambda f: f"masks/{f.stem}.png"), _turn_masks(s), stored(6)(s)),
        note="have a mask",
    )
    yield Variant(
        "turned: masks upright", lambda s: (s.masks(lambda f: f"masks/{f.stem}.png"), stored(6)(s)), note="have a mask"
    )


def _upside_down(s: WorkingSet) -> None:
    """What is not on its side is stored upside down, and says so."""
    for file in s.photos:
        with Image.open(file) as image:
            if image.getexif().get(0x0112, 1) != 1:
                continue
            picture = image.transpose(Image.Transpose.ROTATE_180)
        exif = Image.Exif()
        exif[0x0112] = 3
        file.unlink()
        picture.save(file, exif=exif)


def _tagged(orientation: int) -> Callable[[WorkingSet], None]:
    exif = Image.Exif()
    exif[0x0112] = orientation
    return lambda s: s.encode(".png", exif=exif)


def _turn_masks(s: WorkingSet) -> None:
    for file in (s.root / "masks").iterdir():
        with Image.open(file) as image:
            picture = image.transpose(Image.Transpose.ROTATE_90)
        picture.save(file)


def _masks() -> Iterator[Variant]:
    have = "have a mask"
    yield Variant("masks: of the photos' names", lambda s: s.masks(lambda f: f"masks/{f.stem}.png"), note=have)
    yield Variant("masks: .png added", lambda s: s.masks(lambda f: f"masks/{f.name}.png"), note=have)
    yield Variant(
        "masks: of the photos' names in capitals", lambda s: s.masks(lambda f: f"masks/{f.stem.upper()}.PNG"), note=have
    )
    yield Variant("masks: in a folder", lambda s: s.masks(lambda f: f"masks/left/{f.stem}.webp"), note=have)
    yield Variant("masks: half as large", lambda s: _half_masks(s), note=have)
    yield Variant("masks: one, mask.png", lambda s: s.masks(lambda f: "mask.png"), note="taken for all")
    yield Variant("masks: one in the folder", lambda s: s.masks(lambda f: "masks/camera.png"), note="taken for all")
    yield Variant(
        "masks: one of another shape",
        lambda s: (s.masks(lambda f: "masks/camera.png", (50, 13)), setattr(s, "masked", 0.0)),
        note="not the shape",
    )
    yield Variant(
        "masks: of no photo",
        lambda s: (s.masks(lambda f: f"masks/{f.stem}_mask.png"), setattr(s, "masked", 0.0)),
        note="of no posed photo",
    )
    yield Variant(
        "masks: in mask/",
        lambda s: (s.masks(lambda f: f"mask/{f.stem}.png"), setattr(s, "masked", 0.0)),
        note="folder mask is not read",
    )


def _half_masks(s: WorkingSet) -> None:
    with Image.open(s.photos[0]) as image:
        size = image.width // 2, image.height // 2
    s.masks(lambda f: f"masks/{f.stem}.png", size)


def _archives() -> Iterator[Variant]:
    unpacked = "was unpacked"
    yield Variant("zip: flat", lambda s: s.zipped(), layouts=ALL, note=unpacked)
    yield Variant("zip: one folder", lambda s: s.zipped("my set/"), layouts=ALL, note=unpacked)
    yield Variant("zip: of a Mac", lambda s: s.zipped("set/", before=_mac), layouts=ALL, note=unpacked)
    yield Variant("zip: with backslashes", lambda s: _backslashes(s.zipped("set/")), note=unpacked)
    yield Variant(
        "zip: a file leads out",
        lambda s: s.zipped(before=lambda z: z.writestr("../evil.txt", "")),
        "outside its folder",
    )
    yield Variant(
        "zip: an absolute file", lambda s: s.zipped(before=lambda z: z.writestr("/evil.txt", "")), "outside its folder"
    )
    yield Variant("zip: a link", lambda s: s.zipped(before=_link), "holds a link")
    yield Variant("zip: a bomb", lambda s: s.zipped(before=_bomb), "no likely set")
    yield Variant("zip: encrypted", lambda s: _encrypted(s.zipped()), "encrypted")
    yield Variant("zip: cut", lambda s: _cut(s.zipped()), "damaged")
    yield Variant("zip: a byte is wrong", lambda s: _flipped(s.zipped()), "damaged|cannot|ends after|not a")
    yield Variant("zip: empty", lambda s: (shutil.rmtree(s.root), s.root.mkdir(), s.zipped()), "holds no file")
    yield Variant("zip: photos alone", lambda s: (shutil.rmtree(s.root / "sparse"), s.zipped()), "no poses found")


def _mac(archive: zipfile.ZipFile) -> None:
    archive.writestr("__MACOSX/set/._a.jpg", "x")
    archive.writestr("set/.DS_Store", "x")


def _link(archive: zipfile.ZipFile) -> None:
    info = zipfile.ZipInfo("images/link.jpg")
    info.external_attr = 0o120777 << 16
    archive.writestr(info, "/etc/passwd")


def _bomb(archive: zipfile.ZipFile) -> None:
    """A file that is said to be of a terabyte."""
    archive.writestr("zeros", bytes(1000))
    archive.filelist[-1].file_size = 1 << 40


def _backslashes(archive: Path) -> None:
    content = archive.read_bytes()
    for name in zipfile.ZipFile(archive).namelist():
        content = content.replace(name.encode(), name.replace("/", "\\").encode())
    archive.write_bytes(content)


def _encrypted(archive: Path) -> None:
    """The flag alone; what is behind it is never looked at."""
    content = bytearray(archive.read_bytes())
    for found in re.finditer(rb"PK\x03\x04", bytes(content)):
        content[found.start() + 6] |= 1
    for found in re.finditer(rb"PK\x01\x02", bytes(content)):
        content[found.start() + 8] |= 1
    archive.write_bytes(bytes(content))


def _cut(archive: Path) -> None:
    archive.write_bytes(archive.read_bytes()[:-200])


def _flipped(archive: Path) -> None:
    content = bytearray(archive.read_bytes())
    content[len(content) // 2] ^= 0xFF
    archive.write_bytes(bytes(content))


VARIANTS = (*_names(), *_folders(), *_models(), *_turned(), *_masks(), *_archives())


@dataclass(frozen=True)
class Outcome:
    """Attributes:
    kind: "read", "refused" or "WRONG".
    said: the sentence, or the notes, or what is wrong.
    """

    kind: str
    said: str


def try_variant(variant: Variant, source: Path, layout: str, folder: Path, plain: Scene) -> Outcome:
    """Build a variant in a folder and read it.

    Args:
        variant: what to build.
        source: the set.
        layout: to read it as.
        folder: to build in, removed afterwards.
        plain: the set itself, as it is read.
    """
    try:
        made = WorkingSet(source, folder / "set", layout)
        variant.make(made)
        try:
            scene = load_scene(made.given)
            wrong = differs(scene, plain, made.masked, missing_allowed="missing" in variant.name)
        except HyrfError as error:
            said = str(error).replace(str(folder), "")
            fits = variant.expect != READ and re.search(variant.expect, said) and "\n" not in said
            return Outcome("refused" if fits else "WRONG", said)
        said = "; ".join(scene.notes).replace(str(folder), "")
        if variant.expect != READ:
            return Outcome("WRONG", f"read, but should be refused; {said}")
        if not wrong and variant.note and not re.search(variant.note, said):
            wrong = f"no note has '{variant.note}'"
        return Outcome("WRONG" if wrong else "read", f"{wrong}; {said}" if wrong else said)
    except Exception as error:  # what a variant must never end in
        return Outcome("WRONG", f"{type(error).__name__}: {str(error)[:300]}")
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def differs(scene: Scene, plain: Scene, masked: float | None, *, missing_allowed: bool = False) -> str:
    """What is other than in the set itself, in words; "" where all cameras and pictures are the same."""
    by_pose = {_pose_key(view): view for view in plain.views}
    if len(scene.views) != len(plain.views) and not missing_allowed:
        return f"{len(scene.views)} photos instead of {len(plain.views)}"
    for view in scene.views:
        same = by_pose.get(_pose_key(view))
        if same is None:
            return f"{view.name} has a pose that none has"
        ratio = view.camera.width / same.camera.width
        if not np.allclose(view.camera.intrinsics, np.multiply(same.camera.intrinsics, ratio), rtol=0.02):
            return f"{view.name} has other intrinsics"
    for view in evenly_spaced(scene.views, LOOKED_AT):
        same = by_pose[_pose_key(view)]
        wrong = _other_picture(view, same, masked)
        if wrong:
            return wrong
    return ""


def _pose_key(view: View) -> bytes:
    return (view.camera.camera_from_world.round(6) + 0.0).tobytes()  # one zero


def _other_picture(view: View, same: View, masked: float | None) -> str:
    made, own = view.load(), same.load()
    size = made.rgb.shape[1::-1]
    shown = [np.asarray(Image.fromarray(picture.rgb).resize(size), float) for picture in (made, own)]
    weight = np.ones(shown[0].shape[:2])
    for picture in (made, own):
        if picture.mask is not None:
            weight *= np.asarray(Image.fromarray(picture.mask).resize(size), float)
        if picture.alpha is not None:
            weight *= np.asarray(Image.fromarray(picture.alpha).resize(size)) > 200
    error = ((shown[0] - shown[1]) ** 2).mean(2)
    psnr = 10 * np.log10(255**2 / max((error * weight).sum() / max(weight.sum(), 1), 1e-9))
    if psnr < LEAST_PSNR:
        return f"{view.name} is another picture ({psnr:.1f} dB)"
    if masked is not None:
        rows = np.zeros(made.rgb.shape[0], bool) if made.mask is None else ~made.mask.any(1)
        own_rows = np.zeros(own.rgb.shape[0], bool) if own.mask is None else ~own.mask.any(1)
        if abs(rows.mean() - max(masked, own_rows.mean())) > 0.05:
            return f"{view.name}: {rows.mean():.0%} of its rows are masked instead of {masked:.0%}"
    return ""


def layouts_of(source: Path) -> list[str]:
    """The layouts that a set can be read as."""
    there = {"colmap": "sparse", "nerfstudio": "transforms.json", "blender": "transforms_train.json"}
    return [layout for layout, sign in there.items() if (source / sign).exists()]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("sets", nargs="+", type=Path, metavar="SET")
    parser.add_argument("--only", default="", metavar="WORD", help="variants with this in their names")
    options = parser.parse_args()
    counts: Counter[str] = Counter()
    with tempfile.TemporaryDirectory(prefix="variants-") as folder:
        os.environ["XDG_CACHE_HOME"] = os.path.join(folder, "cache")
        for source in options.sets:
            for layout in layouts_of(source):
                plain_set = WorkingSet(source, Path(folder, "plain"), layout)
                plain = load_scene(plain_set.root)
                print(f"\n{source.name} as {layout}: {len(plain.views)} photos")
                for number, variant in enumerate(VARIANTS):
                    if layout in variant.layouts and options.only in variant.name:
                        outcome = try_variant(variant, source, layout, Path(folder, str(number)), plain)
                        counts[outcome.kind] += 1
                        print(f"  {outcome.kind:8}{variant.name:58}{outcome.said[:200]}", flush=True)
                shutil.rmtree(plain_set.root)
    print("\n" + ", ".join(f"{kind}: {count}" for kind, count in sorted(counts.items())))
    return 1 if counts["WRONG"] else 0


if __name__ == "__main__":
    sys.exit(main())
