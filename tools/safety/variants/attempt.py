"""Builds a variant, reads it, and says whether that went as it should."""

from __future__ import annotations

import re
import shutil
from dataclasses import dataclass
from pathlib import Path

from hyrfpack.data import load_scene
from hyrfpack.errors import HyrfError
from hyrfpack.scene import Scene
from tools.safety.variants.differences import differs
from tools.safety.variants.variant import READ, Variant
from tools.safety.variants.working_set import WorkingSet


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
