"""Check an installed hyrfpack in a minute: read golden files, render, export, and run commands.

    python tools/safety/smoke.py

It is for systems on which the tests do not run. It checks the package that this Python has installed, and takes only
the golden files from the checkout. It prints one line for each check and ends with the error of the first that fails.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

import hyrfpack

GOLDEN_FOLDER = Path(__file__).parents[2] / "tests" / "golden"
TRAINED_FILE = GOLDEN_FOLDER / "trained" / "demo_compact.hyrf"
EXPORT_ENDINGS = (".ply", ".spz", ".sog", ".glb", ".html")
PICTURE_COUNT = 2


def check_golden_files() -> str:
    """Compare the numbers of each golden file with the recorded ones."""
    paths = sorted(GOLDEN_FOLDER.glob("*.hyrf"))
    assert paths, f"{GOLDEN_FOLDER} has no golden files"
    for path in paths:
        recorded = np.load(path.with_suffix(".npz"))
        for name, values in hyrfpack.load_model(path).state_dict().items():
            np.testing.assert_allclose(values.numpy(), recorded[name], rtol=1e-6, err_msg=f"{path.name}: {name}")
    return f"{len(paths)} golden files have the recorded numbers"


def check_saving(folder: Path) -> str:
    """Write a model, read it again and compare the numbers."""
    model = hyrfpack.load_model(TRAINED_FILE)
    hyrfpack.save_model(model, folder / "saved.hyrf")
    loaded = hyrfpack.load_model(folder / "saved.hyrf").state_dict()
    assert all(np.array_equal(values, loaded[name]) for name, values in model.state_dict().items())
    return f"{len(model):,} Gaussians are the same after writing and reading"


def check_exports(folder: Path) -> str:
    """Export a model to several formats."""
    sizes = []
    for ending in EXPORT_ENDINGS:
        hyrfpack.export_model(TRAINED_FILE, folder / f"scene{ending}")
        sizes.append(f"{ending} {(folder / f'scene{ending}').stat().st_size:,} bytes")
    return "exported " + ", ".join(sizes)


def check_commands(folder: Path) -> str:
    """Run `info` and `render`, and check that the pictures are not uniform."""
    from PIL import Image

    facts = json.loads(run_command("info", TRAINED_FILE, "--json"))
    run_command("render", TRAINED_FILE, "--orbit", PICTURE_COUNT, "-o", folder / "views")
    pictures = [np.asarray(Image.open(path)) for path in sorted((folder / "views").glob("*.png"))]
    assert len(pictures) == PICTURE_COUNT and all(np.ptp(picture[..., :3]) > 50 for picture in pictures)
    return f"rendered {PICTURE_COUNT} pictures of {facts['gaussians']:,} Gaussians by the command line"


def run_command(*arguments: object) -> str:
    """Run `hyrfpack` with these arguments in a new process and return what it prints."""
    command = [sys.executable, "-m", "hyrfpack", *map(str, arguments)]
    return subprocess.run(command, check=True, stdout=subprocess.PIPE, encoding="utf-8").stdout


def main() -> None:
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    print(f"hyrfpack {hyrfpack.__version__} in {Path(hyrfpack.__file__).parent}, Python {sys.version.split()[0]}")
    print(check_golden_files())
    with tempfile.TemporaryDirectory() as folder:
        for check in (check_saving, check_exports, check_commands):
            print(check(Path(folder)), flush=True)


if __name__ == "__main__":
    main()
