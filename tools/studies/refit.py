"""Measure how well `hyrfpack edit --refit` repairs damage that this program plants in a part of trained models.

    python -m tools.studies.refit --runs runs/sets/2000 --sets ngp_fox --steps 200 500 --factors 0.1 0.3 1

--runs has a folder for each data set, with one run: a `model.hyrf`. The region is the sphere around the point that the
cameras look at with a tenth of the Gaussians. Damage "colors" shuffles the colours of its Gaussians, "all" also their
scales and opacities, "moved" moves their centres at random by a twentieth of the sphere's radius, and "none" changes
nothing.

The columns are PSNR in dB of the region, on pixels that mostly show it: of the model, with the damage, and after the
refit. Without --held-out, every eighth training photo is a validation photo, which the refit
leaves out; the model itself was trained on these. With it, photos are the held-out ones. --factors multiply all
learning rates.

The results are in docs/research/refit.md.
"""

from __future__ import annotations

import copy
import time
from dataclasses import fields

import numpy as np
import torch

import hyrfpack
from hyrfpack.cameras.capture import Capture
from hyrfpack.config.edit import DEFAULT_REFIT_STEPS
from hyrfpack.config.train import LearningRates
from hyrfpack.edit.refit import REFIT_RATES, refit_region, score_region
from hyrfpack.model import HybridModel
from tools.command import positive_integer, run_command
from tools.studies.trained_runs import load_runs, make_runs_parser
from tools.tables import markdown_row, markdown_table

REGION_SHARE = 0.1
MOVE_PER_RADIUS = 0.05
VALIDATION_INTERVAL = 8
SHUFFLED_NAMES = {
    "none": (),
    "colors": ("color_logits",),
    "all": ("color_logits", "scale_logits", "opacity_logits"),
    "moved": (),
}


def select_region(model: HybridModel, center: np.ndarray) -> tuple[np.ndarray, float]:
    """Return a mask (N,) of the Gaussians nearest to a point in world units, and the radius of their sphere."""
    distances = np.linalg.norm(model.config.frame.to_world(model.gaussians.positions.numpy()) - center, axis=1)
    radius = float(np.quantile(distances, REGION_SHARE))
    return distances <= radius, radius


def plant_damage(model: HybridModel, is_selected: np.ndarray, kind: str, radius: float, seed: int) -> HybridModel:
    """Return a copy of a model whose selected Gaussians are damaged.

    Args:
        model: the model.
        is_selected: (N,) bool, the Gaussians.
        kind: one of SHUFFLED_NAMES.
        radius: radius of the region in world units.
        seed: random seed.
    """
    damaged, generator = copy.deepcopy(model), np.random.default_rng(seed)
    selected_index = torch.from_numpy(np.flatnonzero(is_selected))
    with torch.no_grad():
        for name in SHUFFLED_NAMES[kind]:
            values = getattr(damaged.gaussians, name)
            shuffled = selected_index[torch.from_numpy(generator.permutation(len(selected_index)))]
            values[selected_index] = values[shuffled]
        if kind == "moved":
            size = MOVE_PER_RADIUS * radius / model.config.frame.scale
            moves = torch.from_numpy(generator.normal(0, size, (len(selected_index), 3))).float()
            damaged.gaussians.positions[selected_index] += moves
    return damaged


def scale_rates(rates: LearningRates, factor: float) -> LearningRates:
    """Return all learning rates, multiplied by a factor."""
    scaled = {field.name: tuple(factor * rate for rate in getattr(rates, field.name)) for field in fields(rates)}
    return LearningRates(**scaled)


def main() -> None:
    parser = make_runs_parser(__doc__ or "")
    parser.add_argument("--sets", nargs="*", help="data sets (all below --runs)")
    parser.add_argument(
        "--kinds", nargs="+", choices=SHUFFLED_NAMES, default=list(SHUFFLED_NAMES), help="damages (all)"
    )
    parser.add_argument(
        "--steps",
        type=positive_integer,
        nargs="+",
        default=[DEFAULT_REFIT_STEPS],
        help=f"steps of the refit ({DEFAULT_REFIT_STEPS})",
    )
    parser.add_argument("--factors", type=float, nargs="+", default=[1.0], help="factors of all learning rates (1)")
    parser.add_argument("--held-out", action="store_true", help="score held-out photos")
    parser.add_argument("--seed", type=int, default=0, help="random seed (0)")
    arguments = parser.parse_args()
    rows = []
    for name, model_file, scene in load_runs(arguments.runs, arguments.data, arguments.sets):
        model = hyrfpack.load_model(model_file).requires_grad_(False)
        validation = scene.train[::VALIDATION_INTERVAL]
        scored = scene.test if arguments.held_out else validation
        trained = [view for view in scene.train if arguments.held_out or view not in validation]
        is_selected, radius = select_region(model, Capture(hyrfpack.describe_file(model_file)).viewpoint.center)
        for kind in arguments.kinds:
            damaged = plant_damage(model, is_selected, kind, radius, arguments.seed)
            for steps in arguments.steps:
                for factor in arguments.factors:
                    start = time.perf_counter()
                    rates = scale_rates(REFIT_RATES, factor)
                    has_gains = model.exposure is not None
                    repaired = refit_region(damaged, is_selected, trained, steps, has_gains=has_gains, rates=rates)
                    seconds = time.perf_counter() - start
                    psnrs = score_region((model, damaged, repaired), is_selected, scored)
                    # No pixel of these photos may show mostly the region.
                    scores = ["", "", ""] if psnrs is None else [f"{psnr:.2f}" for psnr in psnrs]
                    row = [name, f"{is_selected.sum():,}", kind, str(steps), f"{factor:g}", *scores, f"{seconds:.0f}"]
                    rows.append(row)
                    print(markdown_row(row), flush=True)
    header = ["set", "Gaussians", "damage", "steps", "rates", "dB", "dB damaged", "dB refit", "seconds"]
    print(markdown_table(header, rows))


if __name__ == "__main__":
    run_command(main)
