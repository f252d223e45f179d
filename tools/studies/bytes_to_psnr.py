"""Count the bytes that a walk through a scene needs for 25, 30 and 35 dB, as a scene folder and as Streamed SOG.

    hyrfpack export bonsai-scene -o bonsai.ply --sh-degree 3 --no-background
    splat-transform bonsai.ply --decimate 25% d1.ply        (6.25 % and 1.5625 % for d2 and d3)
    splat-transform bonsai.ply -l 0 d1.ply -l 1 d2.ply -l 2 d3.ply -l 3 sog/lod-meta.json
    python -m tools.studies.bytes_to_psnr bonsai-scene sog

The walk has --views views between the cameras of the manifest. Each gets the levels with the least predicted error for
a budget of Gaussians. Budgets rise by factors of --ratio from the coarsest level of all chunks. For each, the bytes are
those of all files that a view of the walk needs, of the coarsest level of all chunks, and of what chunks share; the
PSNR is the mean over the views, against the finest level, without the background. The table has the least bytes with
which a budget reaches 25, 30 and 35 dB, and the PSNR of the finest level of all chunks with its bytes.

Streamed SOG without error tables gets the mean error of each of its levels in the walk.

The results are in docs/research/levels.md.
"""

from __future__ import annotations

import argparse
import json
from abc import ABC, abstractmethod
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

import hyrfpack
from hyrfpack.cameras.files import camera_from_numbers
from hyrfpack.cameras.view_sampling import interpolate_views
from hyrfpack.format.scene_manifest import MANIFEST_NAME
from hyrfpack.lod.select import choose_levels, predict_errors, project_sphere
from hyrfpack.measure.psnr import psnr_from_mse
from hyrfpack.model import Frame
from hyrfpack.scene import Camera, evenly_spaced
from hyrfpack.splats.draw import Drawable, draw
from hyrfpack.splats.files import read_splats
from hyrfpack.splats.splats import concatenate
from tools.command import positive_integer, run_command
from tools.studies.levels import WALK_SEED, mean_psnr, measure_errors
from tools.tables import markdown_table

TARGETS_DB = (25, 30, 35)


class Streamed(ABC):
    """A scene of chunks at several levels.

    Attributes:
        counts: Gaussians of each chunk at each level, the finest first.
        files: name of the file of each chunk at each level.
        sizes: bytes of each file.
        base_bytes: bytes that every view needs.
    """

    counts: list[list[int]]
    files: list[list[str]]
    sizes: dict[str, int]
    base_bytes: int

    @abstractmethod
    def predict(self, camera: Camera) -> list[list[float]]:
        """Predict the mean squared error that each level of each chunk adds to a view."""

    @abstractmethod
    def render(self, levels: Sequence[int], camera: Camera) -> torch.Tensor:
        """Return the picture (H, W, 3) of chunks at these levels."""

    def count_bytes(self, choices: Sequence[Sequence[int]]) -> int:
        """Return the bytes that are needed for all choices of levels, one after the other."""
        needed = {files[level] for levels in choices for files, level in zip(self.files, levels, strict=True)}
        needed |= {files[-1] for files in self.files}
        return self.base_bytes + sum(self.sizes[name] for name in needed)


class FolderScene(Streamed):
    """A scene folder of hyrfpack."""

    def __init__(self, folder: Path) -> None:
        self.folder = hyrfpack.SceneFolder(folder)
        self.manifest = self.folder.manifest
        self.counts = [[level.gaussians for level in chunk.levels] for chunk in self.manifest.chunks]
        self.files = [[level.file for level in chunk.levels] for chunk in self.manifest.chunks]
        self.sizes = {item.file: item.bytes for item in self.manifest.files}
        self.base_bytes = (folder / MANIFEST_NAME).stat().st_size + self.manifest.shared_bytes
        self.chunks = [
            [self.folder.load_chunk(number, level) for level in range(len(files))]
            for number, files in enumerate(self.files)
        ]

    def predict(self, camera: Camera) -> list[list[float]]:
        return [errors[:-1] for errors in predict_errors(self.manifest, camera)]

    def render(self, levels: Sequence[int], camera: Camera) -> torch.Tensor:
        model = self.folder.join([chunk[level] for chunk, level in zip(self.chunks, levels, strict=True)])
        return hyrfpack.render_view(model, camera, background=False).rgb


class SogScene(Streamed):
    """A Streamed SOG (`lod-meta.json`)."""

    def __init__(self, folder: Path, frame: Frame, solid: Sequence[float]) -> None:
        meta = json.loads((folder / "lod-meta.json").read_text())
        self.solid = torch.tensor(solid)
        self.nodes = list_leaves(meta["tree"])
        lods = [[node["lods"][str(level)] for level in range(meta["lodLevels"])] for node in self.nodes]
        self.counts = [[lod["count"] for lod in node] for node in lods]
        names = meta["filenames"]
        self.files = [[names[lod["file"]] for lod in node] for node in lods]
        self.sizes = {name: sum(file.stat().st_size for file in (folder / name).parent.iterdir()) for name in names}
        self.base_bytes = (folder / "lod-meta.json").stat().st_size
        splats = [read_splats((folder / name).parent) for name in names]
        starts = np.cumsum([0, *map(len, splats)])
        self.ranges = [
            [torch.arange(lod["count"]) + int(starts[lod["file"]]) + lod["offset"] for lod in node] for node in lods
        ]
        self.drawable = Drawable.from_splats(concatenate(splats), frame)
        self.level_errors = [0.0] * meta["lodLevels"]

    def predict(self, camera: Camera) -> list[list[float]]:
        shares = [self._project(node["bound"], camera) for node in self.nodes]
        return [[share * error for error in self.level_errors] for share in shares]

    def _project(self, bound: dict, camera: Camera) -> float:
        low, high = np.array(bound["min"]), np.array(bound["max"])
        _, area = project_sphere(((low + high) / 2).tolist(), float(np.linalg.norm(high - low)) / 2, camera)
        return area / (camera.width * camera.height)

    def render(self, levels: Sequence[int], camera: Camera) -> torch.Tensor:
        index = torch.cat([ranges[level] for ranges, level in zip(self.ranges, levels, strict=True)])
        raster = draw(self.drawable[index], camera)
        return raster.rgb + raster.transmittance[..., None] * self.solid


def list_leaves(node: dict) -> list[dict]:
    """Return the nodes without children of a tree."""
    return [leaf for child in node["children"] for leaf in list_leaves(child)] if "children" in node else [node]


def measure_choices(
    scene: Streamed, choices: Sequence[Sequence[int]], cameras: Sequence[Camera], targets: Sequence[torch.Tensor]
) -> list[float]:
    """Return the mean squared error of each view, whose chunks are at the chosen levels."""
    pictures = [scene.render(levels, camera) for levels, camera in zip(choices, cameras, strict=True)]
    return measure_errors(pictures, targets)


def measure_curve(
    scene: Streamed, cameras: Sequence[Camera], targets: Sequence[torch.Tensor], ratio: float
) -> list[tuple[float, int]]:
    """Return (PSNR, bytes) for rising budgets, until the last target or the finest level is reached."""
    curve: list[tuple[float, int]] = []
    total_count, budget = sum(counts[0] for counts in scene.counts), float(sum(counts[-1] for counts in scene.counts))
    while not curve or (curve[-1][0] < TARGETS_DB[-1] and budget < ratio * total_count):
        choices = [choose_levels(scene.counts, scene.predict(camera), budget)[0] for camera in cameras]
        errors = measure_choices(scene, choices, cameras, targets)
        curve.append((mean_psnr(errors), scene.count_bytes(choices)))
        print(f"  {budget:,.0f} Gaussians: {curve[-1][0]:.1f} dB, {curve[-1][1]:,} bytes", flush=True)
        budget *= ratio
    return curve


def format_min_bytes(curve: Sequence[tuple[float, int]], target: float) -> str:
    """Format the smallest number of bytes with which a curve reaches a PSNR; "never" if it does not."""
    sizes = [size for psnr, size in curve if psnr >= target]
    return f"{min(sizes):,}" if sizes else "never"


def make_row(
    name: str, scene: Streamed, cameras: Sequence[Camera], targets: Sequence[torch.Tensor], ratio: float
) -> list[str]:
    """Return the row of a scene."""
    print(name, flush=True)
    finest = [[0] * len(scene.counts)] * len(cameras)
    if isinstance(scene, SogScene):
        for level in range(len(scene.level_errors)):
            uniform = [[level] * len(scene.counts)] * len(cameras)
            scene.level_errors[level] = float(np.mean(measure_choices(scene, uniform, cameras, targets)))
        psnr = f"{psnr_from_mse(scene.level_errors[0]):.1f}"
    else:
        psnr = "exact"
    curve = measure_curve(scene, cameras, targets, ratio)
    cells = [format_min_bytes(curve, target) for target in TARGETS_DB]
    return [name, *cells, psnr, f"{scene.count_bytes(finest):,}"]


@torch.no_grad()
def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path, help="scene folder")
    parser.add_argument("sogs", type=Path, nargs="*", help="folders with a lod-meta.json, of the same model")
    parser.add_argument("--views", type=positive_integer, default=8, help="views of the walk (8)")
    parser.add_argument("--ratio", type=float, default=1.25, help="of a budget and the one before (1.25)")
    arguments = parser.parse_args()
    folder = FolderScene(arguments.scene)
    config = folder.folder.fields[0].config
    cameras = [camera_from_numbers(numbers) for numbers in folder.manifest.cameras]
    cameras = evenly_spaced(interpolate_views(cameras, WALK_SEED), arguments.views)
    targets = [folder.render([0] * len(folder.counts), camera) for camera in cameras]
    rows = [make_row(arguments.scene.name, folder, cameras, targets, arguments.ratio)]
    for sog in arguments.sogs:
        scene = SogScene(sog, config.frame, config.solid)
        rows.append(make_row(sog.name, scene, cameras, targets, arguments.ratio))
    print(markdown_table(["scene", *(f"{db} dB" for db in TARGETS_DB), "finest, dB", "bytes of the finest"], rows))


if __name__ == "__main__":
    run_command(main)
