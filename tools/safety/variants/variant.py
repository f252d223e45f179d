"""What a variant is: a name, a change to a working set, and what reading it should give."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from tools.safety.variants.working_set import WorkingSet

READ = ""  # what a variant should be: read; any other text is what the refusal has to say
ALL = ("colmap", "nerfstudio", "blender")  # layouts


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
