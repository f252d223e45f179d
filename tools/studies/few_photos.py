"""Compare runs of several lengths on few photos, scored on validation photos, and print a table.

    python -m tools.studies.few_photos --steps 1000 3000 7000 --sets drone_brighton_beach indoor_room@12

Each run trains on three of four training photos of a set or variant (`set_variants.py`) and is scored on the others.
Runs of another fold have other validation photos and another seed. Cells have PSNR in dB and SSIM, in brackets PSNR of
up to 8 training photos. All runs have half of the default Gaussian budget. Per-image gains are learnt unless photos
have transparency or --no-exposure is given. Held-out photos are not used.

The results are in docs/research/few-photos.md.
"""

from __future__ import annotations

import argparse
import dataclasses
from dataclasses import dataclass
from pathlib import Path

import hyrfpack
from hyrfpack.scene import evenly_spaced
from hyrfpack.train import TrainConfig, Trainer
from hyrfpack.train.pilots import split
from tools.command import positive_integer, run_command
from tools.json_files import merge_rows
from tools.studies.set_variants import load_variant
from tools.studies.train_sets import DATA_FOLDER
from tools.tables import markdown_row, markdown_table

VALIDATION_EVERY = 4
MAX_TRAINING_VIEWS_SCORED = 8
BUDGET_FACTOR = 0.5
DEFAULT_SETS = ("drone_brighton_beach", "indoor_room@12", "gerrard_hall@25", "nerf_synthetic_lego@25")


@dataclass(frozen=True)
class Scores:
    """Mean scores of one run: PSNR (dB) and SSIM of validation photos, and PSNR of training photos."""

    psnr: float
    ssim: float
    training_psnr: float

    def __str__(self) -> str:
        return f"{self.psnr:.2f}, {self.ssim:.3f} ({self.training_psnr:.1f})"


def train_and_score(data: Path, name: str, fold: int, steps: int, exposure: bool) -> Scores:
    """Train on the training photos of one fold and score its validation photos.

    Args:
        data: folder of the sets.
        name: name of a set or variant.
        fold: number of the fold, from 0; also the seed.
        steps: training steps.
        exposure: learn per-image gains.
    """
    scene = load_variant(data, name)
    training, validation = split(scene.train, VALIDATION_EVERY, len(scene.train), fold)
    scene = dataclasses.replace(scene, train=training, test=[])
    config = TrainConfig(steps=steps, seed=fold, exposure=exposure and not scene.has_alpha, budget_factor=BUDGET_FACTOR)
    trainer = Trainer(scene, config)
    trainer.run()
    validated = hyrfpack.evaluate_model(trainer.model, validation)
    fitted = hyrfpack.evaluate_model(trainer.model, evenly_spaced(training, MAX_TRAINING_VIEWS_SCORED))
    return Scores(validated.psnr, validated.ssim, fitted.psnr)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sets", nargs="+", default=list(DEFAULT_SETS), help="folders below --data, or variants")
    parser.add_argument(
        "--steps", type=positive_integer, nargs="+", default=[1000, 3000], help="steps of each column (1,000 and 3,000)"
    )
    parser.add_argument(
        "--folds", type=int, default=1, choices=range(1, VALIDATION_EVERY + 1), help="number of folds (1)"
    )
    parser.add_argument("--no-exposure", dest="exposure", action="store_false", help="learn no per-image gains")
    parser.add_argument("--data", type=Path, default=DATA_FOLDER, help="folder of the data sets")
    parser.add_argument(
        "--out", type=Path, default=Path("runs/few_photos.json"), help="file for all scores, also those of other calls"
    )
    args = parser.parse_args()
    rows = []
    for name in args.sets:
        for fold in range(args.folds):
            cells = [name, str(fold)]
            for steps in args.steps:
                scores = train_and_score(args.data, name, fold, steps, args.exposure)
                settings = {"set": name, "fold": fold, "steps": steps, "exposure": args.exposure}
                merge_rows(args.out, [{**settings, **dataclasses.asdict(scores)}], keys=list(settings))
                cells.append(str(scores))
            rows.append(cells)
            print(markdown_row(cells), flush=True)
    print("\n" + markdown_table(["set", "fold", *(f"{steps:,} steps" for steps in args.steps)], rows))


if __name__ == "__main__":
    run_command(main)
