"""Run the ablation behind each default for which the HyRF paper and its authors' code disagree.

    python -m tools.studies.design_choices --steps 1000 --seeds 2

This makes the table of docs/research/paper-and-code.md, and one more row, for the points that training starts from
(docs/research/initial-points.md). Runs are kept in --out and are not repeated. Each row changes one setting of the
default and is the mean over the seeds: PSNR in dB, its spread between seeds, SSIM, number of Gaussians, bytes and
training steps per second. Scores are those of the decoded `paper` file on held-out views. A difference between rows is
significant only if it is larger than the spread, which takes two seeds. Runs of another version are refused.
"""

from __future__ import annotations

import re
import statistics
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import patch

import torch
from torch import Tensor

from hyrfpack.data import PictureCache
from hyrfpack.model import HybridModel, ModelConfig
from hyrfpack.model.gaussians import logit
from hyrfpack.scene import Scene
from hyrfpack.train import TrainConfig, density, setup, trainer
from tools.command import run_command
from tools.studies.train_sets import make_study_parser, measure
from tools.tables import markdown_row, markdown_table


@dataclass(frozen=True)
class Choice:
    """One row of the table.

    Attributes:
        training: changed settings of `TrainConfig`.
        model: changed settings of `ModelConfig` that `TrainConfig` does not offer.
    """

    training: dict = field(default_factory=dict)
    model: dict = field(default_factory=dict)


CHOICES_BY_VARIANT = {
    "default": Choice(),
    "scale S sigma(s_n) sigma(s_e), as the authors' code": Choice(model={"scale_rule": "product"}),
    "S(p) constant": Choice(model={"scale_grows": False}),
    "direction by spherical harmonics, as the authors' code": Choice({"direction_encoding": "sh"}),
    "grids from 64 to 1024, as both": Choice({"grid_resolutions": (64, 1024)}),
    "fields pass gradients to positions": Choice(model={"position_gradients": True}),
    "no background sphere": Choice({"background": False}),
    "antialiased": Choice({"antialiased": True}),
    "points of the reconstruction alone": Choice({"surface_points": False}),
}


@contextmanager
def train_models_with(**settings: Any) -> Iterator[None]:
    """Enter the context in which training builds models with these settings of `ModelConfig`."""

    def build(scene: Scene, config: TrainConfig, cache: PictureCache) -> tuple[HybridModel, int, dict[str, str]]:
        with patch.object(setup, "ModelConfig", partial(ModelConfig, **settings)):
            model, budget, choices = setup.build_model(scene, config, cache)
        if model.config.scale_rule == "product":
            with torch.no_grad():  # the neural factor is 1/2 at the start
                stored = model.gaussians.scale_logits
                stored.copy_(logit((2 * torch.sigmoid(stored)).clamp(max=0.999)))
        return model, budget, choices

    with ExitStack() as stack:
        stack.enter_context(patch.object(trainer, "build_model", build))
        if settings.get("scale_rule") == "product":
            stack.enter_context(patch.object(density, "_shrink", _shrink_stored_factor))
        yield


def _shrink_stored_factor(scale_logits: Tensor, fractions: Tensor) -> Tensor:
    """Return logits that divide the stored factor of a scale, and so the scale, by `SPLIT_SHRINK`."""
    return logit(torch.sigmoid(scale_logits) / density.SPLIT_SHRINK)


def run_folder(out: Path, variant: str, name: str, seed: int) -> Path:
    """Return the folder of the run of a variant on the data set `name`; no other variant has it."""
    return out / f"{re.sub('[^a-z0-9]+', '-', variant.lower()).strip('-')}-{name}-{seed}"


def format_spread(scores: Sequence[float]) -> str:
    """Format the difference between the largest and the smallest score; nothing for one score, which has no spread."""
    return f"{max(scores) - min(scores):.2f}" if len(scores) > 1 else ""


def main() -> None:
    args = make_study_parser(
        __doc__, steps=2000, sets=["mipnerf360_bonsai", "gerrard_hall"], out=Path("runs/design")
    ).parse_args()
    print(markdown_table(("variant", "set", "PSNR", "spread", "SSIM", "Gaussians", "bytes", "steps/s"), []))
    for variant, choice in CHOICES_BY_VARIANT.items():
        if args.only and not any(part in variant for part in args.only):
            continue
        for name in args.sets:
            with train_models_with(**choice.model):
                rows = [
                    measure(
                        args.data,
                        name,
                        run_folder(args.out / str(args.steps), variant, name, seed),
                        replace(TrainConfig(steps=args.steps, seed=seed, budget_factor=1.0), **choice.training),
                        reuse=True,
                    )
                    for seed in range(args.seeds)
                ]
            scores = [row["psnr_paper"] for row in rows]
            mean = {
                key: statistics.fmean(row[key] for row in rows) for key in rows[0] if key != "set" and key != "preset"
            }
            cells = [f"{mean['psnr_paper']:.2f}", format_spread(scores), f"{mean['ssim_paper']:.3f}"]
            cells += [f"{mean['gaussians']:,.0f}", f"{mean['bytes_paper']:,.0f}", f"{mean['steps_per_second']:.1f}"]
            print(markdown_row([variant, name, *cells]), flush=True)


if __name__ == "__main__":
    run_command(main)
