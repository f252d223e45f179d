"""What profile `compact` takes beside `paper`, on trained models: by itself, at no more loss, and fine-tuned.

    python -m tools.studies.train_sets --steps 3000 --sets gerrard_hall        models in runs/sets/3000
    python -m tools.studies.compression --models runs/sets/3000 --finetune 1000 --matched

For each set below --models: the profiles by their defaults, and how far the error that was foretold is from the one at
held-out cameras; with --matched the smallest `compact` file that loses no more PSNR and no more SSIM than `paper` does
on held-out photos; with --finetune a fine-tuned one. Losses are against the model as trained, at the exposure that
photos beside the held-out ones predict where photos' exposures were learnt.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import time
from pathlib import Path

import hyrfpack
from hyrfpack.cameras.capture import quantized_provenance
from hyrfpack.compress.calibrate import ReferenceRenders, calibrate
from hyrfpack.compress.distortion import default_distortion
from hyrfpack.compress.packer import EncodedCandidate, Packer
from hyrfpack.compress.search import find_coarsest
from hyrfpack.compress.sensitivity import measure_sensitivity
from hyrfpack.format import decode_model, encode_model
from hyrfpack.format.codec import load_with_provenance
from hyrfpack.model import HybridModel
from hyrfpack.scene import evenly_spaced
from tools.studies.train_sets import DATA
from tools.tables import markdown_table

ENDS = (1e-7, 1e-2)
HELD_OUT = 12  # cameras at most that the error foretold is compared at


@dataclasses.dataclass(frozen=True)
class Made:
    """A file that was made and what it loses: dB of PSNR and SSIM, mean over held-out photos.

    `foretold` and `found` are mean squared errors against the model's own pictures: by estimate, and at held-out
    cameras.
    """

    distortion: float
    bytes: int
    gaussians: int
    drop: float
    ssim_drop: float
    seconds: float
    foretold: float = 0.0
    found: float = 0.0


class Set:
    """A trained set, and what is measured of it once."""

    def __init__(self, folder: Path, data: Path) -> None:
        self.name = folder.name
        self.scene = hyrfpack.load_scene(data)
        self.model, provenance = load_with_provenance(folder / "model.hyrf")
        self.provenance = quantized_provenance(provenance, self.model.config.frame.scale)
        self.raw = self.scores(self.model)
        self.held_out = ReferenceRenders.from_views(
            [view.camera for view in evenly_spaced(self.scene.test, HELD_OUT)], self.model
        )
        start = time.perf_counter()
        cameras = [view.camera for view in self.scene.train]
        self.sensitivity, self.originals = (
            measure_sensitivity(self.model, cameras),
            ReferenceRenders.from_model(self.model, cameras),
        )
        self.measuring = time.perf_counter() - start

    def scores(self, model: HybridModel) -> tuple[float, float]:
        """PSNR and SSIM on the held-out photos."""
        scores = hyrfpack.evaluate_model(model, self.scene.test)
        return scores.psnr, scores.ssim

    def made(self, data: bytes, distortion: float, start: float, candidate: EncodedCandidate | None = None) -> Made:
        seconds = time.perf_counter() - start
        model = decode_model(data)
        psnr, ssim = self.scores(model)
        foretold = sum(candidate.predicted_errors.values()) if candidate else 0.0
        losses = self.raw[0] - psnr, self.raw[1] - ssim
        return Made(distortion, len(data), len(model), *losses, seconds, foretold, self.held_out.measure_error(model))

    def paper(self) -> Made:
        start = time.perf_counter()
        return self.made(encode_model(self.model, "paper", self.provenance), 0, start)

    def compact(self, distortion: float, steps: int = 0) -> Made:
        """As `hyrfpack compress` does it."""
        start = time.perf_counter()
        sensitivity = calibrate(self.model, self.sensitivity, self.originals, distortion)
        packer = Packer(self.model, self.provenance, sensitivity, self.scene, steps, True, lambda sentence: None)
        candidate = packer.encode(distortion) if steps else packer.encode_to_distortion(distortion, self.originals)
        return self.made(candidate.data, distortion, start, candidate)

    def measure(self, steps: int, matched: bool) -> dict:
        """The row of this set."""
        distortion = default_distortion(self.provenance)
        paper, default = self.paper(), self.compact(distortion)
        row = {"set": self.name, "gaussians": len(self.model), "psnr": self.raw[0], "ssim": self.raw[1]}
        row |= {"measuring": self.measuring, "paper": paper, "default": default}

        def fits(made: Made) -> bool:
            return made.drop <= paper.drop and made.ssim_drop <= paper.ssim_drop

        if matched:
            found = find_coarsest(self.compact, fits, distortion, 9, ENDS)
            row["matched"] = found and found[1]
        if steps:
            row["finetuned"] = self.compact(default_distortion(self.provenance, steps), steps)
        return {key: dataclasses.asdict(value) if isinstance(value, Made) else value for key, value in row.items()}


def table(rows: list[dict]) -> str:
    """The rows as Markdown."""
    kinds = [kind for kind in ("paper", "default", "matched", "finetuned") if kind in rows[0]]
    columns = ["set", "Gaussians", "PSNR / SSIM", *(f"{kind}: bytes, dB lost, SSIM lost" for kind in kinds)]
    lines = []
    for row in rows:
        cells = [row["set"], f"{row['gaussians']:,}", f"{row['psnr']:.2f} / {row['ssim']:.4f}"]
        for kind in kinds:
            made = row[kind]
            if made is None:
                cells.append("not reached")
                continue
            share = "" if kind == "paper" else f" ({made['bytes'] / row['paper']['bytes']:.3f})"
            cells.append(f"{made['bytes']:,}{share}, {made['drop']:+.3f}, {made['ssim_drop']:+.4f}")
        default = row["default"]
        cells.append(f"{default['found'] / default['foretold']:.2f}")
        cells.append(f"{row['measuring']:.1f} + {default['seconds']:.1f}")
        lines.append(cells)
    return markdown_table([*columns, "found / foretold", "seconds"], lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--models", type=Path, required=True, help="folder with a folder for each set, model.hyrf in it"
    )
    parser.add_argument("--data", type=Path, default=DATA, help="where the photos are, by the same names")
    parser.add_argument("--sets", nargs="*", help="(all)")
    parser.add_argument("--finetune", type=int, default=0, metavar="N", help="also fine-tune for N steps (0)")
    parser.add_argument("--matched", action="store_true", help="also search for the file that loses as little as paper")
    parser.add_argument("--json", type=Path, help="write the rows there")
    options = parser.parse_args()
    rows = []
    for folder in sorted(path.parent for path in options.models.glob("*/model.hyrf")):
        if options.sets and folder.name not in options.sets:
            continue
        rows.append(Set(folder, options.data / folder.name).measure(options.finetune, options.matched))
        print(table(rows[-1:]), flush=True)
        if options.json:
            options.json.write_text(json.dumps(rows, indent=1))
    print("\n" + table(rows))


if __name__ == "__main__":
    main()
