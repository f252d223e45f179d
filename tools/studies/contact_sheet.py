"""The worst held-out view of each trained set as one picture: photo, render and error map, a row a set.

    python -m tools.studies.train_sets --steps 2000 --out runs/sets
    python -m tools.studies.contact_sheet runs/sets/* -o docs/images/worst-views.jpg

A run's folder is named after its set, or after a variant (`variants.py`). What is shown is the compact file as
decoded, at the exposure that `hyrfpack render` shows.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch
from PIL import Image

import hyrfpack
from hyrfpack.device import upload
from hyrfpack.evaluate.figures import draw_comparison
from hyrfpack.evaluate.metrics import to_8bit
from hyrfpack.render.files import save_picture
from hyrfpack.scene import Scene
from tools.studies.train_sets import DATA
from tools.studies.variants import load_variant

ROW_WIDTH = 720  # pixels


def worst_view(name: str, scene: Scene, model: hyrfpack.HybridModel) -> Image.Image:
    """Photo, render and error map of the held-out view with the lowest PSNR."""
    scores = hyrfpack.evaluate_model(model, scene.test)
    worst = min(scores.views, key=lambda view: view.psnr)
    (view,) = (view for view in scene.test if view.name == worst.name)
    photo, mask = upload(view.load(), np.array(model.config.solid, np.float32), torch.device("cpu"))
    render = to_8bit(hyrfpack.render_view(model, view.camera).rgb)
    caption = f"{name}: {worst.name}, {worst.psnr:.2f} dB, SSIM {worst.ssim:.3f} (mean {scores.psnr:.2f} dB)"
    return draw_comparison(photo, render, mask, caption)


def stacked(rows: list[Image.Image]) -> Image.Image:
    """Pictures below each other, all `ROW_WIDTH` wide."""
    small = [
        row.resize((ROW_WIDTH, round(row.height * ROW_WIDTH / row.width)), Image.Resampling.LANCZOS) for row in rows
    ]
    sheet = Image.new("RGB", (ROW_WIDTH, sum(row.height for row in small)), "white")
    top = 0
    for row in small:
        sheet.paste(row, (0, top))
        top += row.height
    return sheet


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", type=Path, help="folders with compact.hyrf, named after their sets")
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--data", type=Path, default=DATA, help="where the sets are")
    args = parser.parse_args()
    rows = []
    with torch.no_grad():
        for run in args.runs:
            if (run / "compact.hyrf").is_file():
                model = hyrfpack.load_model(run / "compact.hyrf")
                rows.append(worst_view(run.name, load_variant(args.data, run.name), model))
    if not rows:
        parser.error("none of the folders has a compact.hyrf; train them with tools.studies.train_sets")
    save_picture(args.output, stacked(rows))


if __name__ == "__main__":
    main()
