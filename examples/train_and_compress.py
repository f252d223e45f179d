"""Train a model on photos with poses, compress it, and print the size and the quality of both files.

python examples/train_and_compress.py photos/bonsai runs/bonsai --steps 3000
"""

import argparse
from pathlib import Path

import hyrfpack


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("photos", help="a folder of photos and poses: COLMAP, NeRF-synthetic, instant-ngp, nerfstudio")
    parser.add_argument("out", type=Path, help="folder of the training run")
    parser.add_argument("--steps", type=int, default=3000, help="training steps (3,000)")
    args = parser.parse_args()

    scene = hyrfpack.load_scene(args.photos)
    print(f"{len(scene.train)} photos to train on, {len(scene.test)} held out")
    trained = hyrfpack.train_model(scene, args.out, hyrfpack.TrainConfig(steps=args.steps), overwrite=True)
    if trained.model is None:
        raise SystemExit(f"interrupted after {trained.step} steps; continue with hyrfpack train --resume")

    small = args.out / "small.hyrf"
    hyrfpack.compress_model(trained.model, small, data=scene)
    for path in (trained.model, small):
        scores = hyrfpack.evaluate_model(hyrfpack.load_model(path), scene.test)
        size = hyrfpack.describe_file(path)["bytes"]
        print(f"{path}: {size:,} bytes, PSNR {scores.psnr:.2f} dB, SSIM {scores.ssim:.3f} on held-out photos")


if __name__ == "__main__":
    main()
