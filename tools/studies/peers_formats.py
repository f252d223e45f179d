"""3D Gaussians in the files of other programs: each format writes its real files and its own program reads them back.

    SPZ  (Niantic)       splat-transform, the npm package @playcanvas/splat-transform; it holds Niantic's own library
    SOG  (PlayCanvas)    splat-transform
    PNG  (gsplat)        gsplat's `PngCompression`; `pip install --no-deps gsplat jaxtyping wadler-lindig imageio`

A format that cannot run here says why.
"""

from __future__ import annotations

import contextlib
import importlib.util
import io
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from types import ModuleType
from unittest.mock import patch

import numpy as np
import torch
from torch import Tensor

SPLAT_TRANSFORM = "@playcanvas/splat-transform@2.7.1"
SOG_ROUNDS = "2"  # of its k-means, minutes each without a GPU; the default 10 gained 0.01 dB at the same bytes
KMEANS_ROUNDS = 10  # of ours
KMEANS_BLOCK = 1024  # points whose distances to all centroids are held at once


class NotAvailable(Exception):
    """A format's program is not here; the message says what to install."""


@dataclass(frozen=True)
class Splats:
    """Explicit 3D Gaussians as the INRIA PLY layout stores them, float32.

    Attributes:
        positions: (N, 3).
        log_scales: (N, 3) natural logarithms of standard deviations.
        quats: (N, 4) wxyz.
        opacity_logits: (N,).
        harmonics: (N, (degree + 1)^2, 3) colour = 0.5 + sum of coefficient times basis function.
    """

    positions: np.ndarray
    log_scales: np.ndarray
    quats: np.ndarray
    opacity_logits: np.ndarray
    harmonics: np.ndarray

    def __len__(self) -> int:
        return len(self.positions)

    def __getitem__(self, index: np.ndarray) -> Splats:
        return Splats(*(values[index] for values in vars(self).values()))

    @property
    def degree(self) -> int:
        """Of the spherical harmonics, 0 to 3."""
        return round(self.harmonics.shape[1] ** 0.5) - 1

    def scaled(self, factor: float) -> Splats:
        """The same scene with all lengths multiplied."""
        return replace(self, positions=self.positions * factor, log_scales=self.log_scales + np.float32(np.log(factor)))


def write_ply(path: Path, splats: Splats) -> None:
    """Write the INRIA layout: binary little-endian float32, higher harmonics channel after channel."""
    rest = splats.harmonics[:, 1:].transpose(0, 2, 1).reshape(len(splats), -1)
    columns = [
        splats.positions,
        splats.harmonics[:, 0],
        rest,
        splats.opacity_logits[:, None],
        splats.log_scales,
        splats.quats,
    ]
    names = ["x", "y", "z", *_names("f_dc", 3), *_names("f_rest", rest.shape[1]), "opacity"]
    names += [*_names("scale", 3), *_names("rot", 4)]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(splats)}"]
    header += [f"property float {name}" for name in names] + ["end_header\n"]
    path.write_bytes("\n".join(header).encode() + np.concatenate(columns, axis=1).astype("<f4").tobytes())


def read_ply(path: Path) -> Splats:
    """Read a PLY with float properties only, as `write_ply` and splat-transform write them."""
    data = path.read_bytes()
    header, mark, body = data.partition(b"end_header\n")
    lines = header.decode("ascii").splitlines()
    names = [line.split()[2] for line in lines if line.startswith("property float ")]
    (count,) = (int(line.split()[2]) for line in lines if line.startswith("element vertex "))
    if not mark or sum(line.startswith("property") for line in lines) != len(names):
        raise ValueError(f"{path}: not a PLY of floats")
    table = dict(zip(names, np.frombuffer(body, "<f4").reshape(count, len(names)).T, strict=True))
    rest = [name for name in names if name.startswith("f_rest_")]

    def stack(names: Sequence[str]) -> np.ndarray:
        return np.stack([table[name] for name in names], axis=1)

    harmonics = stack(_names("f_dc", 3))[:, None]
    if rest:
        higher = stack(_names("f_rest", len(rest))).reshape(count, 3, -1).transpose(0, 2, 1)
        harmonics = np.concatenate((harmonics, higher), axis=1)
    scales, quats = stack(_names("scale", 3)), stack(_names("rot", 4))
    return Splats(stack("xyz"), scales, quats, table["opacity"].copy(), harmonics)


def _names(stem: str, count: int) -> list[str]:
    return [f"{stem}_{number}" for number in range(count)]


@dataclass(frozen=True)
class SplatTransform:
    """The splat-transform program.

    Attributes:
        command: how it is started.
    """

    command: tuple[str, ...]

    @classmethod
    def find(cls, given: str | None) -> SplatTransform:
        """The program at a path, or on the PATH, or through npx. Raises NotAvailable."""
        if given:
            command = (given,)
        elif found := shutil.which("splat-transform"):
            command = (found,)
        elif found := shutil.which("npx"):
            command = (found, "--yes", SPLAT_TRANSFORM)
        else:
            raise NotAvailable(f"neither splat-transform nor npx is here; install node 20 and {SPLAT_TRANSFORM}")
        try:
            subprocess.run((*command, "--version"), check=True, capture_output=True)
        except (OSError, subprocess.CalledProcessError) as error:
            raise NotAvailable(f"'{' '.join(command)}' does not start: {error}") from error
        return cls(command)

    def convert(self, source: Path, target: Path, *options: str) -> None:
        """Convert between formats, which the extensions name, on the CPU."""
        fixed = ("--quiet", "--overwrite", "--gpu", "cpu", "--max-workers", "2")
        done = subprocess.run(
            (*self.command, *fixed, *options, str(source), str(target)), capture_output=True, text=True
        )
        if done.returncode:
            raise RuntimeError(f"splat-transform {source.name} {target.name}: {done.stderr.strip() or done.stdout}")

    def round_trip(self, splats: Splats, folder: Path, name: str, *options: str) -> tuple[int, Splats]:
        """Write a file called `name` and read it back; its bytes and what it holds."""
        before, file, after = folder / "before.ply", folder / name, folder / "after.ply"
        write_ply(before, splats)
        self.convert(before, file, *options)
        self.convert(file, after)
        return file.stat().st_size, read_ply(after)


@dataclass(frozen=True)
class Spz:
    """Niantic SPZ, version 4, packed as splat-transform packs it: harmonics of degree 1 in 5 bits, higher in 4.

    Positions are fixed-point with steps of 1/4096, so the unit of length is a setting: in a larger one, positions are
    coarser and take fewer bytes.

    Attributes:
        lengths: the factor by which lengths are multiplied before writing.
    """

    program: SplatTransform
    lengths: float = 1.0

    def round_trip(self, splats: Splats, folder: Path) -> tuple[int, Splats]:
        """Bytes of the file, and the Gaussians read back from it."""
        size, read = self.program.round_trip(splats.scaled(self.lengths), folder, "scene.spz")
        return size, read.scaled(1 / self.lengths)


@dataclass(frozen=True)
class Sog:
    """PlayCanvas SOG, version 2, bundled.

    Its palette of higher harmonics follows from the number of Gaussians and is large for small scenes (a row for every
    two Gaussians at 30,000). Clustering them beforehand makes most rows equal, which its WebP pictures pack well.

    Attributes:
        clusters: of the higher harmonics before writing, or None to leave them to splat-transform.
    """

    program: SplatTransform
    clusters: int | None = None

    def round_trip(self, splats: Splats, folder: Path) -> tuple[int, Splats]:
        """Bytes of the file, and the Gaussians read back from it."""
        if splats.degree and self.clusters is not None:
            points = torch.from_numpy(splats.harmonics[:, 1:].reshape(len(splats), -1))
            labels, centroids = kmeans(points, min(self.clusters, len(splats)))
            higher = centroids[labels].numpy().reshape(len(splats), -1, 3)
            splats = replace(splats, harmonics=np.concatenate((splats.harmonics[:, :1], higher), axis=1))
        return self.program.round_trip(splats, folder, "scene.sog", "--iterations", SOG_ROUNDS)


@dataclass(frozen=True)
class Png:
    """gsplat's PNG compression, written and read by gsplat.

    Two parts that gsplat takes from packages for CUDA are ours: Gaussians fill the rows of the grid in Morton order
    (gsplat: PLAS, smoother; a Morton curve over the grid as well takes 3 % more bytes), and the clusters come from
    k-means with squared distances (gsplat: TorchPQ, absolute distances). gsplat always asks for 65,536 clusters, more
    than a small scene has Gaussians.

    Attributes:
        clusters: of the higher harmonics.
    """

    clusters: int

    @staticmethod
    def find() -> None:
        """Raises NotAvailable unless gsplat can be imported."""
        missing = [name for name in ("gsplat", "jaxtyping", "imageio") if importlib.util.find_spec(name) is None]
        if missing:
            raise NotAvailable("run 'pip install --no-deps gsplat jaxtyping wadler-lindig imageio'")

    def round_trip(self, splats: Splats, folder: Path) -> tuple[int, Splats]:
        """Bytes of the folder, and the Gaussians read back from it; as in gsplat, as many as fill a square grid."""
        from gsplat.compression import PngCompression

        side = int(len(splats) ** 0.5)
        splats = splats[np.sort(np.argsort(-splats.opacity_logits, kind="stable")[: side**2])]
        splats = splats[morton_order(splats.positions)]
        groups = {
            "means": splats.positions,
            "scales": splats.log_scales,
            "quats": splats.quats,
            "opacities": splats.opacity_logits,
            "sh0": splats.harmonics[:, :1],
        }
        if splats.degree:
            groups["shN"] = splats.harmonics[:, 1:]
        compression = PngCompression(use_sort=False, verbose=False)
        with _kmeans_of_gsplat(min(self.clusters, len(splats))), contextlib.redirect_stdout(io.StringIO()):
            compression.compress(str(folder), {name: torch.from_numpy(values) for name, values in groups.items()})
            read = {name: values.numpy() for name, values in compression.decompress(str(folder)).items()}
        size = sum(file.stat().st_size for file in folder.iterdir())
        harmonics = np.concatenate([read[name] for name in ("sh0", "shN") if name in read], axis=1)
        return size, Splats(read["means"], read["scales"], read["quats"], read["opacities"], harmonics)


def morton_order(positions: np.ndarray) -> np.ndarray:
    """The order (N,) of points (N, 3) along a Morton curve, after the sign log(1 + |x|) that draws outliers in."""
    drawn_in = np.sign(positions) * np.log1p(np.abs(positions))
    low = drawn_in.min(0)
    cells = ((drawn_in - low) / max(float((drawn_in.max(0) - low).max()), 1e-12) * (2**16 - 1)).astype(np.uint64)
    codes = np.zeros(len(positions), np.uint64)
    for bit, axis in product(range(16), range(3)):
        codes |= ((cells[:, axis] >> np.uint64(bit)) & np.uint64(1)) << np.uint64(3 * bit + axis)
    return np.argsort(codes, kind="stable")


def kmeans(points: Tensor, clusters: int) -> tuple[Tensor, Tensor]:
    """Lloyd's k-means: labels (N,) int64 and centroids (clusters, D) of points (N, D). Empty clusters stay put."""
    generator = torch.Generator().manual_seed(0)
    centroids = points[torch.randperm(len(points), generator=generator)[:clusters]].clone()
    for _ in range(KMEANS_ROUNDS):
        labels = _nearest(points, centroids)
        counts = torch.bincount(labels, minlength=clusters)
        sums = torch.zeros_like(centroids).index_add_(0, labels, points)
        centroids = torch.where(counts[:, None] > 0, sums / counts.clamp_min(1)[:, None], centroids)
    return _nearest(points, centroids), centroids


def _nearest(points: Tensor, centroids: Tensor) -> Tensor:
    """Labels (N,) of the nearest centroids; |p|^2 is the same for all and left out."""
    lengths = centroids.square().sum(-1)
    return torch.cat([(lengths - 2 * block @ centroids.T).argmin(-1) for block in points.split(KMEANS_BLOCK)])


@contextlib.contextmanager
def _kmeans_of_gsplat(clusters: int) -> Iterator[None]:
    """Inside, gsplat finds our k-means under TorchPQ's name."""

    class KMeans:
        def __init__(self, n_clusters: int, distance: str, verbose: bool) -> None:
            self.centroids: Tensor | None = None

        def fit(self, columns: Tensor) -> Tensor:
            labels, centroids = kmeans(columns.T.contiguous(), clusters)
            self.centroids = centroids.T
            return labels

    module = ModuleType("torchpq.clustering")
    module.KMeans = KMeans
    with patch.dict(sys.modules, {"torchpq": ModuleType("torchpq"), "torchpq.clustering": module}):
        yield


RoundTrip = Callable[[Splats, Path], tuple[int, Splats]]
