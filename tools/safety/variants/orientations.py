"""Variants whose photos are stored rotated, with a correct, a wrong or a missing EXIF orientation."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from PIL import Image, ImageOps

from tools.safety.variants.variant import ALL_LAYOUTS, Variant
from tools.safety.variants.working_set import WorkingSet


def list_variants() -> Iterator[Variant]:
    """Yield the variants of this module."""

    def store_rotated(
        orientation: int, every: int = 1, keep_tag: bool = True, ending: str = ".png"
    ) -> Callable[[WorkingSet], None]:
        """Store the photos rotated, so that applying their EXIF orientation gives the pictures of the poses."""
        inverse_orientation = {6: 8, 8: 6}.get(orientation, orientation)

        def make(s: WorkingSet) -> None:
            count = 0

            def rotate(image: Image.Image) -> Image.Image:
                nonlocal count
                count += 1
                image.info.clear()
                exif = image.getexif()
                exif.clear()
                if (count - 1) % every:
                    return image
                exif[0x0112] = inverse_orientation
                image = ImageOps.exif_transpose(image)
                exif = image.getexif()
                if keep_tag:
                    exif[0x0112] = orientation
                return image

            for file in s.photos:
                with Image.open(file) as image:
                    picture = rotate(image.convert("RGB"))
                file.unlink()
                picture.save(
                    file.with_suffix(ending), exif=picture.getexif(), **({"quality": 95} if ending != ".png" else {})
                )

        return make

    for orientation in (5, 6, 7, 8):
        yield Variant(
            f"turned: stored as EXIF {orientation} says",
            store_rotated(orientation),
            note="are rotated",
            layouts=ALL_LAYOUTS[:2],
        )
    for ending in (".jpg", ".webp", ".tif", ".avif"):
        yield Variant(f"turned: {ending} stored as EXIF 6 says", store_rotated(6, ending=ending), note="are rotated")
    yield Variant("turned: every third alone", store_rotated(8, every=3), note="are rotated")
    yield Variant(
        "turned: EXIF lost", store_rotated(6, keep_tag=False), "not a uniform rescaling", layouts=ALL_LAYOUTS[:2]
    )
    yield Variant(
        "turned: 6 and upside down mixed",
        lambda s: (store_rotated(6, every=2)(s), _store_upside_down(s)),
        note="are rotated",
    )
    yield Variant("turned: as calibrated, EXIF says 6", _tag_orientation(6), layouts=ALL_LAYOUTS)
    yield Variant("turned: as calibrated, EXIF says 3", _tag_orientation(3), layouts=ALL_LAYOUTS)
    yield Variant(
        "turned: masks as stored",
        lambda s: (s.write_masks(lambda f: f"masks/{f.stem}.png"), _rotate_masks(s), store_rotated(6)(s)),
        note="have a mask",
    )
    yield Variant(
        "turned: masks upright",
        lambda s: (s.write_masks(lambda f: f"masks/{f.stem}.png"), store_rotated(6)(s)),
        note="have a mask",
    )


def _store_upside_down(s: WorkingSet) -> None:
    """Store the photos without an orientation upside down, with EXIF orientation 3."""
    for file in s.photos:
        with Image.open(file) as image:
            if image.getexif().get(0x0112, 1) != 1:
                continue
            picture = image.transpose(Image.Transpose.ROTATE_180)
        exif = Image.Exif()
        exif[0x0112] = 3
        file.unlink()
        picture.save(file, exif=exif)


def _tag_orientation(orientation: int) -> Callable[[WorkingSet], None]:
    exif = Image.Exif()
    exif[0x0112] = orientation
    return lambda s: s.encode(".png", exif=exif)


def _rotate_masks(s: WorkingSet) -> None:
    for file in (s.root / "masks").iterdir():
        with Image.open(file) as image:
            picture = image.transpose(Image.Transpose.ROTATE_90)
        picture.save(file)
