"""A `.hyrf` file to pictures around the scene. Needs torch, numpy and Pillow; no training code is loaded.

python examples/read_and_render.py bonsai.hyrf frames --frames 24
"""

import argparse
from pathlib import Path

import torch
from PIL import Image

import hyrfpack
from hyrfpack.cameras.capture import Capture
from hyrfpack.cameras.paths import orbit


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model", help="a .hyrf file")
    parser.add_argument("out", type=Path, help="a folder for the pictures")
    parser.add_argument("--frames", type=int, default=24)
    args = parser.parse_args()

    cameras = orbit(Capture(hyrfpack.describe_file(args.model)).viewpoint, args.frames)
    model = hyrfpack.load_model(args.model)
    args.out.mkdir(parents=True, exist_ok=True)
    with torch.no_grad():
        decoded = model.decode()  # the same from everywhere: once for all frames
        for number, camera in enumerate(cameras):
            rgb = hyrfpack.render_view(model, camera, decoded=decoded).rgb
            Image.fromarray((rgb.clamp(0, 1) * 255).round().byte().numpy()).save(args.out / f"{number:04d}.png")
    print(f"{args.out}: {len(cameras)} pictures of {len(model):,} Gaussians")


if __name__ == "__main__":
    main()
