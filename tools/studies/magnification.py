"""Score files in pictures twice as large as their photos, with and without the filter at the photos' resolution.

    python -m tools.studies.magnification --steps 1000

Each set is trained on its photos at half their size and compressed. The table has PSNR in dB and SSIM of the compact
file on held-out photos, at half the size and at the full one, which training has not seen. "One pixel" has the filter
of 0.3 px^2 alone and evaluates the background at every pixel; "photos" samples the scene no more finely than the photos
did, as `hyrfpack.render_view` does (docs/reference/format.md, 2.10). Runs are kept in --out, and those of this
version are not repeated.

The results are in docs/research/sampling.md.
"""

from __future__ import annotations

from pathlib import Path

import hyrfpack
from tools.command import run_command
from tools.studies.compare_versions import DEFAULT_SETS
from tools.studies.complete_run import train_completely
from tools.studies.reuse import describe_origin, remove_outdated
from tools.studies.train_sets import make_study_parser
from tools.tables import markdown_row, markdown_table

PHOTO_REDUCTION = 2


def remove_photo_sampling(model: hyrfpack.HybridModel) -> hyrfpack.HybridModel:
    """Forget how finely the photos sampled a model, and return the model."""
    model.gaussians.pixel_sizes = None
    model.background_spacing = 0.0
    return model


def measure(data: Path, steps: int, seed: int, out: Path) -> list[tuple[float, float]]:
    """Train, compress and score one set; return PSNR and SSIM of the four columns of the table."""
    photos = hyrfpack.load_scene(data)
    longest = max(max(view.camera.width, view.camera.height) for view in photos.views)
    reduced = hyrfpack.load_scene(data, max_size=longest // PHOTO_REDUCTION)
    packed = out / "compact.hyrf"
    remove_outdated(out, describe_origin(data, steps=steps, seed=seed))
    if not packed.exists():
        train_completely(reduced, out, hyrfpack.TrainConfig(steps=steps, seed=seed))
        hyrfpack.compress_model(out / "model.hyrf", packed)
    columns = []
    for scene in (reduced, photos):
        for model in (remove_photo_sampling(hyrfpack.load_model(packed)), hyrfpack.load_model(packed)):
            scores = hyrfpack.evaluate_model(model, scene.test)
            columns.append((scores.psnr, scores.ssim))
    return columns


def main() -> None:
    parser = make_study_parser(__doc__ or "", 1000, DEFAULT_SETS, Path("runs/magnification"), only=False)
    args = parser.parse_args()
    rows = []
    for name in args.sets:
        seeds = [
            measure((args.data / name).resolve(), args.steps, seed, args.out / str(args.steps) / name / str(seed))
            for seed in range(args.seeds)
        ]
        means = [
            [sum(values) / len(seeds) for values in zip(*column, strict=True)] for column in zip(*seeds, strict=True)
        ]
        rows.append([name, *(f"{psnr:.2f}, {ssim:.3f}" for psnr, ssim in means)])
        print(markdown_row(rows[-1]), flush=True)
    header = ["set", "half size, one pixel", "half size, photos", "full size, one pixel", "full size, photos"]
    print("\n" + markdown_table(header, rows))


if __name__ == "__main__":
    run_command(main)
