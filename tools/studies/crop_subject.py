"""Crop trained models to their subject, and measure bytes and the quality of the subject before and after.

    python -m tools.studies.crop_subject --runs runs/sets/2000 --crops mipnerf360_bonsai=0.35 ngp_fox=0.3

--runs has a folder for each data set, with one run: a `model.hyrf`. The subject is what lies in a sphere about the
point that the cameras look at; its radius is given as a share of the median distance from the cameras to that point.
The model and the cropped model are both compressed. PSNR in dB and SSIM are those of the files on held-out photos, over
the pixels whose surface lies in the sphere; the model before the crop decides which pixels these are.

The results are in docs/research/crops.md.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import hyrfpack
from hyrfpack.cameras.paths import Viewpoint
from hyrfpack.config.edit import CropSphere
from hyrfpack.data.masked_views import mask_view
from hyrfpack.evaluate import Evaluation
from hyrfpack.model import HybridModel
from hyrfpack.render import RenderSettings, render_view
from hyrfpack.render.surface import render_median_depth
from hyrfpack.scene import Camera, Scene, View
from tools.command import run_command
from tools.studies.trained_runs import load_runs, make_runs_parser
from tools.tables import markdown_row, markdown_table

MIN_PIXELS = 200  # Views that show less of the subject are left out.
TABLE_COLUMNS = (
    "set",
    "radius",
    "Gaussians",
    "bytes",
    "PSNR, SSIM",
    "Gaussians after",
    "bytes after",
    "PSNR, SSIM after",
)
QUIET = hyrfpack.RunContext(progress=None)


@dataclass(frozen=True)
class Sphere:
    """A sphere in world units."""

    center: np.ndarray
    radius: float

    def mask(self, model: HybridModel, camera: Camera) -> np.ndarray:
        """Return the pixels (H, W) bool whose surface, at the median depth, lies in the sphere."""
        depth = _median_depth(model, camera)
        x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
        points = camera.unproject(x.ravel(), y.ravel(), depth.ravel())
        distances = np.linalg.norm(points - self.center, axis=-1).reshape(depth.shape)
        return (depth > 0) & (distances <= self.radius)


def _median_depth(model: HybridModel, camera: Camera) -> np.ndarray:
    rendered = render_view(model, camera)
    index = rendered.indices[rendered.visible]
    return render_median_depth(model, camera, model.decode(), index, RenderSettings()).numpy()


def find_subject(cameras: list[Camera], share: float) -> Sphere:
    """Return the sphere about the point that the cameras look at."""
    center = np.array(Viewpoint.from_cameras(cameras).center)
    distances = np.linalg.norm(np.array([camera.position for camera in cameras]) - center, axis=1)
    return Sphere(center, share * float(np.median(distances)))


def mask_views(views: list[View], masks: list[np.ndarray]) -> list[View]:
    """Return the views that show enough of the subject, with its pixels as their mask."""
    pairs = [pair for pair in zip(views, masks, strict=True) if np.count_nonzero(pair[1]) >= MIN_PIXELS]
    return [mask_view(*pair) for pair in pairs]


def measure(model_file: Path, scene: Scene, share: float) -> list[str]:
    """Return the cells of one set, without its name and radius."""
    sphere = find_subject([view.camera for view in scene.train], share)
    with tempfile.TemporaryDirectory() as folder:
        cropped, before, after = (Path(folder) / f"{each}.hyrf" for each in ("cropped", "before", "after"))
        action = CropSphere(tuple(sphere.center.tolist()), sphere.radius)
        hyrfpack.edit_model(model_file, cropped, [action], context=QUIET)
        hyrfpack.compress_model(model_file, before, context=QUIET)
        hyrfpack.compress_model(cropped, after, context=QUIET)
        model = hyrfpack.load_model(before).requires_grad_(False)
        views = mask_views(scene.test, [sphere.mask(model, view.camera) for view in scene.test])
        cells: list[str] = []
        for path in (before, after):
            model = hyrfpack.load_model(path)
            scores = hyrfpack.evaluate_model(model, views)
            cells += [f"{len(model):,}", f"{path.stat().st_size:,}", _format_scores(scores)]
    return cells


def _format_scores(scores: Evaluation) -> str:
    return f"{scores.psnr:.2f}, {scores.ssim:.3f}"


def parse_crop(text: str) -> tuple[str, float]:
    """Return the set and the radius that a text such as "ngp_fox=0.3" gives; argparse reports other texts.

    Raises:
        ArgumentTypeError: the text has another form, or the radius is no positive number.
    """
    name, _, radius = text.partition("=")
    try:
        if name and 0 < float(radius) < float("inf"):
            return name, float(radius)
    except ValueError:
        pass
    raise argparse.ArgumentTypeError(f"'{text}' is not SET=RADIUS with a positive radius, such as ngp_fox=0.3")


def main() -> None:
    parser = make_runs_parser(__doc__ or "")
    parser.add_argument(
        "--crops",
        type=parse_crop,
        nargs="+",
        required=True,
        metavar="SET=RADIUS",
        help="data sets, with the radius of each subject over the median distance of the cameras",
    )
    arguments = parser.parse_args()
    shares = dict(arguments.crops)
    rows = []
    for name, model_file, scene in load_runs(arguments.runs, arguments.data, list(shares)):
        rows.append([name, f"{shares[name]:g}", *measure(model_file, scene, shares[name])])
        print(markdown_row(rows[-1]), flush=True)
    print(markdown_table(TABLE_COLUMNS, rows))


if __name__ == "__main__":
    run_command(main)
