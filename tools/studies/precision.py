"""Measure whether float32 costs quality: train the same run in float32 and in float64, in whole and in parts.

    python -m tools.studies.precision                        two sets, 1,000 steps (an hour: the reference is slow)
    python -m tools.studies.precision --only nudged          some rows

Rows, all of one seed:

    float32        hyrfpack's training
    nudged N       the same with the first positions changed by 1e-7, to show the effect of rounding alone
    mixed          decoders round factors to bfloat16, as GPU kernels do by default (here the reference does it)
    adam           parameters and Adam's moments in float64, operations in float32
    rasterizer     rasterising (front-to-back accumulation, gradient sums of each Gaussian) in float64
    float64        everything in float64

A difference from `float32` is significant only if it is larger than the spread of the nudged rows. Training amplifies
any rounding until two runs differ as much as two seeds. The table has PSNR in dB and SSIM on held-out views, the number
of Gaussians and seconds. Scores of this version that --out already has are not measured again. The row `float32` is
always there, because all others are compared with it.

The results are in docs/explanation/numerics.md and training.md.
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
from hyrfpack.config.train import FIELD_WARMUP_STEPS
from hyrfpack.evaluate import evaluate_model
from hyrfpack.model import HybridModel
from hyrfpack.ops.hash_encode import hash_encode
from hyrfpack.ops.mlp import mlp
from hyrfpack.ops.rasterize import Gaussians3D, Rasterization, rasterize
from hyrfpack.ops.ssim import photometric_loss
from hyrfpack.scene import Scene
from hyrfpack.train import TrainConfig
from hyrfpack.train.optimizer import Optimizer
from hyrfpack.train.trainer import Trainer
from tools.command import run_command
from tools.json_files import write_json
from tools.studies.reuse import describe_origin
from tools.studies.train_sets import make_study_parser
from tools.tables import markdown_row, markdown_table

MLP_LOOKUPS = ("hyrfpack.model.field.mlp", "hyrfpack.ops.background.reference.mlp")
# The module attribute through which hyrfpack calls each operation.
OPERATION_BY_LOOKUP = {
    "hyrfpack.render.renderer.rasterize": rasterize,
    "hyrfpack.model.hash_grid.hash_encode": hash_encode,
    "hyrfpack.ops.background.reference.hash_encode": hash_encode,
    **dict.fromkeys(MLP_LOOKUPS, mlp),
    "hyrfpack.train.gradients.photometric_loss": photometric_loss,
}
RASTERIZE_LOOKUP = "hyrfpack.render.renderer.rasterize"
BASELINE_ROW = "float32"
ALL_ROWS = (BASELINE_ROW, *(f"nudged {n}" for n in range(1, 7)), "mixed", "adam", "rasterizer", "float64")
DEFAULT_SETS = ("nerf_synthetic_lego", "indoor_room")
NUDGE_STD = 1e-7


def run_in_dtype(dtype: torch.dtype, operation: Callable) -> Callable:
    """Return the operation with inputs cast to `dtype` and results cast back to the inputs' dtype."""

    def cast(value: object, to: torch.dtype) -> object:
        if isinstance(value, Gaussians3D):
            return Gaussians3D(*(cast(tensor, to) for tensor in value))
        if isinstance(value, list):
            return [cast(item, to) for item in value]
        return value.to(to) if isinstance(value, Tensor) and value.is_floating_point() else value

    def run(*args: object, absgrad: Tensor | None = None, **options: object) -> object:
        input_dtype = (args[0] if isinstance(args[0], Tensor) else args[0][0]).dtype
        args = [cast(value, dtype) for value in args]
        if absgrad is not None:  # the backward pass fills it before the gradient of the means is ready
            buffer = torch.zeros_like(absgrad, dtype=dtype)

            def fill(_: Tensor) -> None:
                absgrad.copy_(buffer)

            args[0].means.register_hook(fill)
            options["absgrad"] = buffer
        result = operation(*args, **options)
        if isinstance(result, Rasterization):
            return Rasterization(**{name: cast(value, input_dtype) for name, value in vars(result).items()})
        return cast(result, input_dtype)

    return run


def train_row(scene: Scene, config: TrainConfig, row: str) -> tuple[HybridModel, float]:
    """Train the model of one row; return it in float32, and the seconds of training."""
    trainer = Trainer(scene, config)
    patches = {}
    if row.startswith("nudged"):
        positions = trainer.model.gaussians.positions
        generator = torch.Generator().manual_seed(int(row.split()[1]))
        with torch.no_grad():
            positions.mul_(1 + NUDGE_STD * torch.randn(positions.shape, generator=generator))
    if row in ("adam", "float64"):
        trainer.model.double()
        trainer.optimizer = Optimizer(trainer.model, trainer.learning_rates, warmup_steps=FIELD_WARMUP_STEPS)
        dtype = torch.float32 if row == "adam" else torch.float64
        patches = {lookup: run_in_dtype(dtype, operation) for lookup, operation in OPERATION_BY_LOOKUP.items()}
    elif row == "mixed":
        patches = dict.fromkeys(MLP_LOOKUPS, lambda *layers, **_: mlp(*layers, mixed=True, implementation="reference"))
    elif row == "rasterizer":
        patches = {RASTERIZE_LOOKUP: run_in_dtype(torch.float64, rasterize)}
    started = time.perf_counter()
    with ExitStack() as stack:
        for lookup, operation in patches.items():
            stack.enter_context(mock.patch(lookup, operation))
        trainer.run()
    return trainer.model.float(), time.perf_counter() - started


def main() -> None:
    args = make_study_parser(
        __doc__, steps=1000, sets=DEFAULT_SETS, out=Path("runs/precision"), seeds=False
    ).parse_args()
    scores_file = args.out / "scores.json"
    scores = json.loads(scores_file.read_text()) if scores_file.exists() else {}
    print(markdown_table(("set", "row", "PSNR", "against float32", "SSIM", "Gaussians", "seconds"), []), flush=True)
    for name in args.sets:
        scene = hyrfpack.load_scene(args.data / name)
        origin = describe_origin(args.data / name, steps=args.steps)
        for row in (row for row in ALL_ROWS if row == BASELINE_ROW or any(word in row for word in args.only or [""])):
            key = f"{name}, {row}, {args.steps}"
            if scores.get(key, {}).get("origin") != origin:
                model, seconds = train_row(scene, TrainConfig(steps=args.steps), row)
                evaluation = evaluate_model(model, scene.test)
                scores[key] = {
                    "psnr": evaluation.psnr,
                    "ssim": evaluation.ssim,
                    "gaussians": len(model),
                    "seconds": seconds,
                }
                scores[key]["origin"] = origin
                write_json(scores_file, scores)
            score, base = scores[key], scores[f"{name}, {BASELINE_ROW}, {args.steps}"]["psnr"]
            cells = [name, row, f"{score['psnr']:.3f}", f"{score['psnr'] - base:+.3f}", f"{score['ssim']:.4f}"]
            print(markdown_row([*cells, f"{score['gaussians']:,}", f"{score['seconds']:.0f}"]), flush=True)


if __name__ == "__main__":
    run_command(main)
