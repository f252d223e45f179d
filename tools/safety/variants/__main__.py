"""Sets of photos as people have them: about a hundred variants of a given set, and what reading each of them gives.

    python -m tools.safety.variants SET [SET ...] [--only WORD]

Each is built in a temporary folder out of links to the set's files, and read. A table says of each whether it was read,
with the same cameras and pictures as the set itself; refused, with which sentence; or WRONG: read with others, refused
where it should be read, read where it should be refused, or not even a sentence. Exits with 1 if one is.
"""

from __future__ import annotations

import argparse
import os
import shutil
import sys
import tempfile
from collections import Counter
from pathlib import Path

from hyrfpack.data import load_scene
from tools.safety.variants.attempt import try_variant
from tools.safety.variants.catalog import VARIANTS
from tools.safety.variants.working_set import WorkingSet


def layouts_of(source: Path) -> list[str]:
    """The layouts that a set can be read as."""
    there = {"colmap": "sparse", "nerfstudio": "transforms.json", "blender": "transforms_train.json"}
    return [layout for layout, sign in there.items() if (source / sign).exists()]


def main() -> int:
    parser = argparse.ArgumentParser("python -m tools.safety.variants", description=__doc__.split("\n")[0])
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
