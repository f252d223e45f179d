"""Import beside SOG and SPZ of the same file: bytes against likeness, as a curve.

    python -m tools.studies.imports ../shared/data/trained_models/biker.spz bonsai.ply
    python -m tools.studies.imports bonsai.ply --psnr 34 38 --size 800

SOG and SPZ are written by PlayCanvas' splat-transform (`npm ci --prefix tests/node`), SPZ by gsply, too: of all that is
in the file, and of fewer harmonics and without faint Gaussians, for neither has a setting of quality. Ours learns once
and is packed for each --psnr. Everything is read back, drawn by our rasteriser at the viewpoints that import holds out,
and compared with the file's own pictures there; made-up viewpoints are few and far from each other, so differences of
some tenths of a dB mean nothing.
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

from hyrfpack.distill import DistillConfig
from hyrfpack.distill.distill_model import DistilledModel, distill_model
from hyrfpack.distill.pack import pack
from hyrfpack.evaluate.metrics import psnr
from hyrfpack.format.codec import decode_model
from hyrfpack.splats.draw import Drawable, draw
from hyrfpack.splats.files import read_splats
from hyrfpack.splats.formats import ply
from hyrfpack.splats.splats import Splats
from tools.tables import markdown_table

NODE = Path(__file__).parents[2] / "tests" / "node"
ASKED = (30, 32, 34, 36, 38, 40, 42)  # dB
MIN_OPACITIES = (0.0, 0.05, 0.1)


@dataclasses.dataclass(frozen=True)
class Point:
    """A file on the curve.

    Attributes:
        encoder: who wrote it.
        setting: how.
        bytes: on disk.
        psnr, worst: dB against the original's pictures, mean and least of the held-out viewpoints.
        seconds: that packing took.
    """

    encoder: str
    setting: str
    bytes: int
    psnr: float
    worst: float
    seconds: float

    def row(self) -> list[str]:
        """Of the table."""
        sizes = f"{self.bytes:,}", f"{self.psnr:.2f}", f"{self.worst:.2f}", f"{self.seconds:.1f}"
        return [self.encoder, self.setting, *sizes]


def ours(taught: DistilledModel, asked: list[float]) -> Iterator[Point]:
    """Our files, packed for so many dB each."""
    for wanted in asked:
        began = time.perf_counter()
        data = pack(taught, wanted, {})
        seconds = time.perf_counter() - began
        scores = taught.test.psnr_per_view(decode_model(data))
        yield Point("hyrfpack", f"--psnr {wanted:g}", len(data), float(np.mean(scores)), min(scores), seconds)


def theirs(splats: Splats, taught: DistilledModel, folder: Path) -> Iterator[Point]:
    """Files of other programs, of these splats and of parts of them."""
    for degree in range(splats.degree, -1, -1):
        for least in MIN_OPACITIES:
            source = folder / "part.ply"
            source.write_bytes(ply.encode(splats[splats.opacities >= least].with_degree(degree)))
            setting = f"degree {degree}, opacity from {least:g}"
            for encoder, target in (("SOG, splat-transform", "a.sog"), ("SPZ, splat-transform", "a.spz")):
                began = time.perf_counter()
                converted(source, folder / target)
                yield measured(encoder, setting, folder / target, taught, time.perf_counter() - began)
            began = time.perf_counter()
            gsply.write_spz(folder / "b.spz", gsply.plyread(source), version=4)
            seconds = time.perf_counter() - began
            gsply.plywrite(folder / "b.ply", gsply.read_spz(folder / "b.spz"))  # its axes are not SPZ's own
            point = measured("SPZ 4, gsply", setting, folder / "b.ply", taught, seconds)
            yield dataclasses.replace(point, bytes=(folder / "b.spz").stat().st_size)


def converted(source: Path, target: Path) -> None:
    """Have splat-transform write a file in another format."""
    program = shutil.which("node")
    if program is None or not (NODE / "node_modules").is_dir():
        raise SystemExit("splat-transform is not here; install node and run 'npm ci --prefix tests/node'")
    job = json.dumps([[str(source), str(target)]])
    done = subprocess.run([program, str(NODE / "convert.mjs"), job], capture_output=True, text=True, check=True)
    (complaint,) = json.loads(done.stdout.splitlines()[-1])
    if complaint:
        raise SystemExit(f"splat-transform: {complaint}")


def measured(encoder: str, setting: str, file: Path, taught: DistilledModel, seconds: float) -> Point:
    """A file of splats, beside the original."""
    drawable = Drawable.from_splats(read_splats(file), taught.model.config.frame)
    pairs = zip(taught.test.cameras, taught.test.pictures, strict=True)
    scores = [psnr(draw(drawable, camera).rgb.clamp(0, 1), picture) for camera, picture in pairs]
    return Point(encoder, setting, file.stat().st_size, float(np.mean(scores)), min(scores), seconds)


def at_equal(points: list[Point], others: list[Point]) -> Iterator[str]:
    """How many of each other's bytes ours take at its likeness, by the line through ours in logarithms of bytes."""
    curve = sorted((point.psnr, point.bytes) for point in points)
    decibels, sizes = (np.array(values) for values in zip(*curve, strict=True))
    for other in others:
        if decibels[0] <= other.psnr <= decibels[-1]:
            size = float(np.exp(np.interp(other.psnr, decibels, np.log(sizes))))
            told = f"ours take {size / other.bytes:.3f} of its bytes"
        else:
            told = "ours do not come near" if other.psnr > decibels[-1] else "ours are always better"
        yield f"- {other.encoder}, {other.setting}, {other.bytes:,} bytes, {other.psnr:.2f} dB: {told}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", type=Path, nargs="+", help="of 3D Gaussians")
    parser.add_argument("--psnr", type=float, nargs="+", default=list(ASKED), metavar="DB", help="to pack ours for")
    parser.add_argument("--steps", type=int, default=DistillConfig.steps)
    parser.add_argument("--size", type=int, default=DistillConfig.size)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    for file in args.files:
        splats = read_splats(file)
        began = time.perf_counter()
        taught = distill_model(splats, DistillConfig(steps=args.steps, size=args.size, seed=args.seed), name=str(file))
        print(f"\n{file.name}: {len(splats):,} Gaussians of degree {splats.degree}; "
              f"taught in {time.perf_counter() - began:.0f} s\n")  # fmt: skip
        mine = list(ours(taught, args.psnr))
        with tempfile.TemporaryDirectory() as folder:
            others = list(theirs(splats, taught, Path(folder)))
        columns = ["encoder", "setting", "bytes", "dB, mean", "worst", "s"]
        print(markdown_table(columns, [point.row() for point in (*mine, *others)]), flush=True)
        print("\nAt equal dB:\n", *at_equal(mine, others), sep="\n", flush=True)


if __name__ == "__main__":
    main()
