"""Read up to 150 variants of each data set, as users may have them, and check the result of each.

    python -m tools.safety.variants SET [SET ...] [--only WORD]

Each variant is built in a temporary folder from links to the set's files, and read. A set is read in each layout that
it has. The program prints one line for each variant:

    read        cameras and pictures equal those of the set; the line shows the notes
    refused     the set cannot be read in this form, and the error message says why
    WRONG       cameras or pictures differ, a variant is read that should be refused or vice versa, a note is missing,
                or reading raises anything but a HyrfError
    skipped     a package is missing that the change needs

It exits with 1 if a variant is WRONG, and with 2 if none was checked.
"""

from __future__ import annotations

import argparse
import os
import shutil
import tempfile
from collections import Counter
from pathlib import Path

from hyrfpack.data import load_scene
from hyrfpack.errors import HyrfError
from tools.command import run_command
from tools.safety.variants.catalog import ALL_VARIANTS
from tools.safety.variants.check import check_variant
from tools.safety.variants.working_set import WorkingSet


def list_layouts(source: Path) -> list[str]:
    """Return the layouts in which a data set can be read."""
    marker_files = {"colmap": "sparse", "nerfstudio": "transforms.json", "blender": "transforms_train.json"}
    return [layout for layout, marker in marker_files.items() if (source / marker).exists()]


def main() -> int:
    parser = argparse.ArgumentParser("python -m tools.safety.variants", description=__doc__.split("\n")[0])
    parser.add_argument("sets", nargs="+", type=Path, metavar="SET")
    parser.add_argument("--only", default="", metavar="WORD", help="only variants with this word in their names")
    options = parser.parse_args()
    counts: Counter[str] = Counter()
    with tempfile.TemporaryDirectory(prefix="variants-") as folder:
        os.environ["XDG_CACHE_HOME"] = os.path.join(folder, "cache")
        for source in options.sets:
            layouts = list_layouts(source)
            if not layouts:
                raise HyrfError(f"{source}: there is no data set", fix="name the folder of a data set")
            for layout in layouts:
                original_set = WorkingSet(source, Path(folder, "plain"), layout)
                original_scene = load_scene(original_set.root)
                print(f"\n{source.name} as {layout}: {len(original_scene.views)} photos")
                for number, variant in enumerate(ALL_VARIANTS):
                    if layout in variant.layouts and options.only in variant.name:
                        outcome = check_variant(variant, source, layout, Path(folder, str(number)), original_scene)
                        counts[outcome.kind] += 1
                        print(f"  {outcome.kind:8}{variant.name:58}{outcome.message[:200]}", flush=True)
                shutil.rmtree(original_set.root)
    if counts.total() == counts["skipped"]:
        fix = "name folders of data sets, and a word of a variant's name with `only`"
        raise HyrfError(f"nothing was checked: {', '.join(map(str, options.sets))} --only '{options.only}'", fix=fix)
    print("\n" + ", ".join(f"{kind}: {count}" for kind, count in sorted(counts.items())))
    return 1 if counts["WRONG"] else 0


if __name__ == "__main__":
    run_command(main)
