"""Variants with one mask per photo or one mask for all, under common names, and with masks that fit no photo."""

from __future__ import annotations

from collections.abc import Iterator

from PIL import Image

from tools.safety.variants.variant import Variant
from tools.safety.variants.working_set import WorkingSet


def list_variants() -> Iterator[Variant]:
    """Yield the variants of this module."""
    note = "have a mask"
    yield Variant("masks: of the photos' names", lambda s: s.write_masks(lambda f: f"masks/{f.stem}.png"), note=note)
    yield Variant("masks: .png added", lambda s: s.write_masks(lambda f: f"masks/{f.name}.png"), note=note)
    yield Variant(
        "masks: of the photos' names in capitals",
        lambda s: s.write_masks(lambda f: f"masks/{f.stem.upper()}.PNG"),
        note=note,
    )
    yield Variant("masks: in a folder", lambda s: s.write_masks(lambda f: f"masks/left/{f.stem}.webp"), note=note)
    yield Variant("masks: half as large", lambda s: _write_half_size_masks(s), note=note)
    yield Variant("masks: one, mask.png", lambda s: s.write_masks(lambda f: "mask.png"), note="used for all")
    yield Variant(
        "masks: one in the folder", lambda s: s.write_masks(lambda f: "masks/camera.png"), note="used for all"
    )
    yield Variant(
        "masks: one of another shape",
        lambda s: (s.write_masks(lambda f: "masks/camera.png", (50, 13)), setattr(s, "masked_share", 0.0)),
        note="aspect ratio",
    )
    yield Variant(
        "masks: of no photo",
        lambda s: (s.write_masks(lambda f: f"masks/{f.stem}_mask.png"), setattr(s, "masked_share", 0.0)),
        note="match no photo of the scene",
    )
    yield Variant(
        "masks: in mask/",
        lambda s: (s.write_masks(lambda f: f"mask/{f.stem}.png"), setattr(s, "masked_share", 0.0)),
        note="folder mask is not read",
    )


def _write_half_size_masks(s: WorkingSet) -> None:
    with Image.open(s.photos[0]) as image:
        size = image.width // 2, image.height // 2
    s.write_masks(lambda f: f"masks/{f.stem}.png", size)
