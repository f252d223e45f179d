"""Measure how long mesh export takes, and its memory, for models of many Gaussians on known surfaces.

    python -m tools.studies.mesh_scale 10000 100000 1000000 --out runs/mesh_scale

Each model has opaque round Gaussians at random places on five balls that stand on a disk, as large as covers these
without holes, and 100 cameras of 800 x 600 pixels around them. `hyrfpack export` runs in a process of its own, whose
peak memory is that of the operating system. Errors are distances of the vertices from the surfaces, in per cent of the
radius of a ball. Each process has one thread unless HYRFPACK_THREADS says otherwise.

The results are in docs/research/mesh.md.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import torch
import trimesh

from hyrfpack.cameras.capture import provenance_cameras
from hyrfpack.cameras.paths import Viewpoint, look_at
from hyrfpack.format import save_model
from hyrfpack.model import Frame, HashGridConfig, HybridModel, ModelConfig
from hyrfpack.model.gaussians import Gaussians, logit
from hyrfpack.scene import Camera
from tools.command import positive_integer, run_command
from tools.tables import markdown_row, markdown_table

BALL_RADIUS = 1.0
BALL_CENTERS = np.array([[0.0, 0.0, 1.0], [2.6, 0.0, 1.0], [-2.6, 0.0, 1.0], [0.0, 2.6, 1.0], [0.0, -2.6, 1.0]])
DISK_RADIUS = 5.0
CAMERAS, WIDTH, HEIGHT, FOCAL = 100, 800, 600, 700.0
SIZE_PER_SPACING = 0.6  # standard deviation of a Gaussian, per side of the square that it covers
OPACITY = 0.95


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("counts", type=positive_integer, nargs="+", help="numbers of Gaussians")
    parser.add_argument("--endings", nargs="+", default=[".mesh.ply", ".collision.obj"], help="what to export")
    parser.add_argument("--seed", type=int, default=0, help="random seed (0)")
    parser.add_argument("--out", type=Path, default=Path("runs/mesh_scale"), help="folder for models (runs/mesh_scale)")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    rows = []
    for count in arguments.counts:
        model = arguments.out / f"{count}.hyrf"
        write_model(model, count, arguments.seed)
        for ending in arguments.endings:
            rows.append([f"{count:,}", ending, *measure(model, model.with_suffix(ending))])
            print(markdown_row(rows[-1]), flush=True)
    head = ["Gaussians", "export", "triangles", "wall time", "CPU time", "peak memory", "error: median, 95 %"]
    print(markdown_table(head, rows))
    print(f"load averages of 1, 5 and 15 minutes at the end: {os.getloadavg()}")


def write_model(path: Path, count: int, seed: int) -> None:
    """Write a model of Gaussians on the surfaces."""
    generator = np.random.default_rng(seed)
    ball_area, disk_area = 4 * np.pi * BALL_RADIUS**2, np.pi * DISK_RADIUS**2
    area = ball_area * len(BALL_CENTERS) + disk_area
    on_disk = round(count * disk_area / area)
    angles, radii = generator.uniform(0, 2 * np.pi, on_disk), DISK_RADIUS * np.sqrt(generator.uniform(0, 1, on_disk))
    disk = np.stack((radii * np.cos(angles), radii * np.sin(angles), np.zeros(on_disk)), 1)
    normals = generator.normal(size=(count - on_disk, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    balls = BALL_CENTERS[generator.integers(len(BALL_CENTERS), size=len(normals))] + BALL_RADIUS * normals
    positions = np.concatenate((disk, balls))
    frame = Frame((0.0, 0.0, 0.0), DISK_RADIUS, (1.0, 1.0, 1.0))
    grid = HashGridConfig(log2_table_size=10, levels=2, base=4, finest=16)
    colors = 2 * np.sin(positions)  # any that change smoothly
    size = torch.tensor(SIZE_PER_SPACING * np.sqrt(area / count) / frame.scale)
    gaussians = Gaussians(
        torch.from_numpy(frame.to_local(positions)).float(),
        torch.from_numpy(colors).float(),
        logit(size).expand(count, 1),
        logit(torch.tensor(OPACITY)).expand(count, 1),
    )
    model = HybridModel(ModelConfig(frame=frame, geometry=grid, radiance=grid, hidden=16, background=False), gaussians)
    with torch.no_grad():
        for parameter in (*model.geometry.parameters(), *model.radiance.parameters()):
            parameter.zero_()
    cameras = make_cameras()
    provenance = {"cameras": provenance_cameras(cameras), "viewpoint": Viewpoint.from_cameras(cameras).to_json()}
    save_model(model, path, provenance=provenance)


def make_cameras() -> list[Camera]:
    """Return cameras at three heights around the balls."""
    cameras = []
    for number in range(CAMERAS):
        angle, height = 2 * np.pi * number / CAMERAS, (2.0, 4.0, 6.5)[number % 3]
        position = np.array((8 * np.cos(angle), 8 * np.sin(angle), height))
        pose = look_at(position, np.array((0.0, 0.0, 0.7)), np.array((0.0, 0.0, 1.0)))
        cameras.append(Camera(WIDTH, HEIGHT, FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2, pose))
    return cameras


def measure_surface_distances(points: np.ndarray) -> np.ndarray:
    """Return the distances (N,) of points (N, 3) to the nearest ball or the disk."""
    to_balls = np.abs(np.linalg.norm(points[:, None] - BALL_CENTERS, axis=2) - BALL_RADIUS).min(1)
    beyond_edge = np.maximum(np.linalg.norm(points[:, :2], axis=1) - DISK_RADIUS, 0)
    return np.minimum(to_balls, np.hypot(beyond_edge, points[:, 2]))


def measure(model: Path, target: Path) -> list[str]:
    """Export a mesh in a process of its own; return its triangles, seconds, peak memory and errors."""
    command = [sys.executable, "-m", "hyrfpack", "export", str(model), "-o", str(target), "--overwrite"]
    start = time.perf_counter()
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, env={"HYRFPACK_THREADS": "1", **os.environ})
    _, status, usage = os.wait4(process.pid, 0)
    wall = time.perf_counter() - start
    if status:
        return ["failed", f"{wall:.0f} s", "", f"{usage.ru_maxrss * 1024 / 1e9:.2f} GB", ""]
    mesh = trimesh.load(target, process=False)
    vertices = np.asarray(mesh.vertices)
    errors = 100 / BALL_RADIUS * measure_surface_distances(vertices)
    cpu = usage.ru_utime + usage.ru_stime
    memory = f"{usage.ru_maxrss * 1024 / 1e9:.2f} GB"
    error_text = f"{np.median(errors):.2f}, {np.quantile(errors, 0.95):.2f} %"
    return [f"{len(mesh.faces):,}", f"{wall:.0f} s", f"{cpu:.0f} s", memory, error_text]


if __name__ == "__main__":
    run_command(main)
