"""Draw the worst held-out view of each trained data set into one picture: photo, render and error map in one row.

    python -m tools.studies.train_sets --steps 2000 --out runs/sets
    python -m tools.studies.contact_sheet runs/sets/* -o docs/images/worst-views.jpg

A run's folder has the name of its data set, or of a variant (`set_variants.py`). The render is that of the decoded
compact file, at the exposure of `hyrfpack render`.

The picture is in docs/research/quality.md.
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
from tools.command import run_command
from tools.studies.set_variants import load_variant
from tools.studies.train_sets import DATA_FOLDER

ROW_WIDTH_PX = 720


def draw_worst_view(name: str, scene: Scene, model: hyrfpack.HybridModel) -> Image.Image:
    """Draw photo, render and error map of the held-out view with the lowest PSNR."""
    scores = hyrfpack.evaluate_model(model, scene.test)
    worst = min(scores.views, key=lambda view: view.psnr)
    (view,) = (view for view in scene.test if view.name == worst.name)
    photo, mask = upload(view.load(), np.array(model.config.solid, np.float32), torch.device("cpu"))
    render = to_8bit(hyrfpack.render_view(model, view.camera).rgb)
    caption = f"{name}: {worst.name}, {worst.psnr:.2f} dB, SSIM {worst.ssim:.3f} (mean {scores.psnr:.2f} dB)"
    return draw_comparison(photo, render, mask, caption)


def stack_pictures(rows: list[Image.Image]) -> Image.Image:
    """Stack pictures below each other, each scaled to a width of `ROW_WIDTH_PX`."""
    scaled_rows = [
        row.resize((ROW_WIDTH_PX, round(row.height * ROW_WIDTH_PX / row.width)), Image.Resampling.LANCZOS)
        for row in rows
    ]
    sheet = Image.new("RGB", (ROW_WIDTH_PX, sum(row.height for row in scaled_rows)), "white")
    top = 0
    for row in scaled_rows:
        sheet.paste(row, (0, top))
        top += row.height
    return sheet


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "runs", nargs="+", type=Path, help="folders of runs, with compact.hyrf and the name of a data set"
    )
    parser.add_argument("-o", "--output", type=Path, required=True, help="the picture")
    parser.add_argument("--data", type=Path, default=DATA_FOLDER, help="folder of the data sets")
    args = parser.parse_args()
    rows = []
    with torch.no_grad():
        for folder in args.runs:
            if (folder / "compact.hyrf").is_file():
                model = hyrfpack.load_model(folder / "compact.hyrf")
                rows.append(draw_worst_view(folder.name, load_variant(args.data, folder.name), model))
    if not rows:
        parser.error("none of the folders has a compact.hyrf; make the runs with tools.studies.train_sets")
    save_picture(args.output, stack_pictures(rows))


if __name__ == "__main__":
    run_command(main)
