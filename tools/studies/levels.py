"""Split trained models into chunks with levels of detail, and compare predicted with measured errors of views.

    python -m tools.studies.levels --runs runs/sets/2000 --sets mipnerf360_bonsai kitti_street indoor_room

--runs has a folder for each data set, with one run: a `model.hyrf` and, beside it, its `compact.hyrf`, which is split.
The first table compares the finest level with the file: bytes, PSNR in dB of its renders against those of the file, and
PSNR of both on held-out photos. The second one draws views between the cameras, which levels were neither fitted nor
measured at, within budgets: the share of all Gaussians, the size of the pictures, the mean Gaussians in a view,
predicted and measured PSNR against the finest level, the largest difference of both in one view, and the PSNR of the
level of about as many Gaussians everywhere.

The results are in docs/research/levels.md.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

import hyrfpack
from hyrfpack.cameras.view_sampling import interpolate_views, resize_camera
from hyrfpack.config.split import SplitConfig
from hyrfpack.lod import LevelRenderer
from hyrfpack.measure.psnr import psnr_from_mse
from hyrfpack.model import HybridModel
from hyrfpack.scene import Camera, Scene, evenly_spaced
from tools.command import positive_integer, run_command
from tools.studies.trained_runs import load_runs, make_runs_parser
from tools.tables import markdown_row, markdown_table

COMPACT_FILE = "compact.hyrf"
BUDGETS = (0.1, 0.25, 0.5)
RESOLUTIONS = (1.0, 1 / 4)
MAX_COMPARED_VIEWS = 12
WALK_SEED = 77  # unlike the seeds of the views that `split_model` fits and measures at
FINEST_HEADER = (
    *("set", "Gaussians", "chunks", "bytes of the file", "bytes of the finest level", "bytes of all levels"),
    *("PSNR to the file", "photos, file", "photos, finest level"),
)
VIEWS_HEADER = ("set", "budget", "pictures", "Gaussians", "predicted", "measured", "largest difference", "one level")
QUIET = hyrfpack.RunContext(progress=None)


@torch.no_grad()
def render_all(model: HybridModel, cameras: Sequence[Camera]) -> list[torch.Tensor]:
    """Render the views of cameras; return their pictures (H, W, 3)."""
    return [hyrfpack.render_view(model, camera).rgb for camera in cameras]


def measure_errors(pictures: Sequence[torch.Tensor], others: Sequence[torch.Tensor]) -> list[float]:
    """Return the mean squared error of each picture."""
    return [float((a - b).square().mean()) for a, b in zip(pictures, others, strict=True)]


def mean_psnr(errors: Sequence[float]) -> float:
    """Return the mean PSNR in dB of pictures with these mean squared errors."""
    return float(np.mean([psnr_from_mse(error) for error in errors]))


def measure_finest(name: str, file: Path, folder: Path, scene: Scene, report: hyrfpack.SplitReport) -> list[str]:
    """Return the cells of a row of the first table."""
    model, finest = hyrfpack.load_model(file), hyrfpack.load_model(folder)
    cameras = [view.camera for view in evenly_spaced(scene.test, MAX_COMPARED_VIEWS)]
    psnr_to_model = mean_psnr(measure_errors(render_all(model, cameras), render_all(finest, cameras)))
    photos = [hyrfpack.evaluate_model(each, scene.test).psnr for each in (model, finest)]
    sizes = (report.bytes_source, report.bytes_finest, report.bytes)
    cells = [f"{size:,}" for size in sizes] + [f"{psnr_to_model:.1f}", *(f"{psnr:.3f}" for psnr in photos)]
    return [name, f"{report.gaussians:,}", str(report.chunks), *cells]


def measure_views(name: str, folder: Path, scene: Scene) -> list[list[str]]:
    """Return the rows of the second table."""
    levels, rows = hyrfpack.SceneFolder(folder), []
    cameras = evenly_spaced(interpolate_views([view.camera for view in scene.train], WALK_SEED), MAX_COMPARED_VIEWS)
    finest, chunks = levels.load(), levels.manifest.chunks
    uniform = [levels.load([level] * len(chunks)) for level in range(len(chunks[0].levels))]
    for share in RESOLUTIONS:
        views = [resize_camera(camera, share) for camera in cameras]
        targets = render_all(finest, views)
        by_level = [mean_psnr(measure_errors(targets, render_all(model, views))) for model in uniform[1:]]
        for budget in BUDGETS:
            renderer = LevelRenderer(levels, gaussians=round(budget * len(finest)))
            drawn = [renderer.load(view) for view in views]
            measured = measure_errors(
                targets, [render_all(model, [view])[0] for (model, _), view in zip(drawn, views, strict=True)]
            )
            pairs = [
                (psnr_from_mse(choice.predicted_mse), psnr_from_mse(error))
                for (_, choice), error in zip(drawn, measured, strict=True)
            ]
            count = np.mean([choice.gaussians for _, choice in drawn])
            nearest = max(level for level, model in enumerate(uniform) if len(model) >= 0.99 * budget * len(finest))
            alone = f"{by_level[nearest - 1]:.1f}" if nearest and budget == BUDGETS[1] else ""
            predicted, actual = np.mean(pairs, axis=0)
            worst = max((a - b for a, b in pairs), key=abs)
            rows.append(
                [
                    name,
                    f"{budget:.0%}",
                    f"{share:g}",
                    f"{count:,.0f}",
                    f"{predicted:.1f}",
                    f"{actual:.1f}",
                    f"{worst:+.1f}",
                    alone,
                ]
            )
            print(markdown_row(rows[-1]), flush=True)
    return rows


def main() -> None:
    parser = make_runs_parser(__doc__ or "")
    parser.add_argument("--sets", nargs="+", help="data sets; default: all below --runs")
    parser.add_argument(
        "--chunk-gaussians", type=positive_integer, default=2048, help="the most Gaussians of a chunk (2,048)"
    )
    arguments = parser.parse_args()
    finest_rows, view_rows = [], []
    for name, model_file, scene in load_runs(arguments.runs, arguments.data, arguments.sets):
        file = model_file.with_name(COMPACT_FILE)
        with tempfile.TemporaryDirectory() as temporary:
            folder = Path(temporary, name)
            report = hyrfpack.split_model(
                file, folder, SplitConfig(arguments.chunk_gaussians), data=scene, context=QUIET
            )
            finest_rows.append(measure_finest(name, file, folder, scene, report))
            print(markdown_row(finest_rows[-1]), report.level_bytes, flush=True)
            view_rows += measure_views(name, folder, scene)
    print(markdown_table(FINEST_HEADER, finest_rows))
    print(markdown_table(VIEWS_HEADER, view_rows))


if __name__ == "__main__":
    run_command(main)
