"""What profile `compact` takes beside `paper`, on trained models: by itself, at no more loss, and fine-tuned.

    python -m tools.studies.train_sets --steps 3000 --sets gerrard_hall        models in runs/sets/3000
    python -m tools.studies.compression --models runs/sets/3000 --finetune 1000

For each set below --models: the profiles by their defaults; the smallest `compact` file that loses no more PSNR and no
more SSIM than `paper` does on held-out photos; and the same after fine-tuning. Losses are against the model as trained.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import time
from pathlib import Path

import hyrfpack
from hyrfpack.compress.distortion import default_distortion
from hyrfpack.compress.packer import FINETUNED, Packer
from hyrfpack.compress.search import coarsest
from hyrfpack.compress.sensitivity import measure_sensitivity
from hyrfpack.format import decode_model, encode_model
from hyrfpack.format.codec import load_with_provenance, without_cameras
from tools.studies.train_sets import DATA
from tools.tables import markdown

ENDS = (1e-7, 1e-2)


@dataclasses.dataclass(frozen=True)
class Made:
    """A file that was made and what it loses: dB of PSNR and SSIM, mean over held-out photos."""

    distortion: float
    bytes: int
    drop: float
    ssim_drop: float
    seconds: float


class Set:
    """A trained set, and what is measured of it once."""

    def __init__(self, folder: Path, data: Path) -> None:
        self.name = folder.name
        self.scene = hyrfpack.load_scene(data)
        self.model, provenance = load_with_provenance(folder / "model.hyrf")
        self.provenance = without_cameras(provenance)
        self.raw = hyrfpack.evaluate(self.model, self.scene.test)
        start = time.perf_counter()
        self.sensitivity = measure_sensitivity(self.model, [view.camera for view in self.scene.train])
        self.measuring = time.perf_counter() - start

    def made(self, data: bytes, distortion: float, start: float) -> Made:
        seconds = time.perf_counter() - start
        scores = hyrfpack.evaluate(decode_model(data), self.scene.test)
        return Made(distortion, len(data), self.raw.psnr - scores.psnr, self.raw.ssim - scores.ssim, seconds)

    def paper(self) -> Made:
        start = time.perf_counter()
        return self.made(encode_model(self.model, "paper", self.provenance), 0, start)

    def compact(self, distortion: float, steps: int = 0) -> Made:
        start = time.perf_counter()
        packer = Packer(self.model, self.provenance, self.sensitivity, self.scene, steps, True, lambda sentence: None)
        return self.made(packer.attempt(distortion).data, distortion, start)

    def measure(self, steps: int) -> dict:
        """The row of this set."""
        distortion = default_distortion(self.provenance)
        paper, default = self.paper(), self.compact(distortion)
        row = {"set": self.name, "gaussians": len(self.model), "psnr": self.raw.psnr, "ssim": self.raw.ssim}
        row |= {"measuring": self.measuring, "paper": paper, "default": default}

        def fits(made: Made) -> bool:
            return made.drop <= paper.drop and made.ssim_drop <= paper.ssim_drop

        found = coarsest(self.compact, fits, distortion, 9, ENDS)
        row["matched"] = found and found[1]
        if steps:
            found = coarsest(lambda value: self.compact(value, steps), fits, FINETUNED * distortion, 3, ENDS)
            row["finetuned"] = found and found[1]
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
        lines.append(cells)
    return markdown(columns, lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--models", type=Path, required=True, help="folder with a folder for each set, model.hyrf in it"
    )
    parser.add_argument("--data", type=Path, default=DATA, help="where the photos are, by the same names")
    parser.add_argument("--sets", nargs="*", help="(all)")
    parser.add_argument("--finetune", type=int, default=0, metavar="N", help="also fine-tune for N steps (0)")
    parser.add_argument("--json", type=Path, help="write the rows there")
    options = parser.parse_args()
    rows = []
    for folder in sorted(path.parent for path in options.models.glob("*/model.hyrf")):
        if options.sets and folder.name not in options.sets:
            continue
        rows.append(Set(folder, options.data / folder.name).measure(options.finetune))
        print(table(rows[-1:]), flush=True)
        if options.json:
            options.json.write_text(json.dumps(rows, indent=1))
    print("\n" + table(rows))


if __name__ == "__main__":
    main()
