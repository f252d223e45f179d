"""Photos stored on their side or upside down, with EXIF that says so, says it wrongly or is lost."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from PIL import Image, ImageOps

from tools.safety.variants.variant import ALL, Variant
from tools.safety.variants.working_set import WorkingSet


def variants() -> Iterator[Variant]:
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
