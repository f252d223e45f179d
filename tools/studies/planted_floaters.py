"""Measure how well `hyrfpack edit --remove-floaters` finds floaters that this program plants in trained models.

    python -m tools.studies.planted_floaters --runs runs/sets/2000 --shares 0.05 0.15

--runs has a folder for each data set, with one run: a `model.hyrf`. A share of the model's number of Gaussians is
planted, half of them near cameras (at 8 to 30 % of the median depth of a view), half in free space (at 30 to 80 % of
the depth at a pixel). Colours are random; scales and opacities are those of other Gaussians, changed by the fields at
the new place. Only those with an opacity above 0.2 and a scale that is usual in the model are planted.

The columns are: planted and removed Gaussians, recall (the share of the planted that is removed), precision (the share
of the removed that was planted), and PSNR in dB on held-out photos: of the model, with the floaters, and after they are
removed. A trained model has floaters of its own, which lower the precision. Rows with the share 0 have nothing planted.

The results are in docs/research/floaters.md.
"""

from __future__ import annotations

import numpy as np
import torch

import hyrfpack
from hyrfpack.config.edit import DEFAULT_MIN_OPACITY_SHARE
from hyrfpack.edit.floaters import find_floaters
from hyrfpack.edit.transform import replace_config
from hyrfpack.model import HybridModel
from hyrfpack.model.gaussians import Gaussians
from hyrfpack.scene import Camera, evenly_spaced
from tools.command import run_command
from tools.studies.trained_runs import load_runs, make_runs_parser
from tools.tables import markdown_row, markdown_table

PLANTING_VIEWS = 24
NEAR_DEPTHS, FREE_DEPTHS = (0.08, 0.3), (0.3, 0.8)
MIN_OPACITY = 0.2
SCALE_QUANTILES = (0.05, 0.995)
CANDIDATES_PER_FLOATER = 8
MIN_SURFACE_ALPHA = 0.5


def plant_floaters(
    model: HybridModel, cameras: list[Camera], share: float, seed: int
) -> tuple[HybridModel, np.ndarray]:
    """Return a model with floaters, and a mask of them.

    Args:
        model: the model, which stays as it is.
        cameras: cameras of the scene.
        share: number of floaters, as a share of the number of Gaussians.
        seed: random seed.
    """
    generator = np.random.default_rng(seed)
    count = round(share * len(model))
    candidates, is_near = _random_floaters(model, cameras, CANDIDATES_PER_FLOATER * count, generator)
    opacities, scales = _opacities_and_scales(candidates)
    low, high = np.quantile(_opacities_and_scales(model)[1], SCALE_QUANTILES)
    usable = (opacities > MIN_OPACITY) & (scales > low) & (scales < high)
    usable_halves = [np.flatnonzero(usable & kind) for kind in (is_near, ~is_near)]
    halves = [generator.choice(half, min(count // 2, len(half)), replace=False) for half in usable_halves]
    chosen = torch.from_numpy(np.concatenate(halves))
    parts = zip(_parameters(model), _parameters(candidates), strict=True)
    joined = [torch.cat((model_values, candidate_values[chosen])) for model_values, candidate_values in parts]
    planted = _with_gaussians(model, joined)
    return planted, np.arange(len(planted)) >= len(model)


def _random_floaters(
    model: HybridModel, cameras: list[Camera], count: int, generator: np.random.Generator
) -> tuple[HybridModel, np.ndarray]:
    """Return a model with the fields of `model` and `count` random floaters, and a mask of those near cameras."""
    positions, near_masks = [], []
    viewpoints = evenly_spaced(cameras, PLANTING_VIEWS)
    for part, camera in zip(np.array_split(np.arange(count), len(viewpoints)), viewpoints, strict=True):
        with torch.no_grad():
            rendering = hyrfpack.render_view(model, camera, depth=True)
        depth, covered = rendering.depth.numpy(), rendering.alpha.numpy() > MIN_SURFACE_ALPHA
        median = float(np.median(depth[covered])) if covered.any() else model.config.frame.scale
        x, y = generator.uniform(0, camera.width, len(part)), generator.uniform(0, camera.height, len(part))
        pixel = y.astype(np.int64), x.astype(np.int64)
        free = np.where(covered[pixel], depth[pixel], median) * generator.uniform(*FREE_DEPTHS, len(part))
        is_near = np.arange(len(part)) < len(part) // 2
        z = np.where(is_near, median * generator.uniform(*NEAR_DEPTHS, len(part)), free)
        positions.append(camera.unproject(x, y, z))
        near_masks.append(is_near)
    frame = model.config.frame
    placed = (np.concatenate(positions) - np.array(frame.center)) / frame.scale
    colors = generator.normal(0, 1.5, (len(placed), 3))
    donors = torch.from_numpy(generator.integers(0, len(model), len(placed)))
    shapes = [logits[donors] for logits in _parameters(model)[2:]]
    parameters = [torch.from_numpy(placed).float(), torch.from_numpy(colors).float(), *shapes]
    return _with_gaussians(model, parameters), np.concatenate(near_masks)


def _parameters(model: HybridModel) -> list[torch.Tensor]:
    return [getattr(model.gaussians, name).detach() for name in Gaussians.PARAMETER_NAMES]


def _opacities_and_scales(model: HybridModel) -> tuple[np.ndarray, np.ndarray]:
    """Return the opacities (N,) and the longest standard deviations (N,) in local units."""
    geometry = model.decode_geometry()
    return geometry.opacities.numpy(), geometry.scales.amax(dim=1).numpy()


def _with_gaussians(model: HybridModel, parameters: list[torch.Tensor]) -> HybridModel:
    """Return a model with other Gaussians and the same fields, without the sampling of its photos."""
    changed = replace_config(model)
    changed.gaussians = Gaussians(*parameters)
    changed.precision = None
    return changed.requires_grad_(False)


def main() -> None:
    parser = make_runs_parser(__doc__ or "")
    parser.add_argument("--sets", nargs="*", help="data sets (all below --runs)")
    parser.add_argument("--shares", type=float, nargs="+", default=[0, 0.05, 0.15], help="shares of planted Gaussians")
    parser.add_argument(
        "--min-opacity-share",
        type=float,
        default=DEFAULT_MIN_OPACITY_SHARE,
        help=f"as in hyrfpack edit --remove-floaters ({DEFAULT_MIN_OPACITY_SHARE})",
    )
    parser.add_argument("--seed", type=int, default=0, help="random seed (0)")
    arguments = parser.parse_args()
    rows = []
    for name, model_file, scene in load_runs(arguments.runs, arguments.data, arguments.sets):
        model = hyrfpack.load_model(model_file).requires_grad_(False)
        cameras = [view.camera for view in scene.train]
        psnr = hyrfpack.evaluate_model(_with_gaussians(model, _parameters(model)), scene.test).psnr
        for share in arguments.shares:
            planted, is_planted = plant_floaters(model, cameras, share, arguments.seed)
            removed = find_floaters(planted, scene.train, arguments.min_opacity_share)
            cleaned = planted.subset(torch.from_numpy(np.flatnonzero(~removed)))
            hit_count = int((removed & is_planted).sum())
            scores = [hyrfpack.evaluate_model(scored_model, scene.test).psnr for scored_model in (planted, cleaned)]
            ratios = [hit_count / max(1, int(total)) for total in (is_planted.sum(), removed.sum())]
            ratio_cells = [f"{ratio:.3f}" if share else "" for ratio in ratios]
            counts = [f"{int(mask.sum()):,}" for mask in (is_planted, removed)]
            row = [name, f"{len(model):,}", *counts, *ratio_cells, *(f"{score:.2f}" for score in (psnr, *scores))]
            rows.append(row)
            print(markdown_row(row), flush=True)
    header = ["set", "Gaussians", "planted", "removed", "recall", "precision", "dB", "dB planted", "dB removed"]
    print(markdown_table(header, rows))


if __name__ == "__main__":
    run_command(main)
