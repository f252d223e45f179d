"""Run the ablation behind each default for which the HyRF paper and its authors' code disagree.

    python -m tools.studies.design_choices --steps 2000        prints the table of docs/research/paper-and-code.md

Each row changes one setting of the default and is the mean over the seeds: PSNR in dB, its spread between seeds, SSIM,
number of Gaussians, bytes and training steps per second. Scores are those of the decoded `paper` file on held-out
views. A difference between rows is significant only if it is larger than the spread.
"""

from __future__ import annotations

import statistics
from dataclasses import replace
from pathlib import Path

from hyrfpack.train import TrainConfig
from tools.studies.train_sets import make_study_parser, measure
from tools.tables import markdown_row, markdown_table

CHANGED_SETTINGS: dict[str, dict] = {
    "default": {},
    "scale S sigma(s_n) sigma(s_e), as the authors' code": {"scale_rule": "product"},
    "S(p) constant": {"scale_grows": False},
    "direction by spherical harmonics, as the authors' code": {"direction_encoding": "sh"},
    "grids from 64 to 1024, as both": {"grid_resolutions": (64, 1024)},
    "fields pass gradients to positions": {"position_gradients": True},
    "no background sphere": {"background": False},
    "antialiased": {"antialiased": True},
}


def main() -> None:
    args = make_study_parser(
        __doc__, steps=2000, sets=["mipnerf360_bonsai", "gerrard_hall"], out=Path("runs/design")
    ).parse_args()
    print(markdown_table(("variant", "set", "PSNR", "spread", "SSIM", "Gaussians", "bytes", "steps/s"), []))
    for number, (variant, changes) in enumerate(CHANGED_SETTINGS.items()):
        if args.only and not any(part in variant for part in args.only):
            continue
        for name in args.sets:
            rows = [
                measure(
                    args.data,
                    name,
                    args.out / str(args.steps) / f"{number}-{name}-{seed}",
                    replace(TrainConfig(steps=args.steps, seed=seed, budget_factor=1.0), **changes),
                    reuse=True,
                )
                for seed in range(args.seeds)
            ]
            scores = [row["psnr_paper"] for row in rows]
            mean = {
                key: statistics.fmean(row[key] for row in rows) for key in rows[0] if key != "set" and key != "preset"
            }
            cells = [f"{mean['psnr_paper']:.2f}", f"{max(scores) - min(scores):.2f}", f"{mean['ssim_paper']:.3f}"]
            cells += [f"{mean['gaussians']:,.0f}", f"{mean['bytes_paper']:,.0f}", f"{mean['steps_per_second']:.1f}"]
            print(markdown_row([variant, name, *cells]), flush=True)


if __name__ == "__main__":
    main()
