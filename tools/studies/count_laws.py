"""Train one data set with several numbers of Gaussians and photo sizes, and print what a file of each takes and scores.

    python -m tools.studies.count_laws --sets mipnerf360_bonsai --sizes 400 200 --counts 8000 16000 32000 64000
    python -m tools.studies.count_laws --table --survey results          prints the table, and writes CSV files

Runs are kept in --out/SET/STEPS/SIZE/COUNT. Those of this version that are there are not trained again, and not scored
again unless --lpips-weights are given and a run has no LPIPS of these weights.

The first table has one row for each run: PSNR (dB) and SSIM of the compact file on held-out photos, its bytes, and its
bits per Gaussian of positions, of the other properties, of the hash tables, and of decoders and metadata. The second
has, for each photo size, the least-squares fit of PSNR = a + b log2(N), and of the bytes by N.

--survey writes `FOLDER/SET.csv`, or `FOLDER/SET-SIZE.csv` for several photo sizes, with the columns of the survey of
compression methods "3DGS.zip" (Submethod, PSNR, SSIM, LPIPS, Size [Bytes], #Gaussians). LPIPS is empty without
--lpips-weights.

The results are in docs/research/published-scale.md.
"""

from __future__ import annotations

import csv
import json
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

import hyrfpack
from hyrfpack.format.info import sum_layers
from hyrfpack.format.run_folder import METRICS_FILE, MODEL_FILE
from hyrfpack.format.sections import LOGIT_SECTIONS, POSITIONS, TABLE_SECTIONS
from hyrfpack.train import TrainConfig
from tools.command import positive_integer, run_command
from tools.json_files import write_json
from tools.studies.complete_run import train_completely
from tools.studies.reuse import Origin, describe_origin, find_differences, remove_outdated
from tools.studies.train_sets import make_study_parser
from tools.tables import markdown_table

SURVEY_COLUMNS = ("Submethod", "PSNR", "SSIM", "LPIPS", "Size [Bytes]", "#Gaussians")
ROW_FILE = "row.json"


@dataclass(frozen=True)
class CountRow:
    """A compact file of one run.

    Attributes:
        size: longer side of the photos, pixels.
        gaussians, bytes: of the file.
        psnr, ssim, lpips: of its renders against the held-out photos; PSNR in dB, LPIPS None if not measured.
        positions, properties, tables, rest: bytes of positions; of colours, scales and opacities; of hash tables; and
            of decoders, metadata, header and padding.
    """

    size: int
    gaussians: int
    bytes: int
    psnr: float
    ssim: float
    lpips: float | None
    positions: int
    properties: int
    tables: int
    rest: int
    lpips_weights: str | None = None


def measure(data: Path, size: int, count: int, steps: int, folder: Path, lpips_weights: Path | None) -> CountRow:
    """Train with `count` Gaussians on photos of at most `size` pixels, compress and score; return the row.

    A run that `folder` has already is not repeated.
    """
    scene, quiet = hyrfpack.load_scene(data, max_size=size), hyrfpack.RunContext(progress=None)
    if not (folder / METRICS_FILE).exists():
        config = TrainConfig(steps=steps, max_gaussians=count, exposure=False)
        train_completely(scene, folder, config, context=quiet)
    path = folder / "compact.hyrf"
    report = hyrfpack.compress_model(folder / MODEL_FILE, path, context=quiet)
    scores = hyrfpack.evaluate_model(hyrfpack.load_model(path), scene.test, lpips_weights=lpips_weights)
    sections = {section.type: section.after for section in sum_layers(report.sections)}
    parts = {
        "positions": sections[POSITIONS],
        "properties": sum(sections[name] for name in LOGIT_SECTIONS),
        "tables": sum(sections[name] for name in TABLE_SECTIONS),
    }
    total = report.bytes_after
    rest = total - sum(parts.values())
    measured = (scores.psnr, scores.ssim, scores.lpips)
    weights = describe_weights(lpips_weights)
    row = CountRow(size, report.gaussians, total, *measured, **parts, rest=rest, lpips_weights=weights)
    write_json(folder / ROW_FILE, asdict(row))
    return row


def has_row(folder: Path, lpips_weights: Path | None) -> bool:
    """Return whether a run has been measured, and with these weights of LPIPS if there are any."""
    path = folder / ROW_FILE
    if not path.exists() or lpips_weights is None:
        return path.exists()
    return json.loads(path.read_text()).get("lpips_weights") == describe_weights(lpips_weights)


def describe_weights(path: Path | None) -> str | None:
    """Return the absolute path of weights of LPIPS as a row stores it; None without weights."""
    return None if path is None else str(path.resolve())


def describe_run(data: Path, steps: int, size: int, count: int) -> Origin:
    """Return the origin of a run with `count` Gaussians on photos of at most `size` pixels."""
    return describe_origin(data, size=size, count=count, steps=steps)


def read_rows(out: Path, data: Path, steps: int, lpips_weights: Path | None = None) -> list[CountRow]:
    """Return the rows of all runs below `out`, by size, the largest first, and by number of Gaussians.

    Runs of another version or data set are named and left out, because one law does not describe both. LPIPS of other
    weights is left out, too.
    """
    rows = []
    for path in sorted(out.glob(f"*/*/{ROW_FILE}")):
        size, count = (int(folder.name) for folder in (path.parents[1], path.parent))
        if differences := find_differences(path.parent, describe_run(data, steps, size, count)):
            print(f"{path.parent} is left out: {'; '.join(differences)}", file=sys.stderr)
        else:
            row = CountRow(**json.loads(path.read_text()))
            has_weights = row.lpips_weights == describe_weights(lpips_weights)
            rows.append(row if has_weights else replace(row, lpips=None, lpips_weights=None))
    return sorted(rows, key=lambda row: (-row.size, row.gaussians))


def format_rows(rows: Sequence[CountRow]) -> str:
    """Format the runs as a Markdown table."""
    header = ("pixels", "Gaussians", "PSNR", "SSIM", "bytes", "bits a Gaussian")
    parts = ("positions", "properties", "tables", "rest")
    cells = [
        [f"{row.size}", f"{row.gaussians:,}", f"{row.psnr:.2f}", f"{row.ssim:.3f}", f"{row.bytes:,}"]
        + [f"{8 * value / row.gaussians:.1f}" for value in (row.bytes, *(getattr(row, part) for part in parts))]
        for row in rows
    ]
    return markdown_table((*header, *parts), cells)


def format_fits(rows: Sequence[CountRow]) -> str:
    """Format the least-squares fits of PSNR and bytes against the number of Gaussians, for each photo size."""
    cells = []
    for size in dict.fromkeys(row.size for row in rows):
        size_rows = [row for row in rows if row.size == size]
        if len(size_rows) < 2:
            continue
        counts = np.array([row.gaussians for row in size_rows], float)
        slope, start = np.polyfit(np.log2(counts), [row.psnr for row in size_rows], 1)
        marginal, fixed = np.polyfit(counts, [row.bytes for row in size_rows], 1)
        bits = f"{8 * marginal:.1f} bits a Gaussian and {fixed:,.0f} bytes"
        cells.append([f"{size}", f"{start:.2f} + {slope:.2f} log2(N) dB", bits])
    return markdown_table(("pixels", "PSNR", "size of the file"), cells)


def write_survey(rows: Sequence[CountRow], folder: Path, name: str) -> None:
    """Write one CSV file of the set `name` for each photo size, with the survey's columns.

    Rows have no Submethod, so they appear in the survey's plots only.
    """
    folder.mkdir(parents=True, exist_ok=True)
    sizes = list(dict.fromkeys(row.size for row in rows))
    for size in sizes:
        with (folder / (f"{name}.csv" if len(sizes) == 1 else f"{name}-{size}.csv")).open("w", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(SURVEY_COLUMNS)
            for row in rows:
                if row.size == size:
                    lpips = "" if row.lpips is None else row.lpips
                    writer.writerow(("", row.psnr, row.ssim, lpips, row.bytes, row.gaussians))


def main() -> None:
    parser = make_study_parser(__doc__, 3000, ["mipnerf360_bonsai"], Path("runs/count_laws"), seeds=False, only=False)
    parser.add_argument("--sizes", type=int, nargs="+", default=[400, 200], help="longer sides of the photos, pixels")
    parser.add_argument(
        "--counts", type=positive_integer, nargs="+", default=[8000, 16000, 32000, 64000], help="Gaussians"
    )
    parser.add_argument("--lpips-weights", type=Path, help="weights of the lpips package")
    parser.add_argument("--survey", type=Path, help="folder for CSV files")
    parser.add_argument(
        "--table", action="store_true", help="train nothing, and print what --out has for these --steps"
    )
    args = parser.parse_args()
    for name in args.sets:
        out = args.out / name / str(args.steps)
        for size in () if args.table else args.sizes:
            for count in args.counts:
                folder = out / str(size) / str(count)
                remove_outdated(folder, describe_run(args.data / name, args.steps, size, count))
                if not has_row(folder, args.lpips_weights):
                    measure(args.data / name, size, count, args.steps, folder, args.lpips_weights)
        rows = read_rows(out, args.data / name, args.steps, args.lpips_weights)
        print(f"{name}\n\n{format_rows(rows)}\n\n{format_fits(rows)}\n")
        if args.survey:
            write_survey(rows, args.survey, name)


if __name__ == "__main__":
    run_command(main)
