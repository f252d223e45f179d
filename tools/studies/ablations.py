"""Run the HyRF paper's ablations on real data sets: measure what each part of the model contributes.

    python -m tools.studies.ablations            trains every variant and prints the tables
    python -m tools.studies.ablations --reuse    trains only variants that --out does not have yet

The first two tables, with the paper's differences, are in docs/research/ablations.md but for columns that count the
sets that lose and the training steps per second. One more table for each data set has all numbers: PSNR in dB, SSIM,
Gaussians, bytes, training steps per second and frames per second. Scores are those of the trained model before
compression on held-out views. Frames of a variant alternate with frames of the full model, and the geometry is decoded
beforehand. The numbers of each run are stored in --out as JSON.
"""

from __future__ import annotations

import json
import sys
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from itertools import product
from pathlib import Path
from statistics import fmean, median
from unittest.mock import patch

import torch

import hyrfpack
from hyrfpack.data import PictureCache
from hyrfpack.errors import HyrfTrainingError
from hyrfpack.format import encode_model, load_model, save_model
from hyrfpack.measure.timing import time_alternately
from hyrfpack.model import HybridModel
from hyrfpack.ops.rasterize import shaded
from hyrfpack.render import renderer
from hyrfpack.scene import Scene, View, evenly_spaced
from hyrfpack.train import TrainConfig
from hyrfpack.train.provenance import training_background_spacing
from tools.command import run_command
from tools.json_files import write_json
from tools.studies.ablation_models import FULL_VARIANT, NO_CULLING_VARIANT, TRAINED_VARIANTS, Variant, build_trainer
from tools.studies.reuse import describe_origin, remove_outdated
from tools.studies.train_sets import make_study_parser
from tools.tables import markdown_table

DEFAULT_SETS = ("mipnerf360_bonsai", "gerrard_hall", "drone_caliterra")
ALL_VARIANTS = (*TRAINED_VARIANTS, NO_CULLING_VARIANT)
TIMED_VIEWS, TIMING_REPEATS = 6, 5

Results = dict[tuple[str, str], list[dict]]  # (variant, set) -> a result for each seed


def train_and_measure(
    variant: Variant, scene: Scene, config: TrainConfig, full_path: Path, cache: PictureCache
) -> dict:
    """Train one variant and measure it; for NO_CULLING_VARIANT measure the full model without training.

    Args:
        variant: the variant.
        scene: the data set.
        config: settings of the training run.
        full_path: file of the full model of the same data set and seed; FULL_VARIANT writes it.
        cache: cache of the data set's pictures.

    Returns:
        The numbers of one row for JSON, or {"failed": reason} if training failed.
    """
    if variant is NO_CULLING_VARIANT:
        full = _load_full_model(full_path, scene).requires_grad_()  # then its size includes all parameters
        return measure(variant, full, full, scene)
    trainer = build_trainer(scene, config, variant, cache)
    try:
        with patch_culling(variant):
            trainer.run()
        if not all(parameter.isfinite().all() for parameter in trainer.model.parameters()):
            raise HyrfTrainingError("a parameter is not finite after the last step", fix="choose another seed")
    except HyrfTrainingError as error:
        return {"failed": str(error)}
    for name in variant.missing_logits:
        getattr(trainer.model.gaussians, name).requires_grad_(False)  # its size does not include them
    if variant is FULL_VARIANT:
        save_model(trainer.model, full_path)
    result = measure(variant, trainer.model, _load_full_model(full_path, scene), scene)
    return {**result, "steps_per_second": config.steps / trainer.elapsed, "seconds": trainer.elapsed}


def _load_full_model(path: Path, scene: Scene) -> HybridModel:
    """Load the full model. Its file has no cameras, without which it would draw the background at every pixel."""
    model = load_model(path)
    model.background_spacing = training_background_spacing(scene)
    return model


@torch.no_grad()
def measure(variant: Variant, model: HybridModel, full: HybridModel, scene: Scene) -> dict:
    """Measure scores on held-out views, sizes, and frames per second, also relative to the full model."""
    with patch_culling(variant):
        scores = hyrfpack.evaluate_model(model, scene.test)
    views = evenly_spaced(scene.test, TIMED_VIEWS)
    frames_per_second, frames_ratio = time_frames(variant, model, full, views)
    result = {
        "psnr": scores.psnr,
        "ssim": scores.ssim,
        "gaussians": len(model),
        "bytes": 4 * sum(parameter.numel() for parameter in model.parameters() if parameter.requires_grad),
        "bytes_paper": len(encode_model(model, "paper")) if variant.can_save else None,
        "frames_per_second": frames_per_second,
        "frames_ratio": frames_ratio,
    }
    if not variant.has_culling:
        _, result["frames_ratio_decoding"] = time_frames(variant, model, full, views, keep_geometry=False)
    return result


@torch.no_grad()
def time_frames(
    variant: Variant, model: HybridModel, full: HybridModel, views: list[View], keep_geometry: bool = True
) -> tuple[float, float]:
    """Return frames per second of a model, and their ratio to the full model's on the same views; medians over views.

    Args:
        variant: the variant of `model`.
        model: the model to time.
        full: the full model.
        views: the views to render.
        keep_geometry: whether geometry is decoded once for all views instead of once for each view.
    """
    decoded, decoded_full = (m.decode() if keep_geometry else None for m in (model, full))

    def draw(view: View) -> None:
        with patch_culling(variant):
            hyrfpack.render_view(model, view.camera, decoded=decoded)

    def draw_full(view: View) -> None:
        hyrfpack.render_view(full, view.camera, decoded=decoded_full)

    times = [
        time_alternately({"this": partial(draw, v), "full": partial(draw_full, v)}, TIMING_REPEATS)[0] for v in views
    ]
    return 1000 / median(t["this"].ms for t in times), median(t["full"].ms / t["this"].ms for t in times)


@contextmanager
def patch_culling(variant: Variant) -> Iterator[None]:
    """Enter the context in which a variant renders; without pre-culling, every Gaussian is decoded and projected."""
    with ExitStack() as stack:
        for module in () if variant.has_culling else (renderer, shaded):
            stack.enter_context(patch.object(module, "frustum_cull", lambda points, *_: torch.arange(len(points))))
        yield


# -- tables --------------------------------------------------------------------------------------------------------


def format_report(results: Results, sets: Sequence[str], variants: Sequence[Variant]) -> str:
    """Format the tables of docs/research/ablations.md; the results must include the full model."""
    others = [variant for variant in variants if variant is not FULL_VARIANT]
    parts = [format_quality_table(results, sets, others), format_cost_table(results, sets, others)]
    return "\n\n".join(parts + [f"`{name}`\n\n{format_details_table(results, name, variants)}" for name in sets])


def format_quality_table(results: Results, sets: Sequence[str], variants: Sequence[Variant]) -> str:
    """Format the change of PSNR in dB by each variant, beside the paper's."""
    columns = ("PSNR, dB", "paper", *(f"`{name}`" for name in sets), "mean", "sets that lose")
    full = [
        _format_mean_and_spread([r["psnr"] for r in results["full", name] if "failed" not in r], "") for name in sets
    ]
    rows = [("full", "24.07, 30.37", *full, "", "")]
    for variant in variants:
        cells, means = [], []
        for name in sets:
            pairs = _pair_results(results, variant, name)
            differences = [ours["psnr"] - full["psnr"] for ours, full in pairs]
            means += [fmean(differences)] if pairs else []
            failed = sum("failed" in result for result in results[variant.name, name])
            cells.append(
                _format_mean_and_spread(differences, "+") + (f" ({failed} did not train)" if failed and pairs else "")
            )
        paper = "" if variant.paper_psnr is None else f"{variant.paper_psnr:+.2f}"
        mean = f"{fmean(means):+.2f}" if means else ""
        rows.append((variant.name, paper, *cells, mean, f"{sum(m < 0 for m in means)} of {len(means)}"))
    return markdown_table(columns, rows)


def format_cost_table(results: Results, sets: Sequence[str], variants: Sequence[Variant]) -> str:
    """Format size and speed of each variant relative to the full model: means over data sets and seeds."""

    def ratio(variant: Variant, key: str, full_key: str | None = None) -> str:
        pairs = [pair for name in sets for pair in _pair_results(results, variant, name) if key in pair[0]]
        return f"{fmean(ours[key] / (full[full_key] if full_key else 1) for ours, full in pairs):.2f}" if pairs else ""

    columns = ("part of full", "size, paper", "size", "frames/s, paper", "frames/s", "steps/s")
    rows = []
    for variant in variants:
        frames = ratio(variant, "frames_ratio")
        if decoding := ratio(variant, "frames_ratio_decoding"):
            frames += f"; {decoding} with geometry decoded for each frame"
        size, speed = (f"{part:.2f}" if part else "" for part in (variant.paper_size, variant.paper_frames))
        steps = ratio(variant, "steps_per_second", "steps_per_second")
        rows.append((variant.name, size, ratio(variant, "bytes", "bytes"), speed, frames, steps))
    return markdown_table(columns, rows)


def format_details_table(results: Results, name: str, variants: Sequence[Variant]) -> str:
    """Format all numbers of one data set: means over seeds."""
    formats = {
        "psnr": ".2f",
        "ssim": ".3f",
        "gaussians": ",.0f",
        "bytes": ",.0f",
        "bytes_paper": ",.0f",
        "steps_per_second": ".1f",
        "frames_per_second": ".1f",
    }
    columns = ("", "PSNR", "SSIM", "Gaussians", "float32 bytes", "`paper` file", "steps/s", "frames/s")
    rows = []
    for variant in variants:
        trained = [result for result in results[variant.name, name] if "failed" not in result]
        values = {key: [r[key] for r in trained if r.get(key) is not None] for key in formats}
        cells = [format(fmean(values[key]), form) if values[key] else "" for key, form in formats.items()]
        rows.append((variant.name, *(cells if trained else ("did not train", *cells[1:]))))
    return markdown_table(columns, rows)


def _pair_results(results: Results, variant: Variant, name: str) -> list[tuple[dict, dict]]:
    """Return the results of the variant and of the full model for each seed with which both were trained."""
    both = zip(results[variant.name, name], results[FULL_VARIANT.name, name], strict=True)
    return [pair for pair in both if not any("failed" in result for result in pair)]


def _format_mean_and_spread(values: list[float], sign: str) -> str:
    """Format the mean over seeds, and half the difference between the largest and the smallest value."""
    return f"{fmean(values):{sign}.2f} ± {(max(values) - min(values)) / 2:.2f}" if values else "did not train"


def main() -> None:
    parser = make_study_parser(__doc__, steps=1000, sets=DEFAULT_SETS, out=Path("runs/ablations"))
    parser.add_argument("--reuse", action="store_true", help="do not repeat results of this version in --out")
    args = parser.parse_args()
    chosen = [
        v for v in ALL_VARIANTS if v is FULL_VARIANT or not args.only or any(part in v.name for part in args.only)
    ]
    out = args.out / str(args.steps)
    results: Results = defaultdict(list)
    for seed, name in product(range(args.seeds), args.sets):
        scene, cache = hyrfpack.load_scene(args.data / name), PictureCache()
        folder = out / f"{name}-{seed}"
        remove_outdated(folder, describe_origin(args.data / name, steps=args.steps, seed=seed))
        for variant in chosen:
            path = folder / f"{variant.name.replace(' ', '-')}.json"
            if not (args.reuse and path.exists()):
                config = TrainConfig(steps=args.steps, seed=seed)
                result = train_and_measure(variant, scene, config, folder / "full.hyrf", cache)
                write_json(path, result)
            result = json.loads(path.read_text())
            results[variant.name, name].append(result)
            summary = result.get("failed") or f"{result['psnr']:.2f} dB, {result.get('seconds', 0):.0f} s"
            print(f"{name}, seed {seed}, {variant.name}: {summary}", file=sys.stderr, flush=True)
            if variant is FULL_VARIANT and "failed" in result:
                sys.exit("the full model did not train, so the variants cannot be compared with it")
    print(format_report(results, args.sets, chosen))


if __name__ == "__main__":
    run_command(main)
