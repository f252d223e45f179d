"""Does float32 cost quality? Trains the same run in float32 and in float64, whole and in parts.

    python -m tools.studies.precision                        two sets, 1,000 steps (an hour: the reference is slow)
    python -m tools.studies.precision --only nudged          some rows

Rows, all of one seed:

    float32        the product
    nudged N       the product, its first positions moved by one part in ten million: what rounding alone can do
    mixed          decoders multiply factors rounded to bfloat16, as GPU kernels do by default (here the reference does)
    adam           parameters and Adam's moments in float64, operations in float32
    rasterizer     rasterising (accumulation front to back, gradient sums of each Gaussian) in float64
    float64        everything

A difference from `float32` counts only where it is larger than the spread of the nudged rows: training multiplies any
rounding until two runs differ as two seeds do. Scores are on held-out views, rendered by the product; those that
--out holds already are kept.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from unittest import mock

import torch
from torch import Tensor

import hyrfpack
from hyrfpack.evaluate import evaluate_model
from hyrfpack.model import HybridModel
from hyrfpack.ops.hash_encode import hash_encode
from hyrfpack.ops.mlp import mlp
from hyrfpack.ops.rasterize import Rasterization, rasterize
from hyrfpack.ops.ssim import photometric_loss
from hyrfpack.scene import Scene
from hyrfpack.train import TrainConfig
from hyrfpack.train.optimizer import Optimizer
from hyrfpack.train.trainer import Trainer
from tools.studies.train_sets import study_arguments

MLPS = ("hyrfpack.model.field.mlp", "hyrfpack.ops.background.reference.mlp")
# Where the product looks each operation up.
OPERATIONS = {
    "hyrfpack.render.renderer.rasterize": rasterize,
    "hyrfpack.model.hash_grid.hash_encode": hash_encode,
    "hyrfpack.ops.background.reference.hash_encode": hash_encode,
    **dict.fromkeys(MLPS, mlp),
    "hyrfpack.train.trainer.photometric_loss": photometric_loss,
}
RASTERIZE = "hyrfpack.render.renderer.rasterize"
ROWS = ("float32", *(f"nudged {n}" for n in range(1, 7)), "mixed", "adam", "rasterizer", "float64")
SETS = ("nerf_synthetic_lego", "indoor_room")
NUDGE = 1e-7


def computed_in(dtype: torch.dtype, operation: Callable) -> Callable:
    """The operation on inputs cast to `dtype`, its results cast back to what they were."""

    def cast(value: object, to: torch.dtype) -> object:
        if isinstance(value, list):
            return [cast(item, to) for item in value]
        return value.to(to) if isinstance(value, Tensor) and value.is_floating_point() else value

    def run(*args: object, absgrad: Tensor | None = None, **options: object) -> object:
        before = (args[0][0] if isinstance(args[0], list) else args[0]).dtype
        args = [cast(value, dtype) for value in args]
        if absgrad is not None:  # filled in backward, before the gradient of the means is there
            buffer = torch.zeros_like(absgrad, dtype=dtype)

            def fill(_: Tensor) -> None:
                absgrad.copy_(buffer)

            args[0].register_hook(fill)
            options["absgrad"] = buffer
        result = operation(*args, **options)
        if isinstance(result, Rasterization):
            return Rasterization(**{name: cast(value, before) for name, value in vars(result).items()})
        return cast(result, before)

    return run


def train(scene: Scene, config: TrainConfig, row: str) -> tuple[HybridModel, float]:
    """The model of one row, float32 whatever it was trained in, and the seconds it took."""
    trainer = Trainer(scene, config)
    patches = {}
    if row.startswith("nudged"):
        positions = trainer.model.gaussians.positions
        generator = torch.Generator().manual_seed(int(row.split()[1]))
        with torch.no_grad():
            positions.mul_(1 + NUDGE * torch.randn(positions.shape, generator=generator))
    if row in ("adam", "float64"):
        trainer.model.double()
        trainer.optimizer = Optimizer(trainer.model, config.learning_rates)
        dtype = torch.float32 if row == "adam" else torch.float64
        patches = {place: computed_in(dtype, operation) for place, operation in OPERATIONS.items()}
    elif row == "mixed":
        patches = dict.fromkeys(MLPS, lambda *layers, mixed: mlp(*layers, mixed=True, implementation="reference"))
    elif row == "rasterizer":
        patches = {RASTERIZE: computed_in(torch.float64, rasterize)}
    started = time.perf_counter()
    with ExitStack() as stack:
        for place, operation in patches.items():
            stack.enter_context(mock.patch(place, operation))
        trainer.run()
    return trainer.model.float(), time.perf_counter() - started


def main() -> None:
    args = study_arguments(__doc__, steps=1000, sets=SETS, out=Path("runs/precision"), seeds=False).parse_args()
    kept = args.out / "scores.json"
    scores = json.loads(kept.read_text()) if kept.exists() else {}
    print("| set | row | PSNR | against float32 | SSIM | Gaussians | seconds |\n|---|---|---|---|---|---|---|")
    for name in args.sets:
        scene = hyrfpack.load_scene(args.data / name)
        for row in (row for row in ROWS if any(part in row for part in args.only or ROWS)):
            key = f"{name}, {row}, {args.steps}"
            if key not in scores:
                model, seconds = train(scene, TrainConfig(steps=args.steps), row)
                found = evaluate_model(model, scene.test)
                scores[key] = {"psnr": found.psnr, "ssim": found.ssim, "gaussians": len(model), "seconds": seconds}
                args.out.mkdir(parents=True, exist_ok=True)
                kept.write_text(json.dumps(scores, indent=1))
            score, base = scores[key], scores.get(f"{name}, float32, {args.steps}", {}).get("psnr", float("nan"))
            print(
                f"| {name} | {row} | {score['psnr']:.3f} | {score['psnr'] - base:+.3f} | {score['ssim']:.4f} | "
                f"{score['gaussians']:,} | {score['seconds']:.0f} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
