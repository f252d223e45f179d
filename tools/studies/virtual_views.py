"""Compare runs on few photos with and without virtual views, scored on validation photos, and print a table.

    python -m tools.studies.virtual_views --sets drone_caliterra@12 gerrard_hall@12 --seeds 0 1

Set and steps must be ones with virtual views (`hyrfpack.train.teachers.count_teachers`).

A variant (`set_variants.py`) is trained on all of its photos, and scored on up to 24 other training photos of the full
set. A full set is trained on three of four training photos and scored on up to 8 others. Held-out photos are not used.
Cells have plain PSNR in dB and SSIM of the raw model, the change by virtual views, and CPU seconds of both runs with
their teacher runs. All runs have the usual Gaussian budget. Per-image gains are learnt unless photos have transparency.

The results are in docs/research/few-photos.md.
"""

from __future__ import annotations

import argparse
import dataclasses
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import hyrfpack
from hyrfpack.context import RunContext
from hyrfpack.errors import HyrfError
from hyrfpack.scene import Scene, View, evenly_spaced
from hyrfpack.train import TrainConfig
from hyrfpack.train.pilots import split
from hyrfpack.train.resolution import PhotoSize
from hyrfpack.train.teachers import count_teachers
from tools.command import positive_integer, run_command
from tools.json_files import merge_rows
from tools.studies.complete_run import train_completely
from tools.studies.set_variants import load_variant
from tools.studies.train_sets import DATA_FOLDER
from tools.tables import markdown_row, markdown_table

MAX_OTHER_VIEWS_SCORED = 24
MAX_SPLIT_VIEWS_SCORED = 8
VALIDATION_EVERY = 4
DEFAULT_SETS = tuple(
    f"{name}@12"
    for name in (
        "drone_caliterra", "indoor_room", "nerf_synthetic_lego", "gerrard_hall", "mipnerf360_bonsai", "ngp_fox",
    )
)  # fmt: skip


@dataclass(frozen=True)
class Scores:
    """Mean scores of one run on validation photos, PSNR in dB, and its CPU seconds."""

    psnr: float
    ssim: float
    seconds: float


def load_photos(data: Path, name: str, fold: int) -> tuple[Scene, list[View]]:
    """Return the scene to train on, without held-out photos, and the validation photos.

    Args:
        data: folder of the sets.
        name: name of a set, or of its variant with fewer photos.
        fold: number of the fold of a full set.

    Raises:
        HyrfError: the variant has other changes, which its validation photos would lack.
    """
    if any(not change.isdecimal() for change in name.split("@")[1:]):
        raise HyrfError(f"'{name}': its photos are changed", fix="name a set, or a variant with fewer photos")
    scene = load_variant(data, name)
    if "@" not in name:
        training, validation = split(scene.train, VALIDATION_EVERY, MAX_SPLIT_VIEWS_SCORED, fold)
        return dataclasses.replace(scene, train=training, test=[]), validation
    trained = {view.name for view in scene.train}
    others = [view for view in load_variant(data, name.split("@")[0]).train if view.name not in trained]
    return dataclasses.replace(scene, test=[]), evenly_spaced(others, MAX_OTHER_VIEWS_SCORED)


def train_and_score(scene: Scene, validation: list[View], config: TrainConfig) -> Scores:
    """Train a run in a temporary folder, and score its model on validation photos."""
    start = time.process_time()
    with tempfile.TemporaryDirectory() as folder:
        result = train_completely(scene, Path(folder), config, context=RunContext(progress=None))
        seconds = time.process_time() - start
        scores = hyrfpack.evaluate_model(hyrfpack.load_model(result.model), validation)
    return Scores(scores.psnr, scores.ssim, seconds)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sets", nargs="+", default=list(DEFAULT_SETS), help="folders below --data, or variants")
    parser.add_argument("--steps", type=positive_integer, default=3000, help="steps of each run (3,000)")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0], help="random seeds, also folds of full sets (0)")
    parser.add_argument("--data", type=Path, default=DATA_FOLDER, help="folder of the data sets")
    parser.add_argument(
        "--out", type=Path, default=Path("runs/virtual_views.json"), help="file for all scores, also of other calls"
    )
    args = parser.parse_args()
    rows = []
    for name in args.sets:
        for seed in args.seeds:
            scene, validation = load_photos(args.data, name, seed)
            config = TrainConfig(
                steps=args.steps, seed=seed, exposure=not scene.has_alpha, budget_factor=1.0, early_stop=False
            )
            if not count_teachers(len(scene.train), PhotoSize.of_views(scene.train), config):
                parser.error(f"{name}: runs of {args.steps:,} steps on {len(scene.train)} photos have no virtual views")
            scores = []
            for virtual_views in (False, True):
                score = train_and_score(scene, validation, dataclasses.replace(config, virtual_views=virtual_views))
                settings = {"set": name, "seed": seed, "steps": args.steps, "virtual_views": virtual_views}
                merge_rows(args.out, [{**settings, **dataclasses.asdict(score)}], keys=list(settings))
                scores.append(score)
            alone, taught = scores
            cells = [
                name,
                str(seed),
                f"{alone.psnr:.2f}, {alone.ssim:.3f}",
                f"{taught.psnr - alone.psnr:+.2f}, {taught.ssim - alone.ssim:+.3f}",
                f"{alone.seconds:.0f}, {taught.seconds:.0f}",
            ]
            rows.append(cells)
            print(markdown_row(cells), flush=True)
    header = ["set", "seed", "without", "change by virtual views", "CPU s"]
    print("\n" + markdown_table(header, rows))


if __name__ == "__main__":
    run_command(main)
