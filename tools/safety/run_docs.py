"""Run the Python code of the documentation as written: each page from top to bottom, in a new process and folder.

    python -m tools.safety.run_docs                       the Python API page and the README, all training steps
    python -m tools.safety.run_docs --steps 20 README.md  fewer steps: quick, worse pictures and times

The folder has photos in photos/bonsai: those of --data (default: the real data set mipnerf360_bonsai), or a synthetic
scene if there are none. The code of a page is that of its ```python blocks, and of indented blocks that import
hyrfpack. It prints for each page whether it ran to its end and the seconds it took, and exits with 1 after a failure.
"""

from __future__ import annotations

import argparse
import os
import platform
import re
import shutil
import subprocess
import sys
import tempfile
import time
from importlib.metadata import version
from pathlib import Path

from hyrfpack.demo.scene import write_demo_scene
from tools.command import positive_integer

REPOSITORY_ROOT = Path(__file__).parents[2]
DOCUMENTED_PAGES = (REPOSITORY_ROOT / "docs" / "reference" / "python-api.md", REPOSITORY_ROOT / "README.md")
DEFAULT_PHOTOS_FOLDER = (
    Path(os.environ.get("HYRFPACK_DATA") or REPOSITORY_ROOT.parent / "shared" / "data") / "mipnerf360_bonsai"
)
PYTHON_BLOCK_PATTERN = re.compile(
    r"^```python\n(?P<fenced>.*?)^```$|(?P<indented>(?:^    [^\n]*\n|^\n)+)", re.MULTILINE | re.DOTALL
)
FEWER_STEPS_SCRIPT = """
import runpy, sys
from hyrfpack.measure import timing
from hyrfpack.train import TrainConfig
whole = TrainConfig.__post_init__
def fewer(config):
    object.__setattr__(config, "steps", min(config.steps, {steps}))
    whole(config)
TrainConfig.__post_init__ = fewer
timing.WARM_UP_SECONDS = 0
runpy.run_path(sys.argv[1], run_name="__main__")
"""


def extract_python(page: str) -> str:
    """Return a page's Python code with each line at its line number on the page, so that errors name that line."""
    lines = [""] * (page.count("\n") + 1)
    for block in PYTHON_BLOCK_PATTERN.finditer(page):
        if block["fenced"] is None and "import hyrfpack" not in block["indented"]:
            continue
        kind = "fenced" if block["fenced"] is not None else "indented"
        first = page.count("\n", 0, block.start(kind))
        for number, line in enumerate(block[kind].splitlines(), start=first):
            lines[number] = line[4:] if kind == "indented" else line
    return "\n".join(lines)


def run_page(page: Path, data: Path, steps: int | None) -> bool:
    """Run the code of one page; return whether it ran without an error."""
    code = extract_python(page.read_text(encoding="utf-8"))
    if not code.strip():
        print(f"{page}: the page has no Python code")
        return False
    with tempfile.TemporaryDirectory(prefix="hyrfpack-docs-") as folder:
        photos, script = Path(folder, "photos", "bonsai"), Path(folder, page.name)
        if data.is_dir():
            shutil.copytree(data, photos)
        else:
            write_demo_scene(photos)
        script.write_text(code, encoding="utf-8")
        step_options = [] if steps is None else ["-c", FEWER_STEPS_SCRIPT.format(steps=steps)]
        return subprocess.run([sys.executable, *step_options, script], cwd=folder).returncode == 0


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "pages",
        nargs="*",
        type=Path,
        default=DOCUMENTED_PAGES,
        help="pages to run (the Python API page and the README)",
    )
    parser.add_argument("--data", type=Path, default=DEFAULT_PHOTOS_FOLDER, help="a folder of photos and poses")
    parser.add_argument("--steps", type=positive_integer, help="limit of training steps (as written on the pages)")
    args = parser.parse_args()
    for page in args.pages:
        if not page.is_file():
            parser.error(f"{page}: there is no such page; name Markdown files of the documentation")
    packages = ", ".join(f"{name} {version(name)}" for name in ("numpy", "torch", "pycolmap"))
    photos = args.data if args.data.is_dir() else f"a synthetic scene, because {args.data} does not exist"
    steps = "as many steps as written" if args.steps is None else f"at most {args.steps} steps"
    print(f"Python {platform.python_version()}, {packages}; {photos}; {steps}", flush=True)
    has_failed = False
    for page in args.pages:
        print(f"== {page}", flush=True)
        started = time.perf_counter()
        succeeded = run_page(page, args.data, args.steps)
        has_failed |= not succeeded
        print(
            f"== {page}: {'ran as written' if succeeded else 'FAILED'}, {time.perf_counter() - started:.0f} s",
            flush=True,
        )
    return int(has_failed)


if __name__ == "__main__":
    sys.exit(main())
