"""Makes a large model of a small scene, for measurements of size and speed: trains, splits to a number, settles.

    python -m tools.studies.densify_model --data ../shared/data/mipnerf360_bonsai --gaussians 1000000 --out runs/million
    python -m tools.studies.densify_model --data ../shared/data/ngp_fox --model fox.hyrf \\
        --gaussians 200000 --out runs/fox

Photos of few pixels never make density control ask for a million Gaussians. Here it is told to split regardless: in
each round the Gaussians with the largest gradients are replaced by two children drawn from them, with training steps
between, until there are enough. Then training settles without it, so that all numbers are trained ones again. --out
gets `model.hyrf` (profile raw). Prints PSNR on held-out views before splitting, after it and after settling.
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
from hyrfpack.scene import Scene
from hyrfpack.train import DensityConfig, TrainConfig, Trainer
from hyrfpack.train.progress import ProgressLine

# A round can at most double the number, and splits no Gaussian that none of the views since the last round has seen.
ROUNDS, STEPS_BETWEEN = 20, 6
GROWING = ROUNDS * STEPS_BETWEEN


def densifying_config(gaussians: int, settle: int, seed: int) -> TrainConfig:
    """A run of GROWING steps with a round of density control after every STEPS_BETWEEN, and `settle` more without.

    Every Gaussian counts as large enough to split, and any gradient as reason enough. None is cloned, for copies at
    one place would be coded for less than trained ones.
    """
    steps = GROWING + settle
    density = DensityConfig(
        start=STEPS_BETWEEN / steps,
        stop=GROWING / steps,
        peak=GROWING / steps,
        excess=1.0,
        rounds=ROUNDS - 1,
        gradient=0.0,
        split_scale=0.0,
    )
    return TrainConfig(steps=steps, seed=seed, max_gaussians=gaussians, density=density)


def report(label: str, model: HybridModel, scene: Scene, start: float) -> None:
    """Print one line: Gaussians, PSNR on held-out views, seconds since `start`."""
    psnr = f"{hyrfpack.evaluate_model(model, scene.test).psnr:.2f} dB" if scene.test else "no held-out views"
    print(f"{label:>16}: {len(model):>9,} Gaussians, {psnr}, {time.perf_counter() - start:.0f} s", flush=True)


def densify(scene: Scene, model: HybridModel, config: TrainConfig, start: float) -> HybridModel:
    """Split and settle; returns the model, and prints a line after each of the two."""
    trainer = Trainer(scene, config, model=model)
    with ProgressLine(config.steps, 0) as line:

        def after_step(trainer: Trainer, loss: float, mse: float) -> None:
            line.update(trainer.step, loss, mse, len(trainer.model))
            if trainer.step == GROWING:
                report("after splitting", trainer.model, scene, start)

        trainer.run(report=after_step)
    report("after settling", trainer.model, scene, start)
    return trainer.model


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help="folder of the scene's photos")
    parser.add_argument("--gaussians", type=int, default=1_000_000, help="how many to end with (1,000,000)")
    parser.add_argument("--log2-table-size", type=int, default=17, help="of the radiance grid; geometry has half (17)")
    parser.add_argument("--model", type=Path, help="start from this model of the scene instead of training one")
    parser.add_argument("--steps", type=int, default=1500, help="of training before splitting (1,500)")
    parser.add_argument("--settle", type=int, default=60, help="steps after splitting (60)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, required=True)
    args = parser.parse_args()

    start = time.perf_counter()
    make_folder(args.out)
    check_writable(args.out)
    scene = hyrfpack.load_scene(args.data)
    source = args.model
    if source is None:
        first = TrainConfig(steps=args.steps, seed=args.seed, log2_table_size=args.log2_table_size)
        source = hyrfpack.train_model(scene, args.out / "trained", first, overwrite=True).model
        if source is None:  # interrupted
            return
    model = hyrfpack.load_model(source)
    tables = (model.config.radiance.log2_table_size, model.config.geometry.log2_table_size)
    if tables != (args.log2_table_size, max(4, args.log2_table_size - 1)):
        parser.error(f"{source}: its tables are 2^{tables[0]} and 2^{tables[1]}; name that as --log2-table-size")
    if len(model) >= args.gaussians:
        parser.error(f"{source}: it has {len(model):,} Gaussians already; ask for more than that with --gaussians")

    report("before splitting", model, scene, start)
    trained = len(model)
    model = densify(scene, model, densifying_config(args.gaussians, args.settle, args.seed), start)
    if len(model) < args.gaussians:
        print(f"{args.gaussians:,} Gaussians were asked for; start from a model that has more than {trained:,}")
    provenance = hyrfpack.describe_file(source)["provenance"]
    provenance["choices"] = {
        **provenance.get("choices", {}),
        "max_gaussians": f"{args.gaussians:,}: trained to {trained:,}, split by tools/studies/densify_model.py "
        f"in {GROWING} steps (seed {args.seed}), settled in {args.settle}",
    }
    provenance["viewpoint"] = Viewpoint.from_cameras([view.camera for view in scene.train]).to_json()
    written = hyrfpack.save_model(model, args.out / MODEL_FILE, profile="raw", provenance=provenance)
    print(f"{args.out / MODEL_FILE}: {written.bytes_after:,} bytes")


if __name__ == "__main__":
    main()
