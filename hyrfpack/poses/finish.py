"""Last stage of an estimation: choose one of the mappers' results, complete and refine it, and save it."""

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
from hyrfpack.poses.choose import Candidate, choose_candidate, confirmed_photos, describe_unconfirmed_poses
from hyrfpack.poses.database import open_database, verified_pairs
from hyrfpack.poses.explained_matches import RayMatches, count_explained_matches
from hyrfpack.poses.job import Job
from hyrfpack.poses.mapping import (
    MIN_PIECE_PHOTOS,
    SOLVER_THREADS,
    add_two_view_points,
    complete_model,
    read_pieces,
    read_poses,
)
from hyrfpack.progress import Progress, TaskEvent

# Limits of the reprojection error with another lens model, relative to the error with one radial coefficient.
_MAX_OPENCV_ERROR_RATIO = 0.99
_MAX_PINHOLE_ERROR_RATIO = 1.003
_MIN_OPENCV_PHOTOS = 20  # fewer photos of a camera do not determine the four coefficients of the OPENCV model
_REFIT_FUNCTION_TOLERANCE = 1e-6  # a refit ends when a step lowers its cost by less than this ratio
_CAUCHY_SCALE_PIXELS = 0.5  # with this robust loss, pose errors are a third smaller than without it
_MIN_REFITTED_MATCH_RATIO = 0.997  # a refit with another lens model must keep this ratio of the explained matches
_COLOR_PICTURE_SIDE_PIXELS = 400  # points get their colours from pictures with this longer side


def finish_reconstruction(job: Job, models: list[str], report_progress: Progress) -> dict[str, Any]:
    """Choose between the mappers' results, complete the chosen one, and save it as `job.model_folder("chosen")`.

    Args:
        job: the estimation.
        models: names of the mappers' results.
        report_progress: see `run_stage`.

    Returns:
        "registered", "sure" (confirmed by the other mapper) and "in_other_pieces" (posed in another piece): names of
        photos. "mapper": the chosen mapper; "why": the reason; "warning": a sentence about poses that are not
        confirmed, "" if enough are. "angle": the median over points of the largest triangulation angle in degrees. If
        no photo is posed, only "registered", which is empty.
    """
    report_progress(TaskEvent("comparing both reconstructions", 0.0))
    largest_pieces: dict[Candidate, pycolmap.Reconstruction] = {}
    for name in models:
        pieces = read_pieces(job.model_folder(name))
        if pieces and pieces[0].num_reg_images() >= MIN_PIECE_PHOTOS:
            largest_pieces[_make_candidate(job, name, pieces)] = pieces[0]
    if not largest_pieces:
        return {"registered": []}
    best: dict[str, Candidate] = {}  # the best result of each mapper
    for candidate in sorted(largest_pieces, key=lambda candidate: candidate.explained_matches):
        best[candidate.mapper] = candidate
    chosen, why = choose_candidate(list(best.values()), _count_matches(job))
    other = next((candidate for candidate in best.values() if candidate is not chosen), None)
    model, poses, explained_count = largest_pieces[chosen], chosen.poses, chosen.explained_matches
    steps: list[tuple[str, float, Callable[[pycolmap.Reconstruction], pycolmap.Reconstruction], float]] = [
        ("estimating poses of the remaining photos", 0.1, partial(complete_model, job), 1.0),
        ("triangulating points seen in two photos", 0.4, partial(add_two_view_points, job), 1.0),
        (
            "estimating the lens distortion",
            0.5,
            partial(_choose_lens, report_progress=report_progress),
            _MIN_REFITTED_MATCH_RATIO,
        ),
    ]
    for task, share, refine, min_match_ratio in steps:
        report_progress(TaskEvent(task, share))
        refined = refine(model)
        refined_poses = read_poses(job, refined)
        refined_explained_count = count_explained_matches(refined_poses, _read_ray_matches(job, refined))
        if len(refined_poses) >= len(poses) and refined_explained_count >= min_match_ratio * explained_count:
            model, poses, explained_count = refined, refined_poses, refined_explained_count
    _rescale_to_photos(job, model)
    _color_points(job, model, report_progress)
    _save_chosen(job, model)
    in_other_pieces = {name for candidate in best.values() for piece in candidate.other_pieces for name in piece}
    return {
        "registered": sorted(poses),
        "sure": sorted(confirmed_photos(poses, other)),
        "in_other_pieces": sorted(in_other_pieces - set(poses)),
        "mapper": chosen.mapper,
        "why": why,
        "warning": describe_unconfirmed_poses(poses, other),
        "angle": _median_triangulation_angle(model),
    }


def _make_candidate(job: Job, name: str, pieces: list[pycolmap.Reconstruction]) -> Candidate:
    """Describe the pieces of a result, the largest first, by the figures that are compared."""
    first, *others = pieces
    poses = read_poses(job, first)
    return Candidate(
        name.partition("-")[0],
        poses,
        [read_poses(job, piece) for piece in others if piece.num_reg_images() >= MIN_PIECE_PHOTOS],
        count_explained_matches(poses, _read_ray_matches(job, first)),
        first.compute_mean_track_length(),
        first.compute_mean_reprojection_error(),
    )


def _count_matches(job: Job) -> int:
    """Return the number of verified matches between all photos."""
    with open_database(job) as database:
        return sum(len(matches) for _, _, matches in verified_pairs(database))


def _read_ray_matches(job: Job, model: pycolmap.Reconstruction) -> list[RayMatches]:
    """Return the verified matches between the posed photos of a model, as rays of its cameras."""
    rays, pixel = {}, {}
    with open_database(job) as database:
        for image in model.images.values():
            if image.has_pose:
                camera = model.cameras[image.camera_id]
                pixels = np.asarray(database.read_keypoints(image.image_id))[:, :2].astype(np.float64)
                rays[image.image_id] = np.asarray(camera.cam_from_img(pixels)).reshape(-1, 2)
                pixel[image.image_id] = 1 / camera.mean_focal_length()
        return [
            RayMatches(
                job.names[first - 1],
                job.names[second - 1],
                rays[first][matches[:, 0]],
                rays[second][matches[:, 1]],
                (pixel[first] + pixel[second]) / 2,
            )
            for first, second, matches in verified_pairs(database)
            if first in rays and second in rays
        ]


def _choose_lens(model: pycolmap.Reconstruction, report_progress: Progress) -> pycolmap.Reconstruction:
    """Choose the lens model that fits the photos, and return a copy refined with it.

    COLMAP's OPENCV model, with four coefficients of distortion, is chosen if it fits clearly better than one radial
    coefficient and each camera has enough photos. A pinhole model is chosen if it fits as well as one coefficient,
    because only photos with distortion must be resampled when they are loaded. Both are refined from the result with
    one coefficient, which is near to theirs.
    """
    radial = _refit_with_lens(model, "SIMPLE_RADIAL")
    error = radial.compute_mean_reprojection_error()
    photos = Counter(image.camera_id for image in model.images.values() if image.has_pose)
    report_progress(TaskEvent("estimating the lens distortion, model 2/3", 0.6))
    if min(photos.values()) >= _MIN_OPENCV_PHOTOS:
        opencv = _refit_with_lens(radial, "OPENCV")
        if opencv.compute_mean_reprojection_error() < _MAX_OPENCV_ERROR_RATIO * error:
            return opencv
    report_progress(TaskEvent("estimating the lens distortion, model 3/3", 0.7))
    pinhole = _refit_with_lens(radial, "SIMPLE_PINHOLE")
    return pinhole if pinhole.compute_mean_reprojection_error() <= _MAX_PINHOLE_ERROR_RATIO * error else radial


def _refit_with_lens(model: pycolmap.Reconstruction, lens: str) -> pycolmap.Reconstruction:
    """Return a copy of a SIMPLE_RADIAL model, refined with cameras of the lens model `lens` (COLMAP's name)."""
    model = pycolmap.Reconstruction(model)
    for camera in model.cameras.values():
        focal, x, y, radial_distortion = camera.params
        parameters = {
            "SIMPLE_PINHOLE": [focal, x, y],
            "SIMPLE_RADIAL": [focal, x, y, radial_distortion],
            "OPENCV": [focal, focal, x, y, radial_distortion, 0.0, 0.0, 0.0],
        }
        camera.model, camera.params = getattr(pycolmap.CameraModelId, lens), parameters[lens]
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.ceres.solver_options.num_threads = SOLVER_THREADS
    options.ceres.solver_options.function_tolerance = _REFIT_FUNCTION_TOLERANCE
    options.ceres.loss_function_type, options.ceres.loss_function_scale = (
        pycolmap.LossFunctionType.CAUCHY,
        _CAUCHY_SCALE_PIXELS,
    )
    pycolmap.bundle_adjustment(model, options)
    model.update_point_3d_errors()
    return model


def _rescale_to_photos(job: Job, model: pycolmap.Reconstruction) -> None:
    """Rescale cameras and observations from the working copies to the photos, and name the images after the photos."""
    for number, camera in model.cameras.items():
        camera.rescale(*job.devices[number - 1].size)
    for image in model.images.values():
        image.name = job.names[image.image_id - 1]
        device = job.devices[image.camera_id - 1]
        scale = np.array(device.size) / np.array(device.working_size)
        for point in image.points2D:
            point.xy = point.xy * scale


def _color_points(job: Job, model: pycolmap.Reconstruction, report_progress: Progress) -> None:
    """Give each point the mean colour of the pixels in which it is observed."""
    sums: dict[int, np.ndarray] = {}
    for number, image in enumerate(model.images.values(), start=1):
        count = len(model.images)
        report_progress(TaskEvent(f"colouring points, photo {number}/{count}", 0.8 + 0.2 * number / count))
        seen = [(point.point3D_id, point.xy) for point in image.points2D if point.has_point3D()]
        if not (image.has_pose and seen):
            continue
        device = job.devices[image.camera_id - 1]
        width, height = size = fit_size(device.size[0], device.size[1], _COLOR_PICTURE_SIDE_PIXELS)
        rgb, _ = read_pixels(job.images / image.name, size)
        scale = np.array(size) / np.array(device.size)
        for point_id, xy in seen:
            column, row = (xy * scale).astype(int)
            color = rgb[min(max(row, 0), height - 1), min(max(column, 0), width - 1)].astype(np.float64)
            sums[point_id] = sums.get(point_id, 0) + np.array([*color, 1.0])
    for point_id, (*color, count) in sums.items():
        model.points3D[point_id].color = np.round(np.array(color) / count).astype(np.uint8)


def _save_chosen(job: Job, model: pycolmap.Reconstruction) -> None:
    """Save the chosen model in one step, so that no incomplete one is ever found."""
    folder = job.work / "scratch"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    model.write(folder)
    shutil.rmtree(job.model_folder("chosen"), ignore_errors=True)
    os.replace(folder, job.model_folder("chosen"))


def _median_triangulation_angle(model: pycolmap.Reconstruction) -> float:
    """Return the median over points of the largest angle between two of their viewing rays, in degrees."""
    centers = {number: image.projection_center() for number, image in model.images.items() if image.has_pose}
    largest = []
    for point in model.points3D.values():
        rays = np.array([centers[element.image_id] - point.xyz for element in point.track.elements])
        rays /= np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-12)
        largest.append(np.degrees(np.arccos(np.clip((rays @ rays.T).min(), -1, 1))))
    return float(np.median(largest)) if largest else 0.0
