"""Finished training runs of several data sets, as the studies of edits take them."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path

import hyrfpack
from hyrfpack.errors import HyrfError
from hyrfpack.format.run_folder import MODEL_FILE
from hyrfpack.scene import Scene
from tools.studies.train_sets import DATA_FOLDER


def make_runs_parser(text: str) -> argparse.ArgumentParser:
    """Return the parser of a study of finished runs, with the options --runs and --data."""
    parser = argparse.ArgumentParser(description=text, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=Path, required=True, help="folder with a folder of runs for each data set")
    parser.add_argument("--data", type=Path, default=DATA_FOLDER, help="folder of the data sets")
    return parser


def load_runs(runs: Path, data: Path, names: Sequence[str] | None = None) -> Iterator[tuple[str, Path, Scene]]:
    """Yield the name of each data set, the model file of its run, and its scene.

    Args:
        runs: folder of the data sets' runs.
        data: folder of the data sets.
        names: the data sets; None for all folders below `runs`.

    Raises:
        HyrfError: a data set has no run, or several, such as those of two versions.
    """
    if not runs.is_dir():
        raise HyrfError(f"{runs}: there is no such folder", fix="make runs with tools.studies.train_sets")
    for name in names or sorted(path.name for path in runs.iterdir() if path.is_dir()):
        model_files = sorted((runs / name).glob(f"**/{MODEL_FILE}"))
        if not model_files:
            fix = "make one with tools.studies.train_sets"
            raise HyrfError(f"{runs / name}: there is no run with a {MODEL_FILE}", fix=fix)
        if len(model_files) > 1:
            folders = ", ".join(str(path.parent.relative_to(runs)) for path in model_files)
            fix = "name a folder with one run for each data set"
            raise HyrfError(f"{runs}: there are several runs of {name}: {folders}", fix=fix)
        yield name, model_files[0], hyrfpack.load_scene(data / name)
