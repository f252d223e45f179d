"""Matches between photos, held to geometry, and the focal lengths that they tell."""

from __future__ import annotations

import json
import time
from typing import Any

import numpy as np
import pycolmap

from hyrfpack.atomic import write_atomic
from hyrfpack.poses import pairs as pairing
from hyrfpack.poses.calibrate import FOCALS, Pair, search_focal, turned_only, with_focal
from hyrfpack.poses.database import FOUND, opened, read_cameras, recalibrate, verification, verified_pairs
from hyrfpack.poses.job import Job
from hyrfpack.poses.process import Tell
from hyrfpack.poses.watch import watching_rows

_STEP = 2.0  # seconds of matching between two lines of progress, about
_FIRST, _LARGEST = 100, 2000  # pairs that are matched at a time, at first and at most
_STRONG = 2 * FOUND  # matches of the pairs that focal lengths are read from
_LOOKED_AT = 40  # of them
_ENOUGH = 5  # of them, without which they say nothing
_FOCALS = "estimating focal lengths from matches"
_CHANGED = 0.05  # of a focal length: beyond, pairs are verified anew


def match(job: Job, tell: Tell) -> dict[str, Any]:
    """Match all pairs that are to be, find unknown focal lengths, and verify all pairs with them.

    Returns:
        "pairs": how many hold together; "matched": photos in them; "turned": the share of pairs between which the
        camera only turned, a panorama where it is nearly all.
    """
    marker = job.work / "matches.json"
    if marker.exists():
        return json.loads(marker.read_text())
    if not (job.work / "focal.json").exists():  # which is decided on all matches
        _match_pairs(job, _choose_pairs(job, tell), tell)

    def told(doing: str, share: float) -> None:
        tell(doing, 0.82 + 0.13 * share)

    told(_FOCALS, 0.0)
    recalibrate(job, "focal", lambda cameras: _better_focals(job, cameras, told), told)
    tell("checking that the camera moved", 0.95)
    answer = _sum_up(job)
    write_atomic(marker, json.dumps(answer).encode())
    return answer


def _choose_pairs(job: Job, tell: Tell) -> pairing.Pairs:
    count = len(job.names)
    if job.matching == "exhaustive":
        return pairing.exhaustive(count)
    with opened(job) as database:
        found = []
        for number in range(1, count + 1):
            there = database.exists_descriptors(number)
            found.append(database.read_descriptors(number).data if there else np.zeros((0, 128), np.uint8))

    def progress(done: int) -> None:
        tell(f"choosing which photos to match, {done:,} of {count:,}", 0.02 * done / count)

    similarity = pairing.similarities(found, job.seed, progress)
    choose = pairing.sequential if job.matching == "sequential" else pairing.retrieval
    return choose(count, similarity)


def _match_pairs(job: Job, pairs: pairing.Pairs, tell: Tell) -> None:
    """Match pairs of photos, in portions that the database keeps."""
    names = [job.working_name(number) for number in range(1, len(job.names) + 1)]
    with opened(job) as database:
        known = {number for number in range(1, len(names) + 1) if database.exists_keypoints(number)}
        matched = {
            pair
            for pair in pairs
            if database.exists_matches(pair[0] + 1, pair[1] + 1)
            and database.exists_two_view_geometry(pair[0] + 1, pair[1] + 1)
        }
    wanted = [pair for pair in pairs if pair[0] + 1 in known and pair[1] + 1 in known]
    left = [pair for pair in wanted if pair not in matched]
    done, size = len(wanted) - len(left), _FIRST
    portion = job.work / "pairs.txt"
    options = pycolmap.ImportedPairingOptions()
    options.match_list_path = portion

    def tell_done(done: int) -> None:
        number, share = min(done + 1, len(wanted)), min(done / len(wanted), 1.0)
        tell(f"matching pair {number:,} of {len(wanted):,}", 0.02 + 0.8 * share)

    while left:
        tell_done(done)
        now, left = left[:size], left[size:]
        portion.write_text("".join(f"{names[first]} {names[second]}\n" for first, second in now), encoding="utf-8")
        began = time.monotonic()
        with watching_rows(job, "two_view_geometries", lambda found, done=done: tell_done(done + found)):  # type: ignore[misc]
            pycolmap.match_image_pairs(
                job.database, pairing_options=options, verification_options=verification(job.seed)
            )
        pace = len(now) / max(time.monotonic() - began, 1e-3)
        done, size = done + len(now), int(np.clip(pace * _STEP, _FIRST // 4, _LARGEST))
    portion.unlink(missing_ok=True)


def _better_focals(job: Job, cameras: dict[int, pycolmap.Camera], tell: Tell) -> dict[int, pycolmap.Camera]:
    """The cameras whose focal length EXIF does not tell and that is another than was guessed."""
    with opened(job) as database:
        strong = _strong_pairs(job, database)
    found: dict[int, float] = {}
    for number, device in enumerate(job.devices, start=1):
        own = strong.get(number, [])
        if device.focal is None and len(own) >= _ENOUGH:

            def progress(share: float, number: int = number) -> None:
                camera = f", camera {number} of {len(job.devices)}" if len(job.devices) > 1 else ""
                tell(f"{_FOCALS}{camera}", 0.5 * (number - 1 + share) / len(job.devices))

            found[number] = search_focal(own, cameras[number], job.seed, progress)
    typical = float(np.median(list(found.values()))) if found else None
    better = {}
    for number, device in enumerate(job.devices, start=1):
        if device.focal is None and typical is not None:
            now = with_focal(cameras[number], found.get(number, typical))
            if abs(now.focal_length / cameras[number].focal_length - 1) > _CHANGED:
                better[number] = now
    return better


def _strong_pairs(job: Job, database: pycolmap.Database) -> dict[int, list[Pair]]:
    """By camera: pairs of its photos with many matches, spread at random over them."""
    rng = np.random.default_rng(job.seed)
    mine: dict[int, list[tuple[int, int, np.ndarray]]] = {}
    for first, second, matches, _ in verified_pairs(database):
        device = job.device_of[first - 1] + 1
        if len(matches) >= _STRONG and job.device_of[second - 1] + 1 == device:
            mine.setdefault(device, []).append((first, second, matches))
    chosen = {}
    for device, candidates in mine.items():
        picked = rng.permutation(len(candidates))[:_LOOKED_AT]
        chosen[device] = [_pair(database, *candidates[place]) for place in picked]
    return chosen


def _pair(database: pycolmap.Database, first: int, second: int, matches: np.ndarray) -> Pair:
    pixels1, pixels2 = (np.asarray(database.read_keypoints(number))[:, :2] for number in (first, second))
    return Pair(pixels1[matches[:, 0]].astype(np.float64), pixels2[matches[:, 1]].astype(np.float64))


def _sum_up(job: Job) -> dict[str, Any]:
    """What came of matching, for the person and for what is decided next."""
    with opened(job) as database:
        pairs = [(first, second) for first, second, _, _ in verified_pairs(database)]
        cameras, strong = read_cameras(database), _strong_pairs(job, database)
    turned, counted = 0.0, 0
    for number, own in strong.items():
        camera, known = cameras[number], job.devices[number - 1].focal is not None
        focals = [camera.focal_length / max(camera.width, camera.height)] if known else list(FOCALS[:13])
        turned += turned_only(own, camera, focals) * len(own)
        counted += len(own)
    matched = sorted({job.names[number - 1] for pair in pairs for number in pair})
    return {"pairs": len(pairs), "matched": matched, "turned": turned / counted if counted else 0.0}
