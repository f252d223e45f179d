"""Match photos, verify the matches geometrically, and estimate unknown focal lengths from them."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pycolmap

from hyrfpack.atomic import write_atomic
from hyrfpack.parallel.threads import thread_count
from hyrfpack.poses import pairs as pairing
from hyrfpack.poses.calibrate import (
    CANDIDATE_FOCAL_RATIOS,
    FOCAL_SEARCH_TASK,
    PixelMatches,
    camera_with_focal,
    rotation_only_share,
    search_focal_ratio,
)
from hyrfpack.poses.database import (
    MIN_PAIR_MATCHES,
    open_database,
    read_cameras,
    recalibrate,
    verification_options,
    verified_pairs,
)
from hyrfpack.poses.job import Job
from hyrfpack.poses.watch import report_new_rows
from hyrfpack.progress import Progress, TaskEvent, part_of_progress

# pycolmap keeps the search indices of this many photos in memory, about 2 MB each, and rebuilds those of the others.
_MAX_CACHED_PHOTOS = 256
# The focal length of a camera is estimated from pairs of its photos with many matches.
_MIN_FOCAL_PAIR_MATCHES = 2 * MIN_PAIR_MATCHES
_MAX_FOCAL_PAIRS = 40
_MIN_FOCAL_PAIRS = 5
# Pairs are verified again if the estimate differs from the guess by more than this ratio.
_ESTIMATED_FOCAL_CHANGE_RATIO = 0.05


def match_photos(job: Job, report_progress: Progress) -> dict[str, Any]:
    """Match the chosen pairs, estimate unknown focal lengths, and verify all pairs with them.

    Args:
        job: the estimation.
        report_progress: see `run_stage`.

    Returns:
        "pairs": the number of verified pairs; "matched": names of the photos in them; "turned": the share of pairs
        between which the camera only rotated, near 1 for photos from one place.
    """
    if job.matches_path.exists():
        return json.loads(job.matches_path.read_text())
    if not (job.work / "focal.json").exists():  # focal lengths are estimated after all pairs are matched
        _match_pairs(job, _choose_pairs(job, report_progress), report_progress)

    report_part = part_of_progress(report_progress, 0.82, 0.95)
    report_part(TaskEvent(FOCAL_SEARCH_TASK, 0.0))
    recalibrate(job, "focal", lambda cameras: _estimate_focals(job, cameras, report_part), report_part)
    report_progress(TaskEvent("checking that the camera moved", 0.95))
    answer = _summarize_matches(job)
    write_atomic(job.matches_path, json.dumps(answer).encode())
    return answer


def _choose_pairs(job: Job, report_progress: Progress) -> pairing.Pairs:
    """Choose the pairs to match, by the matching mode of the job."""
    count = len(job.names)
    if job.matching == "exhaustive":
        return pairing.exhaustive_pairs(count)
    with open_database(job) as database:
        descriptors = [
            database.read_descriptors(number).data
            if database.exists_descriptors(number)
            else np.zeros((0, 128), np.uint8)
            for number in range(1, count + 1)
        ]
    similarity = pairing.compute_similarities(descriptors, job.seed, part_of_progress(report_progress, 0.0, 0.02))
    choose = pairing.sequential_pairs if job.matching == "sequential" else pairing.retrieval_pairs
    return choose(count, similarity)


def _match_pairs(job: Job, pairs: pairing.Pairs, report_progress: Progress) -> None:
    """Match pairs of photos; the database keeps those that were matched before an interruption."""
    names = [job.working_name(number) for number in range(1, len(job.names) + 1)]
    with open_database(job) as database:
        has_features = {number for number in range(1, len(names) + 1) if database.exists_keypoints(number)}
        matched = {
            pair
            for pair in pairs
            if database.exists_matches(pair[0] + 1, pair[1] + 1)
            and database.exists_two_view_geometry(pair[0] + 1, pair[1] + 1)
        }
    matchable = [pair for pair in pairs if pair[0] + 1 in has_features and pair[1] + 1 in has_features]
    remaining = [pair for pair in matchable if pair not in matched]
    done = len(matchable) - len(remaining)

    def report_new(new: int) -> None:
        number, share = min(done + new + 1, len(matchable)), min((done + new) / len(matchable), 1.0)
        report_progress(TaskEvent(f"matching pair {number}/{len(matchable)}", 0.02 + 0.8 * share))

    if remaining:
        report_new(0)
        list_path = job.work / "pairs.txt"
        lines = [f"{names[first]} {names[second]}\n" for first, second in remaining]
        list_path.write_text("".join(lines), encoding="utf-8")
        options = pycolmap.ImportedPairingOptions()
        options.match_list_path, options.block_size = list_path, _MAX_CACHED_PHOTOS
        matching_options = pycolmap.FeatureMatchingOptions()
        matching_options.num_threads = thread_count()
        with report_new_rows(job, "two_view_geometries", report_new):
            pycolmap.match_image_pairs(job.database_path, matching_options, options, verification_options(job.seed))
        list_path.unlink()


def _estimate_focals(
    job: Job, cameras: dict[int, pycolmap.Camera], report_progress: Progress
) -> dict[int, pycolmap.Camera]:
    """Estimate focal lengths that EXIF lacks; return the cameras whose focal length differs from the guess."""
    with open_database(job) as database:
        strong_pairs = _sample_strong_pairs(job, database)
    focal_ratios: dict[int, float] = {}
    count = len(job.devices)
    for number, device in enumerate(job.devices, start=1):
        camera_pairs = strong_pairs.get(number, [])
        if device.focal is None and len(camera_pairs) >= _MIN_FOCAL_PAIRS:
            report_search = part_of_progress(report_progress, 0.5 * (number - 1) / count, 0.5 * number / count)
            task = f"{FOCAL_SEARCH_TASK}, camera {number}/{count}" if count > 1 else FOCAL_SEARCH_TASK
            focal_ratios[number] = search_focal_ratio(camera_pairs, cameras[number], job.seed, report_search, task)
    typical_ratio = float(np.median(list(focal_ratios.values()))) if focal_ratios else None
    better = {}
    for number, device in enumerate(job.devices, start=1):
        if device.focal is None and typical_ratio is not None:
            estimated = camera_with_focal(cameras[number], focal_ratios.get(number, typical_ratio))
            if abs(estimated.focal_length / cameras[number].focal_length - 1) > _ESTIMATED_FOCAL_CHANGE_RATIO:
                better[number] = estimated
    return better


def _sample_strong_pairs(job: Job, database: pycolmap.Database) -> dict[int, list[PixelMatches]]:
    """Return, by camera, a random sample of pairs of its photos that have many matches."""
    rng = np.random.default_rng(job.seed)
    candidates_of: dict[int, list[tuple[int, int, np.ndarray]]] = {}
    for first, second, matches in verified_pairs(database):
        device = job.device_indices[first - 1] + 1
        if len(matches) >= _MIN_FOCAL_PAIR_MATCHES and job.device_indices[second - 1] + 1 == device:
            candidates_of.setdefault(device, []).append((first, second, matches))
    chosen = {}
    for device, candidates in candidates_of.items():
        picked = rng.permutation(len(candidates))[:_MAX_FOCAL_PAIRS]
        chosen[device] = [_read_pixel_matches(database, *candidates[index]) for index in picked]
    return chosen


def _read_pixel_matches(database: pycolmap.Database, first: int, second: int, matches: np.ndarray) -> PixelMatches:
    """Read the pixel coordinates of the matches between two images."""
    pixels1, pixels2 = (np.asarray(database.read_keypoints(number))[:, :2] for number in (first, second))
    return PixelMatches(pixels1[matches[:, 0]].astype(np.float64), pixels2[matches[:, 1]].astype(np.float64))


def _summarize_matches(job: Job) -> dict[str, Any]:
    """Count the verified pairs and estimate the share without translation; return the answer of `match_photos`."""
    with open_database(job) as database:
        pairs = [(first, second) for first, second, _ in verified_pairs(database)]
        cameras, strong_pairs = read_cameras(database), _sample_strong_pairs(job, database)
    rotation_only_count, sampled_count = 0.0, 0
    for number, camera_pairs in strong_pairs.items():
        camera, has_focal = cameras[number], job.devices[number - 1].focal is not None
        focals = (
            [camera.focal_length / max(camera.width, camera.height)] if has_focal else list(CANDIDATE_FOCAL_RATIOS[:13])
        )
        rotation_only_count += rotation_only_share(camera_pairs, camera, focals) * len(camera_pairs)
        sampled_count += len(camera_pairs)
    matched = sorted({job.names[number - 1] for pair in pairs for number in pair})
    turned = rotation_only_count / sampled_count if sampled_count else 0.0
    return {"pairs": len(pairs), "matched": matched, "turned": turned}
