"""Define a variant: a name, a change to a working set, and the expected result of reading it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from tools.safety.variants.working_set import WorkingSet

EXPECT_READ = ""  # `Variant.expect` of variants that must be readable
ALL_LAYOUTS = ("colmap", "nerfstudio", "blender")


@dataclass(frozen=True)
class Variant:
    """One variant of a data set.

    Attributes:
        name: the name in the table.
        make: changes a working set in place.
        expect: EXPECT_READ, or a pattern that the error message must match.
        layouts: the layouts that have this variant.
        note: a pattern that the notes must match if the variant is read.
        may_lack_photos: whether photos of the original set may be missing if the variant is read.
    """

    name: str
    make: Callable[[WorkingSet], object]
    expect: str = EXPECT_READ
    layouts: tuple[str, ...] = ("colmap",)
    note: str = ""
    may_lack_photos: bool = False
