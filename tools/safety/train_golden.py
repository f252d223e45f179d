"""Train the golden models in tests/golden/trained, which tests read instead of training a model of their own.

    make golden

It replaces the files and prints one line for each. Train them again after a change that is meant to improve training,
or when the format changes; a test compares their quality with that of a new training.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

from hyrfpack.atomic import write_atomic
from hyrfpack.compress import compress_model
from hyrfpack.context import RunContext
from hyrfpack.data import load_scene
from hyrfpack.demo.scene import write_demo_scene
from hyrfpack.scene import Scene
from hyrfpack.train import TrainConfig, train_model

TESTS_FOLDER = Path(__file__).parents[2] / "tests"
TRAINED_FOLDER = TESTS_FOLDER / "golden" / "trained"
DEMO_MODEL_FILE = TRAINED_FOLDER / "demo.hyrf"
DEMO_COMPACT_FILE = TRAINED_FOLDER / "demo_compact.hyrf"
EXPOSED_MODEL_FILE = TRAINED_FOLDER / "exposed_balls.hyrf"
# The tables of the second model are small, so that its raw file is small too.
TRAIN_CONFIGS = {
    DEMO_MODEL_FILE: TrainConfig(steps=250, max_gaussians=1500),
    EXPOSED_MODEL_FILE: TrainConfig(steps=150, max_gaussians=300, log2_table_size=7, exposure=True),
}


def write_demo_photos(folder: Path) -> Path:
    """Write the photos and poses of the golden model of the demo scene; return the folder."""
    return write_demo_scene(folder, views=10, size=48)


def make_golden_scene(model_file: Path, folder: Path) -> Scene:
    """Return the scene that a golden model is trained on. Photos of the demo scene are written to `folder`."""
    if model_file == DEMO_MODEL_FILE:
        return load_scene(write_demo_photos(folder))
    from scenes import alternating_gains, exposed_scene

    return exposed_scene(alternating_gains(8, stops=1.0), side=32)


def main() -> None:
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    sys.path.append(str(TESTS_FOLDER))  # the scene of balls is a module of the tests
    with tempfile.TemporaryDirectory() as folder:
        for target, config in TRAIN_CONFIGS.items():
            scene = make_golden_scene(target, Path(folder) / "photos")
            trained = train_model(scene, Path(folder) / target.stem, config, context=RunContext(progress=None))
            write_atomic(target, trained.model.read_bytes())
            if target == DEMO_MODEL_FILE:
                compress_model(target, DEMO_COMPACT_FILE, data=scene)
    for path in sorted(TRAINED_FOLDER.glob("*.hyrf")):
        print(f"{path}: {path.stat().st_size:,} bytes")


if __name__ == "__main__":
    main()
