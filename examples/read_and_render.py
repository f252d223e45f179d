"""A `.hyrf` file to pictures around the scene. Needs torch, numpy and Pillow; no training code is loaded.

python examples/read_and_render.py bonsai.hyrf frames --frames 24
"""

import argparse
from pathlib import Path

import numpy as np
import torch
from PIL import Image

import hyrfpack


def turned(camera: hyrfpack.Camera, center: np.ndarray, up: np.ndarray, degrees: float) -> hyrfpack.Camera:
    """The camera after a turn of all that it sees about an axis `up` (3,), unit length, through `center` (3,)."""
    angle = np.radians(degrees)
    cross = np.array([[0, -up[2], up[1]], [up[2], 0, -up[0]], [-up[1], up[0], 0]])
    turn = np.eye(4)
    turn[:3, :3] = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross  # Rodrigues
    turn[:3, 3] = center - turn[:3, :3] @ center
    pose = camera.camera_from_world @ turn
    return hyrfpack.Camera(camera.width, camera.height, *camera.intrinsics, pose)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model", help="a .hyrf file")
    parser.add_argument("out", type=Path, help="a folder for the pictures")
    parser.add_argument("--frames", type=int, default=24)
    args = parser.parse_args()

    view = hyrfpack.describe(args.model)["provenance"]["viewpoint"]  # what training says of how it was photographed
    first = hyrfpack.Camera(view["width"], view["height"], *view["intrinsics"], np.array(view["camera_from_world"]))
    model = hyrfpack.load(args.model)
    args.out.mkdir(parents=True, exist_ok=True)
    with torch.no_grad():
        decoded = model.decode()  # the same from everywhere: once for all frames
        for number in range(args.frames):
            camera = turned(first, np.array(view["center"]), np.array(view["up"]), 360 * number / args.frames)
            rgb = hyrfpack.render(model, camera, decoded=decoded).rgb
            Image.fromarray((rgb.clamp(0, 1) * 255).round().byte().numpy()).save(args.out / f"{number:04d}.png")
    print(f"{args.out}: {args.frames} pictures of {len(model):,} Gaussians")


if __name__ == "__main__":
    main()
