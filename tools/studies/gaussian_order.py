"""Measure what the order of a model's Gaussians costs: CPU time of training steps, and rows of hash tables.

    python -m tools.studies.densify_model --data ../shared/data/mipnerf360_bonsai --out runs/million
    python -m tools.studies.gaussian_order --data ../shared/data/mipnerf360_bonsai --model runs/million/model.hyrf

The Gaussians are an even selection of --model, in three orders: of the file, of Morton codes, and random. Steps of the
three runs alternate in one process. Rows are counted for the Gaussians in view of the first photo: a block of
consecutive ones adds its gradients to the rows of its cells' corners. "Distinct rows" is the share of these additions
that go to different rows. "Distinct sectors" is the share of 32-byte sectors, for 32 consecutive Gaussians and one
corner, which a GPU accesses together. "Runs" is the share of additions left when those of consecutive Gaussians in the
same cell are summed first: by a thread, as the kernel does, and by a block.

The results are in docs/research/training-step.md.
"""

from __future__ import annotations

import argparse
import copy
import dataclasses
import statistics
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

import hyrfpack
from hyrfpack.model import HashGridConfig, HybridModel
from hyrfpack.ops.hash_encode.reference import PRIME_Y, PRIME_Z
from hyrfpack.render.in_view import gaussians_in_view
from hyrfpack.scene import Scene
from hyrfpack.train import DensityConfig, TrainConfig, Trainer
from hyrfpack.train.density import spatial_order
from tools.command import positive_integer, run_command
from tools.studies.step_cost import resample_gaussians
from tools.tables import print_measured_table

MAX_PHOTOS = 6
WARMUP_STEPS = 2  # The first steps compile kernels.
POINTS_PER_BLOCK = 256
POINTS_PER_THREAD = 8  # as in `hyrfpack.ops.hash_encode.gpu`
POINTS_PER_ACCESS = 32
ROWS_PER_SECTOR = 4
CELL_CORNER_OFFSETS = np.array([[corner >> axis & 1 for axis in range(3)] for corner in range(8)])


def make_orders(model: HybridModel) -> dict[str, Tensor]:
    """Return the compared orders (N,) int64 by name."""
    generator = torch.Generator().manual_seed(0)
    random = torch.randperm(len(model), generator=generator)
    return {"file": torch.arange(len(model)), "Morton": spatial_order(model), "random": random}


def measure_steps(scene: Scene, models: dict[str, HybridModel], steps: int) -> dict[str, list[float]]:
    """Return the CPU seconds of each step for each model; the steps of all models alternate."""
    trainers, names = {}, list(models)
    for name, model in models.items():
        density = DensityConfig(start=1.0, stop=1.0, rounds=1)  # adds and removes nothing before the last step
        config = TrainConfig(
            steps=steps + 1, max_gaussians=len(model), density=density, exposure=False, resolution_schedule=False
        )
        trainers[name] = Trainer(scene, config, model=model)
    seconds: dict[str, list[float]] = {name: [] for name in names}
    for step in range(steps):
        for name in names[step % len(names) :] + names[: step % len(names)]:
            start = time.process_time()
            trainers[name].run(stop=lambda: True)
            seconds[name].append(time.process_time() - start)
    return {name: values[WARMUP_STEPS:] for name, values in seconds.items()}


def measure_run_share(coords: np.ndarray, grid: HashGridConfig, group: int) -> float:
    """Return how many runs of points in the same cell there are for each point (N, 3), mean of levels.

    A run consists of consecutive points and ends with its group of points.
    """
    shares = []
    for resolution in grid.resolutions:
        cells = np.floor(coords * (resolution - 1)).reshape(-1, group, 3)
        starts = (np.diff(cells, axis=1) != 0).any(-1)
        shares.append((np.count_nonzero(starts) + len(cells)) / len(coords))
    return float(np.mean(shares))


def hash_rows(coords: np.ndarray, grid: HashGridConfig) -> np.ndarray:
    """Return the rows (levels, 8, N) within each level that points (N, 3) float32 of the cube read."""
    size, rows = 1 << grid.log2_table_size, []
    for resolution in grid.resolutions:
        cells = np.clip(np.floor(coords * (resolution - 1)), 0, resolution - 2).astype(np.int64)
        x, y, z = np.moveaxis(cells + CELL_CORNER_OFFSETS[:, None], -1, 0)
        dense = resolution**3 <= size
        hashed = (x ^ (y * PRIME_Y) ^ (z * PRIME_Z)) & (size - 1)
        rows.append(x + resolution * (y + resolution * z) if dense else hashed)
    return np.stack(rows)


def measure_distinct_share(values: np.ndarray) -> float:
    """Return the share of values (..., n) that are the first of their kind in their row."""
    ordered = np.sort(values, axis=-1)
    return float((np.count_nonzero(np.diff(ordered, axis=-1)) + ordered[..., 0].size) / ordered.size)


def count_rows(model: HybridModel, scene: Scene) -> tuple[float, ...]:
    """Return the shares of distinct rows of a block, of distinct sectors of an access, and of runs: thread, block."""
    visible_index = gaussians_in_view(model, scene.train[0].camera)
    coords = model.cube_coords(model.gaussians.positions.detach()[visible_index]).numpy()
    coords = coords[: len(coords) // POINTS_PER_BLOCK * POINTS_PER_BLOCK]
    rows = hash_rows(coords, model.config.radiance)
    levels = len(rows)
    blocks = (
        rows.reshape(levels, 8, -1, POINTS_PER_BLOCK).transpose(0, 2, 1, 3).reshape(levels, -1, 8 * POINTS_PER_BLOCK)
    )
    accesses = rows.reshape(levels, 8, -1, POINTS_PER_ACCESS) // ROWS_PER_SECTOR
    run_shares = (
        measure_run_share(coords, model.config.radiance, group) for group in (POINTS_PER_THREAD, POINTS_PER_BLOCK)
    )
    return measure_distinct_share(blocks), measure_distinct_share(accesses), *run_shares


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help="a data set")
    parser.add_argument("--model", type=Path, required=True, help="a model of that data set")
    parser.add_argument(
        "--gaussians",
        type=positive_integer,
        nargs="+",
        default=[20_000, 200_000],
        help="numbers of Gaussians (20,000 200,000)",
    )
    parser.add_argument("--steps", type=positive_integer, default=40, help="steps of each order (40)")
    options = parser.parse_args(arguments)
    scene = hyrfpack.load_scene(options.data)
    scene = dataclasses.replace(scene, train=scene.train[:MAX_PHOTOS], test=[])
    header = ["Gaussians", "order", "CPU s a step", "ratio", "quartiles", "distinct rows", "distinct sectors"]

    def measure(count: int) -> Iterator[list[str]]:
        model = resample_gaussians(hyrfpack.load_model(options.model), count)
        models = {name: copy.deepcopy(model.subset(order)) for name, order in make_orders(model).items()}
        shares = {name: count_rows(ordered, scene) for name, ordered in models.items()}
        seconds = measure_steps(scene, models, options.steps)
        for name, values in seconds.items():
            ratios = np.array(values) / seconds["file"]
            quartiles = " to ".join(f"{value:.3f}" for value in np.quantile(ratios, (0.25, 0.75)))
            median = f"{statistics.median(values):.4f}"
            counted = [f"{share:.3f}" for share in shares[name]]
            yield [f"{count:,}", name, median, f"{np.median(ratios):.3f}", quartiles, *counted]

    print_measured_table([*header, "runs, thread", "runs, block"], options.gaussians, measure)


if __name__ == "__main__":
    run_command(main)
