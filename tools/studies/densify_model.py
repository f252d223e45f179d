"""Make a model with many Gaussians from a small scene, for measurements of size and speed.

    python -m tools.studies.densify_model --data ../shared/data/mipnerf360_bonsai --gaussians 1000000 --out runs/million
    python -m tools.studies.densify_model --data ../shared/data/ngp_fox --model fox.hyrf \\
        --gaussians 200000 --out runs/fox

Density control never requests a million Gaussians on small photos, so this program forces it to split. It first trains
a model. Then in each round it replaces the Gaussians with the largest gradients by two children, with training steps in
between, until there are enough. Last, it trains without density control, so that all parameters are trained again. It
writes `model.hyrf` (profile raw) into --out, and prints number of Gaussians, PSNR in dB on held-out views and seconds:
before splitting, after splitting and at the end.

Its models are measured in docs/research/scaling.md, training-step.md, compression.md, import.md and mesh.md.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import hyrfpack
from hyrfpack.atomic import check_writable, make_folder
from hyrfpack.cameras.paths import Viewpoint
from hyrfpack.format.run_folder import MODEL_FILE
from hyrfpack.model import HybridModel
from hyrfpack.progress import StepEvent, open_display
from hyrfpack.scene import Scene
from hyrfpack.train import DensityConfig, TrainConfig, Trainer
from tools.command import positive_integer, run_command
from tools.studies.complete_run import train_completely

# A round can at most double the number, and it only splits Gaussians that were visible since the last round.
SPLIT_ROUNDS, STEPS_PER_ROUND = 20, 6
SPLIT_STEPS = SPLIT_ROUNDS * STEPS_PER_ROUND


def make_split_config(gaussians: int, final_steps: int, seed: int) -> TrainConfig:
    """Return a run of SPLIT_STEPS steps with a round every STEPS_PER_ROUND steps, then `final_steps` without rounds.

    All Gaussians are large enough to split, and any gradient suffices. None is cloned, because copies at one position
    would compress better than trained Gaussians.
    """
    steps = SPLIT_STEPS + final_steps
    density = DensityConfig(
        start=STEPS_PER_ROUND / steps,
        stop=SPLIT_STEPS / steps,
        peak=SPLIT_STEPS / steps,
        excess=1.0,
        rounds=SPLIT_ROUNDS - 1,
        gradient=0.0,
        split_scale=0.0,
    )
    return TrainConfig(steps=steps, seed=seed, max_gaussians=gaussians, density=density)


def print_scores(label: str, model: HybridModel, scene: Scene, start: float) -> None:
    """Print one line: number of Gaussians, PSNR on held-out views, seconds since `start`."""
    psnr = f"{hyrfpack.evaluate_model(model, scene.test).psnr:.2f} dB" if scene.test else "no held-out views"
    print(f"{label:>16}: {len(model):>9,} Gaussians, {psnr}, {time.perf_counter() - start:.0f} s", flush=True)


def densify(scene: Scene, model: HybridModel, config: TrainConfig, start: float) -> HybridModel:
    """Split the Gaussians, train further, and return the model; print one line after each phase."""
    trainer = Trainer(scene, config, model=model)
    with open_display() as progress:

        def after_step(event: StepEvent) -> None:
            progress(event)
            if event.step == SPLIT_STEPS:
                print_scores("after splitting", trainer.model, scene, start)

        trainer.run(progress=after_step)
    print_scores("after settling", trainer.model, scene, start)
    return trainer.model


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help="folder of the scene's photos")
    parser.add_argument(
        "--gaussians", type=positive_integer, default=1_000_000, help="number of Gaussians at the end (1,000,000)"
    )
    parser.add_argument(
        "--log2-table-size",
        type=int,
        default=17,
        help="size of the radiance grid's table; the geometry grid has half (17)",
    )
    parser.add_argument("--model", type=Path, help="start from this model of the scene instead of training one")
    parser.add_argument("--steps", type=positive_integer, default=1500, help="training steps before splitting (1,500)")
    parser.add_argument("--final-steps", type=int, default=60, help="training steps after splitting (60)")
    parser.add_argument("--seed", type=int, default=0, help="random seed (0)")
    parser.add_argument("--out", type=Path, required=True, help="folder for model.hyrf")
    args = parser.parse_args()

    start = time.perf_counter()
    make_folder(args.out)
    check_writable(args.out)
    scene = hyrfpack.load_scene(args.data)
    source = args.model
    if source is None:
        first = TrainConfig(steps=args.steps, seed=args.seed, log2_table_size=args.log2_table_size)
        source = train_completely(scene, args.out / "trained", first).model
    model = hyrfpack.load_model(source)
    tables = (model.config.radiance.log2_table_size, model.config.geometry.log2_table_size)
    if tables != (args.log2_table_size, max(4, args.log2_table_size - 1)):
        parser.error(
            f"{source}: its tables have 2^{tables[0]} and 2^{tables[1]} rows; set --log2-table-size {tables[0]}"
        )
    if len(model) >= args.gaussians:
        parser.error(f"{source}: it already has {len(model):,} Gaussians; set --gaussians to a larger number")

    print_scores("before splitting", model, scene, start)
    trained = len(model)
    model = densify(scene, model, make_split_config(args.gaussians, args.final_steps, args.seed), start)
    if len(model) < args.gaussians:
        print(f"the model has fewer than {args.gaussians:,} Gaussians; start from a model with more than {trained:,}")
    provenance = hyrfpack.describe_file(source)["provenance"]
    provenance["choices"] = {
        **provenance.get("choices", {}),
        "max_gaussians": f"{args.gaussians:,}: trained to {trained:,}, split by tools/studies/densify_model.py "
        f"in {SPLIT_STEPS} steps (seed {args.seed}), then {args.final_steps} steps without splitting",
    }
    provenance["viewpoint"] = Viewpoint.from_cameras([view.camera for view in scene.train]).to_json()
    report = hyrfpack.save_model(model, args.out / MODEL_FILE, profile="raw", provenance=provenance)
    print(f"{args.out / MODEL_FILE}: {report.bytes_after:,} bytes")


if __name__ == "__main__":
    run_command(main)
