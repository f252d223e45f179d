"""Build a variant, read it, and check the result."""

from __future__ import annotations

import re
import shutil
from dataclasses import dataclass
from pathlib import Path

from hyrfpack.data import load_scene
from hyrfpack.errors import HyrfError
from hyrfpack.scene import Scene
from tools.safety.variants.differences import find_difference
from tools.safety.variants.variant import EXPECT_READ, Variant
from tools.safety.variants.working_set import WorkingSet


@dataclass(frozen=True)
class Outcome:
    """Result of reading a variant.

    Attributes:
        kind: "read", "refused", "WRONG", or "skipped" if a package is missing that the change needs.
        message: the error message, the notes, what is wrong, or the missing package.
    """

    kind: str
    message: str


def check_variant(variant: Variant, source: Path, layout: str, folder: Path, original_scene: Scene) -> Outcome:
    """Build a variant in a folder, read it, and check the result.

    Args:
        variant: the variant.
        source: the folder of the original set.
        layout: the layout of the set.
        folder: the folder to build in; it is removed afterwards.
        original_scene: the scene of the original set.
    """
    try:
        working_set = WorkingSet(source, folder / "set", layout)
        try:
            variant.make(working_set)
        except ModuleNotFoundError as error:
            return Outcome("skipped", f"the package {error.name} is not installed")
        try:
            scene = load_scene(working_set.source_path)
            difference = find_difference(
                scene, original_scene, working_set.masked_share, may_lack_photos=variant.may_lack_photos
            )
        except HyrfError as error:
            message = str(error).replace(str(folder), "")
            is_expected = variant.expect != EXPECT_READ and re.search(variant.expect, message) and "\n" not in message
            return Outcome("refused" if is_expected else "WRONG", message)
        message = "; ".join(scene.notes).replace(str(folder), "")
        if variant.expect != EXPECT_READ:
            return Outcome("WRONG", f"read, but should be refused; {message}")
        if not difference and variant.note and not re.search(variant.note, message):
            difference = f"no note has '{variant.note}'"
        return Outcome("WRONG" if difference else "read", f"{difference}; {message}" if difference else message)
    except Exception as error:  # a variant must raise nothing but a HyrfError
        return Outcome("WRONG", f"{type(error).__name__}: {str(error)[:300]}")
    finally:
        shutil.rmtree(folder, ignore_errors=True)
