"""The last stage: one of the mappers' results is chosen, completed, and made the scene's own."""

from __future__ import annotations

import os
import shutil
from collections import Counter
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pycolmap

from hyrfpack.data.pictures import fit_size, read_pixels
from hyrfpack.poses.choose import Candidate, choose, confirmed, doubt
from hyrfpack.poses.compare import Poses
from hyrfpack.poses.database import opened, verified_pairs
from hyrfpack.poses.evidence import Matches, evidence
from hyrfpack.poses.job import Job
from hyrfpack.poses.mapping import SMALLEST, THREADS, add_points, go_on, read_pieces
from hyrfpack.poses.process import Tell

_BENT = 0.99  # times the reprojection error with one coefficient of distortion: what four must do better than
_MANY = 20  # photos of a camera, from which on four are found
_STRAIGHT = 1.003  # times that error: what none may do worse
_DOUBTED = 0.5  # pixels off, from which on an observation counts less: poses err by a third less than without
_AS_GOOD = 0.997  # of what a result explains: enough for the lens that fits it
_COLORED = 400  # pixels of the longer side of the pictures that points take their colours from


def finish(job: Job, models: list[str], tell: Tell) -> dict[str, Any]:
    """Choose between the mappers' results, complete the chosen one, and save it as `job.model("chosen")`.

    Args:
        job: the estimation.
        models: names of the results.
        tell: see `run_stage`.

    Returns:
        "registered", "sure", "apart" (posed in another piece): names of photos; "mapper", "why", "doubt"; "angle": the
        median of the largest angles in degrees between rays that meet in a point. Without any photo posed,
        "registered" alone, empty.
    """
    tell("comparing the results", 0.0)
    pieces = {name: read_pieces(job.model(name)) for name in models}
    pieces = {name: found for name, found in pieces.items() if found and found[0].num_reg_images() >= SMALLEST}
    if not pieces:
        return {"registered": []}
    found = {_candidate(job, name, models): models[0] for name, models in pieces.items()}
    best: dict[str, Candidate] = {}  # of each mapper
    for candidate in sorted(found, key=lambda candidate: candidate.explained):
        best[candidate.mapper] = candidate
    chosen, why = choose(list(best.values()), _count_matches(job))
    other = next((candidate for candidate in best.values() if candidate is not chosen), None)
    model, poses, explained = found[chosen], chosen.poses, chosen.explained
    steps: list[tuple[str, float, Callable[[pycolmap.Reconstruction], pycolmap.Reconstruction], float]] = [
        ("looking for poses of the other photos", 0.1, partial(go_on, job), 1.0),
        ("adding points that two photos see", 0.4, partial(add_points, job), 1.0),
        ("finding the lens distortion", 0.5, partial(_with_fitting_lens, tell=tell), _AS_GOOD),
    ]
    for doing, share, refine, least in steps:
        tell(doing, share)
        refined = refine(model)
        its_poses = _poses(job, refined)
        its_explained = evidence(its_poses, _matches(job, refined))
        if len(its_poses) >= len(poses) and its_explained >= least * explained:
            model, poses, explained = refined, its_poses, its_explained
    _enlarge(job, model)
    _color(job, model, tell)
    _save(job, model)
    apart = {name for candidate in best.values() for piece in candidate.apart for name in piece}
    return {
        "registered": sorted(poses),
        "sure": sorted(confirmed(poses, other)),
        "apart": sorted(apart - set(poses)),
        "mapper": chosen.mapper,
        "why": why,
        "doubt": doubt(poses, other),
        "angle": _median_angle(model),
    }


def _candidate(job: Job, name: str, pieces: list[pycolmap.Reconstruction]) -> Candidate:
    first, *others = pieces
    poses = _poses(job, first)
    return Candidate(
        name.partition("-")[0],
        poses,
        [_poses(job, piece) for piece in others if piece.num_reg_images() >= SMALLEST],
        evidence(poses, _matches(job, first)),
        first.compute_mean_track_length(),
        first.compute_mean_reprojection_error(),
    )


def _poses(job: Job, model: pycolmap.Reconstruction) -> Poses:
    posed = (image for image in model.images.values() if image.has_pose)
    return {job.names[image.image_id - 1]: np.asarray(image.cam_from_world().matrix()) for image in posed}


def _count_matches(job: Job) -> int:
    with opened(job) as database:
        return sum(len(matches) for _, _, matches, _ in verified_pairs(database))


def _matches(job: Job, model: pycolmap.Reconstruction) -> list[Matches]:
    """The verified matches between the posed photos of a model, as rays of its cameras."""
    rays, pixel = {}, {}
    with opened(job) as database:
        for image in model.images.values():
            if image.has_pose:
                camera = model.cameras[image.camera_id]
                pixels = np.asarray(database.read_keypoints(image.image_id))[:, :2].astype(np.float64)
                rays[image.image_id] = np.asarray(camera.cam_from_img(pixels)).reshape(-1, 2)
                pixel[image.image_id] = 1 / camera.mean_focal_length()
        return [
            Matches(
                job.names[first - 1],
                job.names[second - 1],
                rays[first][matches[:, 0]],
                rays[second][matches[:, 1]],
                (pixel[first] + pixel[second]) / 2,
            )
            for first, second, matches, _ in verified_pairs(database)
            if first in rays and second in rays
        ]


def _with_fitting_lens(model: pycolmap.Reconstruction, tell: Tell) -> pycolmap.Reconstruction:
    """A copy refined with the lens that its photos need.

    Where four coefficients of distortion (COLMAP's OPENCV) fit clearly better than the one so far, they are taken, if
    there are photos enough to tell. Where none fits as well, the cameras are pinholes: their photos are used as they
    are, all others are resampled when they are loaded.
    """
    error = _with_lens(model, "SIMPLE_RADIAL").compute_mean_reprojection_error()
    photos = Counter(image.camera_id for image in model.images.values() if image.has_pose)
    tell("finding the lens distortion, 1 of 3 models tried", 0.6)
    if min(photos.values()) >= _MANY:
        bent = _with_lens(model, "OPENCV")
        if bent.compute_mean_reprojection_error() < _BENT * error:
            return bent
    tell("finding the lens distortion, 2 of 3 models tried", 0.7)
    straight = _with_lens(model, "SIMPLE_PINHOLE")
    return straight if straight.compute_mean_reprojection_error() <= _STRAIGHT * error else model


def _with_lens(model: pycolmap.Reconstruction, lens: str) -> pycolmap.Reconstruction:
    """A copy with cameras of another model (COLMAP's name), refined; those of the model are SIMPLE_RADIAL."""
    model = pycolmap.Reconstruction(model)
    for camera in model.cameras.values():
        focal, x, y, bend = camera.params
        parameters = {
            "SIMPLE_PINHOLE": [focal, x, y],
            "SIMPLE_RADIAL": [focal, x, y, bend],
            "OPENCV": [focal, focal, x, y, bend, 0.0, 0.0, 0.0],
        }
        camera.model, camera.params = getattr(pycolmap.CameraModelId, lens), parameters[lens]
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.ceres.solver_options.num_threads = THREADS
    options.ceres.loss_function_type, options.ceres.loss_function_scale = pycolmap.LossFunctionType.CAUCHY, _DOUBTED
    pycolmap.bundle_adjustment(model, options)
    model.update_point_3d_errors()
    return model


def _enlarge(job: Job, model: pycolmap.Reconstruction) -> None:
    """Bring cameras and observations from the size of the working copies to that of the photos, and give them names."""
    for number, camera in model.cameras.items():
        camera.rescale(*job.devices[number - 1].size)
    for image in model.images.values():
        image.name = job.names[image.image_id - 1]
        device = job.devices[image.camera_id - 1]
        scale = np.array(device.size) / np.array(device.working_size)
        for point in image.points2D:
            point.xy = point.xy * scale


def _color(job: Job, model: pycolmap.Reconstruction, tell: Tell) -> None:
    """Give each point the mean colour of the pixels that see it."""
    sums: dict[int, np.ndarray] = {}
    for number, image in enumerate(model.images.values(), start=1):
        tell(f"colouring points, photo {number:,} of {len(model.images):,}", 0.8 + 0.2 * number / len(model.images))
        seen = [(point.point3D_id, point.xy) for point in image.points2D if point.has_point3D()]
        if not (image.has_pose and seen):
            continue
        device = job.devices[image.camera_id - 1]
        width, height = size = fit_size(device.size[0], device.size[1], _COLORED)
        rgb, _ = read_pixels(job.images / image.name, size)
        scale = np.array(size) / np.array(device.size)
        for point_id, xy in seen:
            column, row = (xy * scale).astype(int)
            color = rgb[min(max(row, 0), height - 1), min(max(column, 0), width - 1)].astype(np.float64)
            sums[point_id] = sums.get(point_id, 0) + np.array([*color, 1.0])
    for point_id, (*color, count) in sums.items():
        model.points3D[point_id].color = np.round(np.array(color) / count).astype(np.uint8)


def _save(job: Job, model: pycolmap.Reconstruction) -> None:
    folder = job.work / "scratch"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    model.write(folder)
    shutil.rmtree(job.model("chosen"), ignore_errors=True)
    os.replace(folder, job.model("chosen"))


def _median_angle(model: pycolmap.Reconstruction) -> float:
    """The median over points of the largest angle between two of the rays that meet there, in degrees."""
    places = {number: image.projection_center() for number, image in model.images.items() if image.has_pose}
    largest = []
    for point in model.points3D.values():
        rays = np.array([places[element.image_id] - point.xyz for element in point.track.elements])
        rays /= np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-12)
        largest.append(np.degrees(np.arccos(np.clip((rays @ rays.T).min(), -1, 1))))
    return float(np.median(largest)) if largest else 0.0
