"""Compare profile `compact` with `paper` on trained models: with defaults, at equal loss, and fine-tuned.

    python -m tools.studies.train_sets --steps 3000 --sets gerrard_hall        models in runs/sets/3000
    python -m tools.studies.compression --models runs/sets/3000 --finetune 1000 --matched

The table has one row for each data set below --models, with bytes and the losses of PSNR (dB) and SSIM on held-out
photos: of both profiles with their defaults; with --matched, of the smallest `compact` file that loses no more PSNR and
no more SSIM than `paper`; with --finetune, of a fine-tuned file. The last columns are the ratio of measured to
predicted error at held-out cameras, and seconds. Losses are relative to the trained model. If per-image gains were
learnt, a held-out photo has the exposure that the exposure map predicts for it.

The results are in docs/research/compression.md.
"""

from __future__ import annotations

import argparse
import dataclasses
import time
from pathlib import Path

import hyrfpack
from hyrfpack.compress.calibrate import calibrate
from hyrfpack.compress.distortion import DEFAULT_PSNR_DROP_DB, default_distortion
from hyrfpack.compress.packer import EncodedCandidate, Packer
from hyrfpack.compress.reference_renders import ReferenceRenders
from hyrfpack.compress.search import find_coarsest
from hyrfpack.compress.sensitivity import measure_sensitivity
from hyrfpack.format import decode_model, encode_model
from hyrfpack.format.codec import load_with_provenance, packed_provenance
from hyrfpack.model import HybridModel
from hyrfpack.scene import evenly_spaced
from tools.command import run_command
from tools.json_files import write_json
from tools.studies.train_sets import DATA_FOLDER, choose_names
from tools.tables import markdown_table

DISTORTION_RANGE = (1e-7, 1e-2)
MAX_HELD_OUT_CAMERAS = 12  # the predicted error is compared with the measured one at up to this many cameras


@dataclasses.dataclass(frozen=True)
class MeasuredFile:
    """A compressed file and its losses.

    Attributes:
        distortion: the target distortion; 0 for profile paper.
        bytes, gaussians: size of the file and its number of Gaussians.
        drop: loss of PSNR in dB, mean over held-out photos.
        ssim_drop: loss of SSIM, mean over held-out photos.
        seconds: duration of the compression.
        predicted_error: mean squared error against the model's own pictures, by the sensitivities.
        measured_error: the same at held-out cameras.
    """

    distortion: float
    bytes: int
    gaussians: int
    drop: float
    ssim_drop: float
    seconds: float
    predicted_error: float = 0.0
    measured_error: float = 0.0


class TrainedSet:
    """A trained data set with its model, sensitivities and reference renders."""

    def __init__(self, folder: Path, data: Path) -> None:
        self.name = folder.name
        self.scene = hyrfpack.load_scene(data)
        self.model, provenance = load_with_provenance(folder / "model.hyrf")
        self.provenance = packed_provenance(provenance, self.model)
        self.raw_scores = self.evaluate(self.model)
        self.held_out_renders = ReferenceRenders.from_views(
            [view.camera for view in evenly_spaced(self.scene.test, MAX_HELD_OUT_CAMERAS)], self.model
        )
        start = time.perf_counter()
        cameras = [view.camera for view in self.scene.train]
        self.sensitivity, self.reference_renders = (
            measure_sensitivity(self.model, cameras),
            ReferenceRenders.from_model(self.model, cameras),
        )
        self.sensitivity_seconds = time.perf_counter() - start

    def evaluate(self, model: HybridModel) -> tuple[float, float]:
        """Return PSNR and SSIM on the held-out photos."""
        scores = hyrfpack.evaluate_model(model, self.scene.test)
        return scores.psnr, scores.ssim

    def measure_file(
        self, data: bytes, distortion: float, start: float, candidate: EncodedCandidate | None = None
    ) -> MeasuredFile:
        """Decode a compressed file and measure its losses; `start` is when its compression started."""
        seconds = time.perf_counter() - start
        model = decode_model(data)
        psnr, ssim = self.evaluate(model)
        predicted_error = sum(candidate.predicted_errors.values()) if candidate else 0.0
        losses = self.raw_scores[0] - psnr, self.raw_scores[1] - ssim
        return MeasuredFile(
            distortion,
            len(data),
            len(model),
            *losses,
            seconds,
            predicted_error,
            self.held_out_renders.measure_error(model),
        )

    def compress_paper(self) -> MeasuredFile:
        """Compress the model in profile paper and measure the file."""
        start = time.perf_counter()
        return self.measure_file(encode_model(self.model, "paper", self.provenance), 0, start)

    def compress_compact(self, distortion: float, steps: int = 0, target_drop: float | None = None) -> MeasuredFile:
        """Compress the model in profile compact as `hyrfpack compress` does, and measure the file.

        `target_drop` limits the loss on training photos, in dB, as the command does unless --distortion is given.
        """
        start = time.perf_counter()
        sensitivity = calibrate(self.model, self.sensitivity, self.reference_renders, distortion)
        packer = Packer(self.model, self.provenance, sensitivity, self.scene, steps)
        candidate = (
            packer.encode(distortion)
            if steps
            else packer.encode_to_distortion(distortion, self.reference_renders, target_drop)
        )
        return self.measure_file(candidate.data, distortion, start, candidate)

    def measure(self, steps: int, matched: bool) -> dict:
        """Return the row of this data set."""
        distortion = default_distortion(self.provenance)
        paper, default = self.compress_paper(), self.compress_compact(distortion, target_drop=DEFAULT_PSNR_DROP_DB)
        row = {"set": self.name, "gaussians": len(self.model), "psnr": self.raw_scores[0], "ssim": self.raw_scores[1]}
        row |= {"measuring": self.sensitivity_seconds, "paper": paper, "default": default}

        def fits(made: MeasuredFile) -> bool:
            return made.drop <= paper.drop and made.ssim_drop <= paper.ssim_drop

        if matched:
            found = find_coarsest(self.compress_compact, fits, distortion, 9, DISTORTION_RANGE)
            row["matched"] = found and found[1]
        if steps:
            row["finetuned"] = self.compress_compact(default_distortion(self.provenance, steps), steps)
        return {
            key: dataclasses.asdict(value) if isinstance(value, MeasuredFile) else value for key, value in row.items()
        }


def format_table(rows: list[dict]) -> str:
    """Format the rows as a Markdown table."""
    kinds = [kind for kind in ("paper", "default", "matched", "finetuned") if kind in rows[0]]
    columns = ["set", "Gaussians", "PSNR / SSIM", *(f"{kind}: bytes, dB lost, SSIM lost" for kind in kinds)]
    table_rows = []
    for row in rows:
        cells = [row["set"], f"{row['gaussians']:,}", f"{row['psnr']:.2f} / {row['ssim']:.4f}"]
        for kind in kinds:
            measured = row[kind]
            if measured is None:
                cells.append("not reached")
                continue
            share = "" if kind == "paper" else f" ({measured['bytes'] / row['paper']['bytes']:.3f})"
            cells.append(f"{measured['bytes']:,}{share}, {measured['drop']:+.3f}, {measured['ssim_drop']:+.4f}")
        default = row["default"]
        cells.append(f"{default['measured_error'] / default['predicted_error']:.2f}")
        cells.append(f"{row['measuring']:.1f} + {default['seconds']:.1f}")
        table_rows.append(cells)
    return markdown_table([*columns, "measured / predicted error", "seconds"], table_rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--models", type=Path, required=True, help="folder with one folder for each data set, which has model.hyrf"
    )
    parser.add_argument("--data", type=Path, default=DATA_FOLDER, help="folder of the data sets, with the same names")
    parser.add_argument("--sets", nargs="*", help="data sets to compress (all)")
    parser.add_argument("--finetune", type=int, default=0, metavar="N", help="also fine-tune for N steps (0)")
    parser.add_argument(
        "--matched", action="store_true", help="also search for the smallest file that loses no more than paper"
    )
    parser.add_argument("--json", type=Path, help="also write the rows to this file")
    options = parser.parse_args()
    rows = []
    folders = sorted(path.parent for path in options.models.glob("*/model.hyrf"))
    trained = [folder.name for folder in folders]
    fix = "make them with tools.studies.train_sets, and name their folder with `models`"
    names = choose_names(options.sets, trained, f"{options.models}: there are no models", fix)
    for folder in (folder for folder in folders if folder.name in names):
        rows.append(TrainedSet(folder, options.data / folder.name).measure(options.finetune, options.matched))
        print(format_table(rows[-1:]), flush=True)
        if options.json:
            write_json(options.json, rows)
    print("\n" + format_table(rows))


if __name__ == "__main__":
    run_command(main)
