"""Import 3D Gaussians (.ply, .splat, .spz, .sog) into a small `.hyrf` file, and draw both side by side.

python examples/import_and_compare.py scene.ply scene.hyrf compare.png
"""

import argparse
import logging

import numpy as np
import torch
from PIL import Image

import hyrfpack
from hyrfpack.cameras.capture import Capture
from hyrfpack.cameras.paths import orbit
from hyrfpack.splats.draw import Drawable, draw
from hyrfpack.splats.files import read_splats

COMPARED_VIEWS = 3


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("splats", help="a file of 3D Gaussians")
    parser.add_argument("model", help="the .hyrf file to write")
    parser.add_argument("picture", help="the picture to write: Gaussians on the left, model on the right")
    parser.add_argument(
        "--size", type=int, default=hyrfpack.ImportConfig.size, help="size of the reference renders in pixels"
    )
    parser.add_argument("--psnr", type=float, default=hyrfpack.ImportConfig.psnr, help="target PSNR in dB")
    args = parser.parse_args()

    logging.basicConfig(level=logging.INFO, format="%(message)s")  # shows what the import does
    config = hyrfpack.ImportConfig(psnr=args.psnr, size=args.size)
    report = hyrfpack.import_splats(args.splats, args.model, config)
    print(f"{report.bytes_source:,} -> {report.bytes_after:,} bytes, {report.psnr:.1f} dB against the Gaussians")

    model = hyrfpack.load_model(args.model)
    original = Drawable.from_splats(read_splats(args.splats), model.config.frame)
    rows = []
    with torch.no_grad():
        for camera in orbit(Capture(hyrfpack.describe_file(args.model)).viewpoint, COMPARED_VIEWS):
            pair = draw(original, camera).rgb, hyrfpack.render_view(model, camera, background=False).rgb
            rows.append(np.concatenate([picture.clamp(0, 1).numpy() for picture in pair], axis=1))
    Image.fromarray((np.concatenate(rows) * 255).round().astype(np.uint8)).save(args.picture)
    print(f"{args.picture}: {COMPARED_VIEWS} views, the Gaussians on the left, the model on the right")


if __name__ == "__main__":
    main()
