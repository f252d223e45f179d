"""Render pictures of a `.hyrf` file along an orbit. It needs torch, numpy and Pillow, and loads no training code.

A merged file of several models is rendered whole.

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
    parser.add_argument("out", type=Path, help="folder of the pictures")
    parser.add_argument("--frames", type=int, default=24, help="number of pictures (24)")
    args = parser.parse_args()

    cameras = orbit(Capture(hyrfpack.describe_file(args.model)).viewpoint, args.frames)
    model = hyrfpack.load_merged_model(args.model)  # a file of one model is read as a merged model of one part
    args.out.mkdir(parents=True, exist_ok=True)
    with torch.no_grad():
        decoded = model.decode()  # the geometry does not depend on the view, so it is decoded once for all frames
        for number, camera in enumerate(cameras):
            rgb = hyrfpack.render_view(model, camera, decoded=decoded).rgb
            Image.fromarray((rgb.clamp(0, 1) * 255).round().byte().numpy()).save(args.out / f"{number:04d}.png")
    print(f"{args.out}: {len(cameras)} pictures of {len(model):,} Gaussians")


if __name__ == "__main__":
    main()
