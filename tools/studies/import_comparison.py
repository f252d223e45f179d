"""Compare `hyrfpack import` with SOG and SPZ of the same file: bytes and PSNR at several settings.

    python -m tools.studies.import_comparison ../shared/data/trained_models/biker.spz bonsai.ply
    python -m tools.studies.import_comparison bonsai.ply --psnr 34 38 --size 800

PlayCanvas' splat-transform (`npm ci --prefix tests/node`) writes SOG and SPZ, and gsply writes SPZ. Neither has a
quality setting, so they encode the whole file, and also versions with fewer harmonics and without faint Gaussians.
hyrfpack makes one model and compresses it for each --psnr. All files are decoded, drawn by hyrfpack's rasteriser at the
viewpoints that import holds out, and compared with the original's pictures. The table has bytes, mean and worst PSNR in
dB, and seconds of compression. The viewpoints are few and far apart, so differences of some tenths of a dB are not
significant.

The results are in docs/research/import.md.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import shutil
import subprocess
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import gsply
import numpy as np

from hyrfpack.errors import HyrfError
from hyrfpack.evaluate.metrics import psnr
from hyrfpack.format.codec import decode_model
from hyrfpack.imports import ImportConfig
from hyrfpack.imports.pack import pack
from hyrfpack.imports.prepare import PreparedModel, prepare_model
from hyrfpack.splats.draw import Drawable, draw
from hyrfpack.splats.files import read_splats
from hyrfpack.splats.formats import ply
from hyrfpack.splats.splats import Splats
from tools.command import run_command
from tools.tables import print_measured_table

NODE_FOLDER = Path(__file__).parents[2] / "tests" / "node"
DEFAULT_PSNR_TARGETS_DB = (30, 32, 34, 36, 38, 40, 42, 45, 50)
OWN_FILES, OTHER_FILES = "files of hyrfpack", "files of other programs"
MIN_OPACITIES = (0.0, 0.05, 0.1)


@dataclasses.dataclass(frozen=True)
class MeasuredFile:
    """An encoded file and its scores.

    Attributes:
        encoder: format and program.
        setting: the settings of the encoder.
        bytes: size on disk.
        psnr, worst: mean and smallest PSNR in dB against the original's pictures at the held-out viewpoints.
        seconds: duration of the compression.
    """

    encoder: str
    setting: str
    bytes: int
    psnr: float
    worst: float
    seconds: float

    def row(self) -> list[str]:
        """Return the file's row of the table."""
        sizes = f"{self.bytes:,}", f"{self.psnr:.2f}", f"{self.worst:.2f}", f"{self.seconds:.1f}"
        return [self.encoder, self.setting, *sizes]


def measure_own_files(prepared: PreparedModel, psnr_targets: list[float]) -> Iterator[MeasuredFile]:
    """Compress the model for each PSNR target and yield the files."""
    for psnr_target in psnr_targets:
        started = time.perf_counter()
        data = pack(prepared, psnr_target, {})
        seconds = time.perf_counter() - started
        scores = prepared.test.psnr_per_view(decode_model(data))
        yield MeasuredFile(
            "hyrfpack", f"--psnr {psnr_target:g}", len(data), float(np.mean(scores)), min(scores), seconds
        )


def measure_other_files(splats: Splats, prepared: PreparedModel, folder: Path) -> Iterator[MeasuredFile]:
    """Encode the splats, and reduced versions of them, with other programs and yield the files."""
    for degree in range(splats.degree, -1, -1):
        for min_opacity in MIN_OPACITIES:
            source = folder / "part.ply"
            source.write_bytes(ply.encode(splats[splats.opacities >= min_opacity].with_degree(degree)))
            setting = f"degree {degree}, opacity from {min_opacity:g}"
            for encoder, target in (("SOG, splat-transform", "a.sog"), ("SPZ, splat-transform", "a.spz")):
                started = time.perf_counter()
                convert_with_splat_transform(source, folder / target)
                yield measure_splat_file(encoder, setting, folder / target, prepared, time.perf_counter() - started)
            started = time.perf_counter()
            gsply.write_spz(folder / "b.spz", gsply.plyread(source), version=4)
            seconds = time.perf_counter() - started
            gsply.plywrite(
                folder / "b.ply", gsply.read_spz(folder / "b.spz")
            )  # gsply stores other axes than the SPZ format
            file = measure_splat_file("SPZ 4, gsply", setting, folder / "b.ply", prepared, seconds)
            yield dataclasses.replace(file, bytes=(folder / "b.spz").stat().st_size)


def convert_with_splat_transform(source: Path, target: Path) -> None:
    """Convert a file of splats with splat-transform."""
    program = shutil.which("node")
    if program is None or not (NODE_FOLDER / "node_modules").is_dir():
        raise HyrfError("splat-transform is not installed", fix="install node and run 'npm ci --prefix tests/node'")
    job = json.dumps([[str(source), str(target)]])
    process = subprocess.run(
        [program, str(NODE_FOLDER / "convert.mjs"), job], capture_output=True, text=True, check=True
    )
    (error_text,) = json.loads(process.stdout.splitlines()[-1])
    if error_text:
        raise HyrfError(f"splat-transform: {error_text}", fix="check its installation in tests/node")


def measure_splat_file(encoder: str, setting: str, file: Path, prepared: PreparedModel, seconds: float) -> MeasuredFile:
    """Draw a file of splats and score it against the original's pictures."""
    drawable = Drawable.from_splats(read_splats(file), prepared.model.config.frame)
    pairs = zip(prepared.test.cameras, prepared.test.pictures, strict=True)
    scores = [psnr(draw(drawable, camera).rgb.clamp(0, 1), picture) for camera, picture in pairs]
    return MeasuredFile(encoder, setting, file.stat().st_size, float(np.mean(scores)), min(scores), seconds)


def compare_at_equal_psnr(points: list[MeasuredFile], other_files: list[MeasuredFile]) -> Iterator[str]:
    """Yield for each other file the ratio of hyrfpack's bytes at the same PSNR.

    hyrfpack's bytes are interpolated linearly in the logarithm of bytes between its files.
    """
    curve = sorted((file.psnr, file.bytes) for file in points)
    decibels, sizes = (np.array(values) for values in zip(*curve, strict=True))
    for measured in other_files:
        if decibels[0] <= measured.psnr <= decibels[-1]:
            size = float(np.exp(np.interp(measured.psnr, decibels, np.log(sizes))))
            comparison = f"hyrfpack needs {size / measured.bytes:.3f} of these bytes"
        else:
            comparison = (
                "no file of hyrfpack reaches this PSNR"
                if measured.psnr > decibels[-1]
                else "all files of hyrfpack are better"
            )
        label = f"{measured.encoder}, {measured.setting}, {measured.bytes:,} bytes, {measured.psnr:.2f} dB"
        yield f"- {label}: {comparison}"


def compare_file(path: Path, config: ImportConfig, psnr_targets: list[float]) -> None:
    """Print the table of one file of 3D Gaussians, and the ratios of bytes at equal PSNR."""
    splats = read_splats(path)
    started = time.perf_counter()
    prepared = prepare_model(splats, config, name=str(path))
    print(f"\n{path.name}: {len(splats):,} Gaussians of degree {splats.degree}; "
          f"prepared in {time.perf_counter() - started:.0f} s\n")  # fmt: skip
    files: dict[str, list[MeasuredFile]] = {OWN_FILES: [], OTHER_FILES: []}

    def measure(kind: str) -> Iterator[list[str]]:
        with tempfile.TemporaryDirectory() as folder:
            if kind == OWN_FILES:
                measured = measure_own_files(prepared, psnr_targets)
            else:
                measured = measure_other_files(splats, prepared, Path(folder))
            for file in measured:
                files[kind].append(file)
                yield file.row()

    print_measured_table(["encoder", "setting", "bytes", "dB, mean", "worst", "s"], files, measure)
    print("\nAt equal PSNR:\n", *compare_at_equal_psnr(*files.values()), sep="\n", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", type=Path, nargs="+", help="files of 3D Gaussians")
    parser.add_argument(
        "--psnr",
        type=float,
        nargs="+",
        default=list(DEFAULT_PSNR_TARGETS_DB),
        metavar="DB",
        help="PSNR targets of hyrfpack's files",
    )
    parser.add_argument(
        "--size", type=int, default=ImportConfig.size, help=f"longer side of pictures in pixels ({ImportConfig.size})"
    )
    parser.add_argument("--seed", type=int, default=0, help="random seed (0)")
    args = parser.parse_args()
    for file in args.files:
        compare_file(file, ImportConfig(size=args.size, seed=args.seed), args.psnr)


if __name__ == "__main__":
    run_command(main)
