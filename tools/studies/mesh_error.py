"""Measure the error of exported meshes on scenes of known geometry, and on held-out views of photos.

    python -m tools.studies.mesh_error demo runs/demo.hyrf --photos runs/demo_photos
    python -m tools.studies.mesh_error points runs/bonsai/model.hyrf --photos data/bonsai

`demo` takes a model of the built-in scene, whose photos `hyrfpack.demo.scene.write_demo_scene` writes, and compares its
mesh with the spheres, boxes and the ground that were photographed. Accuracy is the distance from the mesh to the
nearest surface, completeness the distance from what the cameras see to the mesh, both in world units, and the normal
error is the angle between a triangle and the nearest surface. Completeness is measured in the box that an export would
choose for the true surfaces, the same for every mesh. `tools.studies.depth_error` measures rendered depths.

`points` compares depths in held-out views with the points of the reconstruction that were found there: of the mesh, and
of the model's own expected and median depth. Points are trained on as initial Gaussians, so they are not independent.

--mesh FILE measures another mesh in place of the export; --maps FILE writes the depth maps for other programs.

The results are in docs/research/mesh.md.
"""

from __future__ import annotations

import argparse
import resource
import time
from pathlib import Path

import numba
import numpy as np
import torch
import trimesh
from scipy.spatial import cKDTree

import hyrfpack
from hyrfpack.cameras.paths import Viewpoint
from hyrfpack.demo.scene import NO_HIT_DISTANCE, SOLID_SHAPES, find_nearest_hit
from hyrfpack.export.source import Source
from hyrfpack.mesh import Mesh, extract_mesh
from hyrfpack.mesh.bounds import choose_default_box
from hyrfpack.mesh.depth_maps import render_depth_maps
from hyrfpack.mesh.extract import MAX_MAPS
from hyrfpack.ops.rasterize import RasterSettings, cpu
from hyrfpack.ops.rasterize.median_depth import MAX_PLANE_DEPTH_RATIO
from hyrfpack.render import render_view
from hyrfpack.render.renderer import RenderSettings
from hyrfpack.render.surface import render_median_depth
from hyrfpack.scene import Camera, Scene, evenly_spaced
from tools.command import run_command
from tools.tables import format_cell, markdown_table

MESH_SAMPLES = 500_000
SURFACE_RAYS_PER_CAMERA = 6_000
HIT_LIMIT = 0.02  # world units of the demo scene, about the size of a pixel


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kind", choices=("demo", "points"), help="what the mesh is compared with")
    parser.add_argument("model", type=Path, help="a .hyrf file")
    parser.add_argument("--photos", type=Path, required=True, help="folder of the model's photos")
    parser.add_argument("--voxel", type=float, help="side of a voxel, world units")
    parser.add_argument("--faces", type=int, help="largest number of triangles")
    parser.add_argument("--mesh", type=Path, help="measure this mesh instead of extracting one")
    parser.add_argument("--coarse", action="store_true", help="use the cameras that the file keeps, not the photos'")
    parser.add_argument("--maps", type=Path, help="write the depth maps to this .npz and stop")
    arguments = parser.parse_args()

    scene = hyrfpack.load_scene(arguments.photos)
    source = Source.read(arguments.model, None if arguments.coarse else scene)
    if arguments.maps:
        write_maps(source, arguments.maps)
        return
    start, processor = time.perf_counter(), time.process_time()
    if arguments.mesh:
        loaded = trimesh.load(arguments.mesh, process=False)
        mesh = Mesh(np.asarray(loaded.vertices), np.asarray(loaded.faces), np.zeros((0, 3), np.uint8), 0.0, 0.0, 0)
    else:
        mesh = extract_mesh(
            source.model, source.fit_cameras, source.center, voxel=arguments.voxel, faces=arguments.faces
        )
    seconds, processor = time.perf_counter() - start, time.process_time() - processor
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    print(
        f"{arguments.model}: {len(source.model):,} Gaussians, {mesh.maps} maps, {len(mesh.faces):,} triangles, voxel "
        f"{mesh.voxel:.4g}, truncation {mesh.truncation:.4g}"
    )
    print(f"{seconds:.1f} s (CPU time {processor:.1f} s), peak {memory / 1e9:.2f} GB\n")
    if arguments.kind == "demo":
        print_demo_error(mesh, scene)
    else:
        print_point_error(source, mesh, scene)


def write_maps(source: Source, path: Path) -> None:
    """Write depth, weight, colours, intrinsics and poses of the maps that a mesh is fused from."""
    maps = list(render_depth_maps(source.model, evenly_spaced(source.fit_cameras, MAX_MAPS), "as-photographed"))
    np.savez_compressed(
        path,
        depth=np.stack([np.where(m.weight > 0, m.depth, 0) for m in maps]),
        colors=np.stack([m.colors for m in maps]),
        intrinsics=np.array([m.camera.intrinsics for m in maps]),
        poses=np.stack([m.camera.camera_from_world for m in maps]),
    )


def find_nearest_surface(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the distance (N,) of points (N, 3) to the demo scene's nearest surface, and its normals (N, 3) there."""
    best, normals = np.abs(points[:, 2]), np.tile((0.0, 0.0, 1.0), (len(points), 1))
    for solid in SOLID_SHAPES:
        local = (points - solid.center) @ solid.object_from_world.T.astype(np.float64)
        half = np.array(solid.half)
        if solid.box:
            excess = np.abs(local) - half
            outside = np.maximum(excess, 0)
            distance = np.where(excess.max(axis=1) > 0, np.linalg.norm(outside, axis=1), -excess.max(axis=1))
            axis = excess.argmax(axis=1)
            normal = np.zeros_like(local)
            normal[np.arange(len(local)), axis] = np.sign(local[np.arange(len(local)), axis])
        else:
            radius = np.linalg.norm(local, axis=1)
            distance, normal = np.abs(radius - half[0]), local / np.maximum(radius, 1e-12)[:, None]
        closer = distance < best
        best[closer], normals[closer] = distance[closer], (normal @ solid.object_from_world)[closer]
    return best, normals


def make_rays(camera: Camera) -> np.ndarray:
    """Return the ray (H, W, 3) of each pixel in camera axes; the depth of its end is 1."""
    x, y = np.meshgrid(np.arange(camera.width) + 0.5 - camera.cx, np.arange(camera.height) + 0.5 - camera.cy)
    return np.stack((x / camera.fx, y / camera.fy, np.ones(x.shape)), axis=-1)


def compute_demo_depth(camera: Camera) -> np.ndarray:
    """Return the depth (H, W) of the demo scene along the view axis; infinite in the sky."""
    rays = make_rays(camera).reshape(-1, 3) @ camera.rotation
    lengths = np.linalg.norm(rays, axis=1)
    directions = np.ascontiguousarray((rays / lengths[:, None]).T, np.float32)
    origins = np.ascontiguousarray(np.broadcast_to(camera.position[:, None], directions.shape), np.float32)
    distance, _ = find_nearest_hit(origins, directions)
    depth = np.where(distance < NO_HIT_DISTANCE, distance / lengths, np.inf)
    return depth.reshape(camera.height, camera.width)


def is_in_box(points: np.ndarray, scene: Scene) -> np.ndarray:
    """Return whether known surface points (N, 3) lie in the box (N,) that an export would choose for these surfaces.

    The box depends on the points and the cameras alone, so that all meshes of a scene are compared at the same points.
    """
    cameras = [view.camera for view in scene.train]
    positions = np.array([camera.position for camera in cameras])
    low, high = choose_default_box(points, Viewpoint.from_cameras(cameras).center, positions)
    return ((points >= low) & (points <= high)).all(axis=1)


def print_demo_error(mesh: Mesh, scene: Scene) -> None:
    """Print accuracy, completeness and normal error of a mesh of the demo scene."""
    shape = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    samples, faces = trimesh.sample.sample_surface(shape, MESH_SAMPLES, seed=0)
    accuracy, normals = find_nearest_surface(samples)
    angles = np.degrees(np.arccos(np.clip((shape.face_normals[faces] * normals).sum(axis=1), -1, 1)))
    visible_points = np.concatenate([sample_visible_points(view.camera) for view in scene.train])
    visible_points = visible_points[is_in_box(visible_points, scene)]
    completeness, _ = cKDTree(samples).query(visible_points)
    precision, recall = (accuracy < HIT_LIMIT).mean(), (completeness < HIT_LIMIT).mean()
    rows = [
        ["accuracy", *format_statistics(accuracy)],
        ["completeness", *format_statistics(completeness)],
        ["normal error (degrees)", *format_statistics(angles)],
    ]
    print(markdown_table(["", "mean", "median", "95 %"], rows))
    print(
        f"\nchamfer distance {(accuracy.mean() + completeness.mean()) / 2:.5f}; within {HIT_LIMIT}: precision "
        f"{precision:.3f}, recall {recall:.3f}\n"
    )


def sample_visible_points(camera: Camera) -> np.ndarray:
    """Return points (n, 3) of the demo scene's surfaces that a camera sees, evenly over its picture."""
    depth = compute_demo_depth(camera)
    stride = max(1, round((depth.size / SURFACE_RAYS_PER_CAMERA) ** 0.5))
    rows, columns = np.nonzero(np.isfinite(depth[::stride, ::stride]))
    rows, columns = stride * rows, stride * columns
    return camera.unproject(columns + 0.5, rows + 0.5, depth[rows, columns])


def render_depths(source: Source, camera: Camera) -> dict[str, np.ndarray]:
    """Render the depths (H, W) of a view: expected, median of centres, and median of planes."""
    model = source.model
    with torch.no_grad():
        decoded = model.decode()
        rendered = render_view(model, camera, decoded=decoded, depth=True)
        index = rendered.indices[rendered.visible]
        planes = render_median_depth(model, camera, decoded, index, RenderSettings())
        viewport = model.config.frame.local_viewport(camera)
        gaussians = decoded.geometry[index].with_means(model.gaussians.positions[index])
        settings = RasterSettings(antialiased=model.config.antialiased)
        flat = torch.zeros_like(gaussians.means)
        centers = cpu.median_depth(gaussians, flat, MAX_PLANE_DEPTH_RATIO, viewport, settings)
    assert rendered.depth is not None
    scale = model.config.frame.scale
    return {
        "expected": rendered.depth.numpy(),
        "median, centres": scale * centers.numpy(),
        "median, planes": planes.numpy(),
    }


def print_point_error(source: Source, mesh: Mesh, scene: Scene) -> None:
    """Print the errors of depths at the points that were found in held-out views, relative to the depth."""
    errors: dict[str, list[np.ndarray]] = {}
    shares: dict[str, list[np.ndarray]] = {}
    is_in_export_box = is_in_box(scene.points, scene)
    for view in scene.test:
        tracks = scene.tracks[view.name]
        points = scene.points[tracks[is_in_export_box[tracks]]]
        u, v, z = view.camera.project(points)
        inside = view.camera.in_picture(u, v, z)
        rows, columns, z = v[inside].astype(int), u[inside].astype(int), z[inside]
        depths = {"mesh": draw_depth(mesh, view.camera), **render_depths(source, view.camera)}
        for name, depth in depths.items():
            measured = depth[rows, columns]
            has_depth = np.isfinite(measured) & (measured > 0)
            errors.setdefault(name, []).append(np.abs(measured[has_depth] - z[has_depth]) / z[has_depth])
            shares.setdefault(name, []).append(has_depth)
    rows_out = []
    for name, parts in errors.items():
        all_errors, has_depth = np.concatenate(parts), np.concatenate(shares[name])
        rows_out.append(
            [name, f"{has_depth.mean():.3f}", *format_statistics(all_errors), f"{(all_errors < 0.02).mean():.3f}"]
        )
    total = sum(len(part) for part in shares["mesh"])
    columns = [f"depth at {total:,} points", "with depth", "mean", "median", "95 %", "within 2 %"]
    print(markdown_table(columns, rows_out) + "\n")


def draw_depth(mesh: Mesh, camera: Camera) -> np.ndarray:
    """Draw the depth (H, W) of a mesh; infinite where there is none."""
    x, y, z = (mesh.vertices @ camera.rotation.T + camera.camera_from_world[:3, 3]).T
    safe = np.where(z > 1e-6, z, np.nan)
    corners = np.stack((camera.fx * x / safe + camera.cx, camera.fy * y / safe + camera.cy, z), axis=1)
    depth = np.full((camera.height, camera.width), np.inf)
    _draw_triangles(corners, mesh.faces, depth)
    return depth


@numba.njit
def _draw_triangles(corners, faces, depth):
    height, width = depth.shape
    for face in range(len(faces)):
        a, b, c = corners[faces[face, 0]], corners[faces[face, 1]], corners[faces[face, 2]]
        area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
        if not abs(area) > 0:  # also for corners behind the camera
            continue
        left, right = max(0, int(min(a[0], b[0], c[0]))), min(width - 1, int(max(a[0], b[0], c[0])))
        top, bottom = max(0, int(min(a[1], b[1], c[1]))), min(height - 1, int(max(a[1], b[1], c[1])))
        for row in range(top, bottom + 1):
            for column in range(left, right + 1):
                x, y = column + 0.5, row + 0.5
                u = ((b[0] - x) * (c[1] - y) - (b[1] - y) * (c[0] - x)) / area
                v = ((c[0] - x) * (a[1] - y) - (c[1] - y) * (a[0] - x)) / area
                w = 1 - u - v
                if u >= 0 and v >= 0 and w >= 0:
                    depth[row, column] = min(depth[row, column], 1 / (u / a[2] + v / b[2] + w / c[2]))


def format_statistics(values: np.ndarray) -> list[str]:
    """Return mean, median and 95th percentile as cells of a table."""
    return [format_cell(float(number)) for number in (values.mean(), np.median(values), np.quantile(values, 0.95))]


if __name__ == "__main__":
    run_command(main)
