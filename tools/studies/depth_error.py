"""Measure the error of rendered depths and normals on scenes of known geometry, in held-out views.

    python -m tools.studies.depth_error demo runs/demo/model.hyrf --photos runs/demo_photos
    python -m tools.studies.depth_error room runs/room/model.hyrf --photos sets/room

`demo` is the built-in scene, whose photos `hyrfpack.demo.scene.write_demo_scene` writes, up to a depth of 6 units; the
others are sets that `tools.scenes.write_set` writes with the seed 0. Depths are compared at pixels that have a median
depth, relative to the true depth. Normals are those of `render --normals`, and of its two parts alone.

The results are in docs/research/mesh.md.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

import hyrfpack
from hyrfpack.model import HybridModel
from hyrfpack.render import RenderSettings, render_view, surface
from hyrfpack.scene import Camera, Scene
from tools.command import run_command
from tools.scenes.catalog import LAYOUTS, make_scene
from tools.scenes.render import cast_pixels
from tools.studies.mesh_error import compute_demo_depth, find_nearest_surface, format_statistics, make_rays
from tools.tables import markdown_table

MAX_DEMO_DEPTH = 6
SMALL_ANGLE_DEGREES = 11.25
# Weights of the normals from depth, beside the axes of Gaussians.
DEPTH_NORMAL_WEIGHTS = {
    "axes of Gaussians alone": 0.0,
    "from depth alone": 1e9,
    "`render --normals`": surface.DEPTH_NORMAL_WEIGHT,
}

# Returns the depth (H, W) of a view, infinite where it is not compared, and the normals (H, W, 3) in world axes.
Geometry = Callable[[Camera], tuple[np.ndarray, np.ndarray]]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kind", choices=("demo", *LAYOUTS), help="the scene of known geometry")
    parser.add_argument("model", type=Path, help="a .hyrf file")
    parser.add_argument("--photos", type=Path, required=True, help="folder of the model's photos")
    arguments = parser.parse_args()

    scene = hyrfpack.load_scene(arguments.photos)
    geometry = compute_demo_geometry if arguments.kind == "demo" else make_set_geometry(arguments.kind, scene)
    print_errors(hyrfpack.load_model(arguments.model), [view.camera for view in scene.test], geometry)


def compute_demo_geometry(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Return depth and normals of the built-in scene."""
    depth = compute_demo_depth(camera)
    depth[depth >= MAX_DEMO_DEPTH] = np.inf
    points = make_rays(camera) * np.where(np.isfinite(depth), depth, 1)[..., None] - camera.camera_from_world[:3, 3]
    _, normals = find_nearest_surface((points @ camera.rotation).reshape(-1, 3))
    return depth, normals.reshape(*depth.shape, 3)


def make_set_geometry(name: str, scene: Scene) -> Geometry:
    """Return the function that casts the rays of a view of a generated set."""
    camera = scene.views[0].camera
    arrays = make_scene(name, len(scene.views), camera.width, camera.height, 0).arrays

    def cast(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
        x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
        depth, _, normals = cast_pixels(arrays, camera, np.stack((x.ravel(), y.ravel()), axis=1))
        return depth.reshape(x.shape), normals.reshape(*x.shape, 3)

    return cast


@torch.no_grad()
def print_errors(model: HybridModel, cameras: list[Camera], geometry: Geometry) -> None:
    """Print tables of the errors of depths and of normals."""
    depth_errors: dict[str, list[np.ndarray]] = {"expected": [], "median": []}
    angles: dict[str, list[np.ndarray]] = {name: [] for name in DEPTH_NORMAL_WEIGHTS}
    decoded, frame = model.decode(), model.config.frame
    settings = RenderSettings().raster_settings(model.config.antialiased)
    for camera in cameras:
        exact, exact_normals = geometry(camera)
        rendered = render_view(model, camera, decoded=decoded, depth=True)
        assert rendered.depth is not None
        gaussians, _ = surface.drawn_gaussians(model, camera, decoded, rendered.indices[rendered.visible])
        depth, _ = surface.render_surface(gaussians, frame, camera, settings, normals=False)
        has_depth = np.isfinite(exact) & (depth.numpy() > 0)
        for name, measured in (("expected", rendered.depth), ("median", depth)):
            depth_errors[name].append(np.abs(measured.numpy() - exact)[has_depth] / exact[has_depth])
        rays = make_rays(camera) @ camera.rotation
        faces_away = (exact_normals * rays).sum(axis=-1, keepdims=True) > 0
        exact_normals = np.where(faces_away, -exact_normals, exact_normals)
        for name, weight in DEPTH_NORMAL_WEIGHTS.items():
            normals = surface.render_normals(gaussians, depth, frame, camera, settings, depth_weight=weight)
            cosines = (normals.numpy() * exact_normals).sum(axis=-1)[has_depth]
            angles[name].append(np.degrees(np.arccos(cosines.clip(-1, 1))))
    rows = [[name, *format_statistics(np.concatenate(parts))] for name, parts in depth_errors.items()]
    print(markdown_table(["depth, relative error", "mean", "median", "95 %"], rows) + "\n")
    rows = []
    for name, parts in angles.items():
        joined = np.concatenate(parts)
        rows.append([name, *format_statistics(joined), f"{(joined < SMALL_ANGLE_DEGREES).mean():.3f}"])
    print(markdown_table(["normals, degrees", "mean", "median", "95 %", f"within {SMALL_ANGLE_DEGREES}"], rows))


if __name__ == "__main__":
    run_command(main)
