"""Small synthetic scenes: coloured balls, ray-cast in numpy, and cameras around them. Nothing is read from disk."""

from __future__ import annotations

import dataclasses

import numpy as np
import torch

from hyrfpack.context import RunContext
from hyrfpack.model import Frame, HashGridConfig, HybridModel, ModelConfig
from hyrfpack.model.gaussians import Gaussians
from hyrfpack.scene import Camera, Picture, Scene, View

QUIET_CONTEXT = RunContext(progress=None)
BALL_CENTERS = np.array([[-0.5, 0.0, 0.0], [0.45, 0.3, 0.1], [0.1, -0.5, -0.2]])
BALL_RADII = np.array([0.45, 0.35, 0.3])
BALL_COLORS = np.array([[0.9, 0.2, 0.1], [0.1, 0.8, 0.3], [0.2, 0.3, 0.9]])
SKY_COLOR = np.array([0.5, 0.6, 0.7])


def look_at(position, target, up=(0.0, 0.0, 1.0)) -> np.ndarray:
    """Return camera_from_world (4, 4) of a camera at `position` that looks at `target`."""
    position = np.asarray(position, np.float64)
    forward = np.asarray(target, np.float64) - position
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = right, np.cross(forward, right), forward
    pose[:3, 3] = -pose[:3, :3] @ position
    return pose


def camera_at(position, target=(0, 0, 0), up=(0, 0, 1), *, width=32, height=32, focal=None) -> Camera:
    """Return a centred pinhole camera with a field of view of 53 degrees, or with this focal length in pixels."""
    focal = float(focal or width)
    return Camera(width, height, focal, focal, width / 2, height / 2, look_at(position, target, up))


def ring(count: int, radius: float = 3.0, elevation: float = 1.0, **options) -> list[Camera]:
    """Return cameras on a circle around the z axis, all looking at the origin."""
    angles = 2 * np.pi * np.arange(count) / count
    return [camera_at((radius * np.cos(a), radius * np.sin(a), elevation), **options) for a in angles]


def shift_cameras(cameras, offset) -> list[Camera]:
    """Return the cameras shifted by `offset` (3,) in world units."""
    result = []
    for camera in cameras:
        pose = camera.camera_from_world.copy()
        pose[:3, 3] -= pose[:3, :3] @ np.asarray(offset)
        result.append(Camera(camera.width, camera.height, *camera.intrinsics, pose))
    return result


def photograph(camera: Camera, *, scale: float = 1.0, offset=(0, 0, 0), alpha: bool = False) -> Picture:
    """Ray-cast the balls, lit from above, under a uniform sky (with `alpha`: with no coverage there)."""
    columns, rows = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    rays = np.stack([(columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy, np.ones_like(columns)], -1)
    rays = rays @ camera.rotation
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    nearest = np.full(columns.shape, np.inf)
    rgb = np.broadcast_to(SKY_COLOR, (*columns.shape, 3)).copy()
    for center, radius, color in zip(BALL_CENTERS * scale + offset, BALL_RADII * scale, BALL_COLORS, strict=True):
        along = rays @ (center - camera.position)
        inside = along**2 - np.sum((center - camera.position) ** 2) + radius**2
        distance = along - np.sqrt(np.maximum(inside, 0))
        hit = (inside > 0) & (distance > 0) & (distance < nearest)
        nearest[hit] = distance[hit]
        normal = (camera.position + distance[..., None] * rays - center) / radius
        rgb[hit] = (color * (0.75 + 0.25 * normal[..., 2:]))[hit]
    covered = np.isfinite(nearest)
    return Picture((rgb * 255).round().astype(np.uint8), (255 * covered).astype(np.uint8) if alpha else None)


def ball_points(count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return points (N, 3) on the balls and their colours (N, 3)."""
    generator = np.random.default_rng(seed)
    which = generator.integers(len(BALL_RADII), size=count)
    normals = generator.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    points = BALL_CENTERS[which] + BALL_RADII[which, None] * normals
    return points, (BALL_COLORS[which] * (0.75 + 0.25 * normals[:, 2:])).astype(np.float32)


def view_of(name: str, camera: Camera, picture: Picture) -> View:
    """Return a view whose picture is already in memory."""
    return View(name, camera, lambda: picture)


def ball_scene(
    views: int = 8, points: int = 100, *, side: int = 32, scale: float = 1.0, offset=(0, 0, 0), alpha: bool = False
) -> Scene:
    """Return a scene of the balls seen from a ring, scaled by `scale` and then shifted by `offset`."""
    named = []
    for number, camera in enumerate(ring(views, width=side, height=side)):
        pose = camera.camera_from_world.copy()
        pose[:3, 3] = scale * pose[:3, 3] - pose[:3, :3] @ np.asarray(offset, np.float64)
        camera = Camera(side, side, *camera.intrinsics, pose)
        named.append(view_of(f"{number:03d}.png", camera, photograph(camera, scale=scale, offset=offset, alpha=alpha)))
    positions, colors = ball_points(points)
    return Scene("balls", "colmap", named, [], positions * scale + offset, colors, has_alpha=alpha)


def small_model(
    positions,
    *,
    frame: Frame | None = None,
    fields: float = 0.0,
    color_logits=0.0,
    scale_logits=-3.0,
    opacity_logits=2.0,
    seed: int = 0,
    **settings,
) -> HybridModel:
    """Return a model with small hash tables. `fields` scales the output of both fields; 0 makes it exactly 0."""
    positions = torch.as_tensor(np.asarray(positions), dtype=torch.float32).reshape(-1, 3)
    count = len(positions)
    frame = frame or Frame((0.0, 0.0, 0.0), 1.0, (1.0, 1.0, 1.0))
    grid = HashGridConfig(log2_table_size=7, levels=3, base=3, finest=12)
    settings = {"background": False, "hidden": 16, **settings}
    config = ModelConfig(frame=frame, geometry=grid, radiance=grid, **settings)

    def filled(value, width):
        return torch.as_tensor(value, dtype=torch.float32).expand(count, width).clone()

    gaussians = Gaussians(positions, filled(color_logits, 3), filled(scale_logits, 1), filled(opacity_logits, 1))
    model = HybridModel(config, gaussians, torch.Generator().manual_seed(seed))
    generator = torch.Generator().manual_seed(seed + 1)
    with torch.no_grad():
        for part in (model.geometry, model.radiance):
            part.grid.table.copy_(torch.rand(part.grid.table.shape, generator=generator) * 2 - 1)
            part.biases[-1].copy_(torch.rand(part.biases[-1].shape, generator=generator) - 0.5)
            part.weights[-1].mul_(fields)
            part.biases[-1].mul_(fields)
    return model


def visible_points_by_photo(scene: Scene, facing: float = 0.5) -> dict[str, np.ndarray]:
    """Return, by training photo, the indices of the points on balls that it sees.

    A point counts where the cosine between its normal and the direction to the camera exceeds `facing`.
    """
    # Index of the ball that each point lies on.
    centers = np.argmin(np.abs(np.linalg.norm(scene.points[:, None] - BALL_CENTERS, axis=2) - BALL_RADII), axis=1)
    normals = (scene.points - BALL_CENTERS[centers]) / BALL_RADII[centers, None]
    tracks = {}
    for view in scene.train:
        rays = scene.points - view.camera.position
        distance = np.linalg.norm(rays, axis=1)
        rays /= distance[:, None]
        free = -(rays * normals).sum(1) > facing
        for ball, (center, radius) in enumerate(zip(BALL_CENTERS, BALL_RADII, strict=True)):
            along = rays @ (center - view.camera.position)
            missed = along**2 - np.sum((center - view.camera.position) ** 2) + radius**2 < 0
            free &= missed | (along > distance) | (centers == ball)
        tracks[view.name] = np.flatnonzero(free)
    return tracks


def expose_picture(picture: Picture, gains) -> Picture:
    """Return the photo with its odds y / (1 - y) multiplied by `gains` (one or three)."""
    odds = picture.rgb / np.maximum(255.0 - picture.rgb, 1e-9) * gains
    return dataclasses.replace(picture, rgb=(255 * odds / (1 + odds)).round().astype(np.uint8))


def exposed_scene(gains: np.ndarray, side: int = 64, points: int = 300) -> Scene:
    """Return the scene of the balls in photos with these gains (N, 1) or (N, 3), with tracks."""
    scene = ball_scene(len(gains), points, side=side)
    views = [view_of(v.name, v.camera, expose_picture(v.load(), g)) for v, g in zip(scene.train, gains, strict=True)]
    return dataclasses.replace(scene, train=views, tracks=visible_points_by_photo(scene))


def alternating_gains(count: int, stops: float = 0.5) -> np.ndarray:
    """Return (N, 1) gains that make middle grey alternately `stops` lighter and darker (light = value ** 2.2)."""
    lighter = 0.5 * 2 ** (np.where(np.arange(count) % 2, -stops, stops) / 2.2)
    return (lighter / (1 - lighter))[:, None]
