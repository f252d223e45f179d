"""Explain why no poses can be estimated for a set of photos, and why single photos are left out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from hyrfpack.counts import format_count
from hyrfpack.data.quality import mark_blurred
from hyrfpack.data.unusable import no_photos_error, unreadable_error
from hyrfpack.errors import HyrfDataError
from hyrfpack.poses.prepare import COPY_REASON_PREFIX, select_unreadable

MIN_PHOTOS = 3
_MIN_TYPICAL_FEATURES = 60  # photos with fewer features cannot be matched
_MIN_CONTENT_SHARPNESS = 0.1  # a blurred photo that shows something is sharper than this
# Photos were taken from one place if at least this ratio of their pairs has no translation.
_MIN_PANORAMA_PAIR_RATIO = 0.8


def check_photo_count(given: Path, folder: Path, usable: int, left_out: Mapping[str, str]) -> None:
    """Check that there are enough usable photos.

    Args:
        given: the path that the user gave.
        folder: the folder of the photos, which for an archive is where it was unpacked.
        usable: number of photos that can be read and are not copies.
        left_out: the reason for each other photo.

    Raises:
        HyrfDataError: there are fewer than MIN_PHOTOS.
    """
    if usable >= MIN_PHOTOS:
        return
    count = usable + len(left_out)
    copies = [reason for reason in left_out.values() if reason.startswith(COPY_REASON_PREFIX)]
    if not count:
        raise no_photos_error(given, folder)
    if copies and usable + len(copies) >= MIN_PHOTOS:
        raise HyrfDataError(
            f"{given}: {format_count(len(copies), f'of {count} files is a copy', f'of {count} files are copies')} of "
            f"another, and {format_count(usable, 'different photo is', 'different photos are')} too few",
            fix="take photos from many places",
        )
    if unreadable := select_unreadable(left_out):
        consequence = f", and the {usable} that can be read {'is' if usable == 1 else 'are'} too few" if usable else ""
        raise unreadable_error(given, unreadable, count, consequence)
    raise HyrfDataError(
        f"{given}: {format_count(usable, 'photo is', 'photos are')} too few to estimate poses",
        fix="take 20 or more from different places, each sharing two thirds of its view with the next",
    )


def check_features(folder: Path, count: int, features: Mapping[str, Any], unreadable: Mapping[str, str]) -> None:
    """Check that enough photos could be decoded and have features.

    Args:
        folder: the path that the user gave.
        count: number of all photos.
        features: the answer of `features.find_features`.
        unreadable: the reason for each photo that cannot be read, by its name for the user.

    Raises:
        HyrfDataError: too few photos can be decoded, or they have too few features.
    """
    counts = list(features["keypoints"].values())
    if len(counts) < MIN_PHOTOS:
        raise unreadable_error(folder, unreadable, count)
    if np.median(counts) < _MIN_TYPICAL_FEATURES:
        raise HyrfDataError(
            f"{folder}: these photos have too few features (median {int(np.median(counts))}, at least "
            f"{_MIN_TYPICAL_FEATURES} are needed)",
            fix="take sharp, well lit photos of things that have texture",
        )


def check_matches(folder: Path, count: int, matches: Mapping[str, Any]) -> None:
    """Check the answer of `matching.match_photos`.

    Raises:
        HyrfDataError: the photos do not overlap, or were all taken from one place.
    """
    if len(matches["matched"]) < MIN_PHOTOS:
        pairs = format_count(
            matches["pairs"], f"pair of these {count} photos has", f"pairs of these {count} photos have"
        )
        raise HyrfDataError(
            f"{folder}: {pairs} enough matches",
            fix="take sharp photos of one scene, each sharing two thirds of its view with the next",
        )
    if matches["turned"] >= _MIN_PANORAMA_PAIR_RATIO:
        raise HyrfDataError(
            f"{folder}: all photos were taken from one place, so that they show no depth",
            fix="walk around the scene, with a step to the side between photos",
        )


def check_registered(folder: Path, count: int, result: Mapping[str, Any]) -> None:
    """Check the answer of `finish.finish_reconstruction`.

    Raises:
        HyrfDataError: too few photos have a pose.
    """
    if len(result["registered"]) < MIN_PHOTOS:
        raise HyrfDataError(
            f"{folder}: no poses could be estimated, because these {count} photos overlap too little",
            fix="take more photos between them, each sharing two thirds of its view with the next",
        )


def blurred_photos(features: Mapping[str, Any]) -> frozenset[str]:
    """Return the photos that are blurred compared with the others."""
    sharpness = features["sharpness"]
    mask = mark_blurred(list(sharpness.values()))
    return frozenset(name for name, blurred in zip(sharpness, mask, strict=True) if blurred)


def explain_unposed(
    names: Sequence[str], features: Mapping[str, Any], matches: Mapping[str, Any], result: Mapping[str, Any]
) -> dict[str, str]:
    """Return the reason for each decodable photo that has no pose.

    Args:
        names: names of the photos that could be decoded.
        features: the answer of `features.find_features`.
        matches: the answer of `matching.match_photos`.
        result: the answer of `finish.finish_reconstruction`.
    """
    blurred, posed = blurred_photos(features), set(result["registered"])

    def reason(name: str) -> str:
        if name in result["in_other_pieces"]:
            return "belongs to a separate reconstruction, because too few matches connect it to the other photos"
        if (
            features["keypoints"].get(name, 0) < _MIN_TYPICAL_FEATURES
            and features["sharpness"].get(name, 0) < _MIN_CONTENT_SHARPNESS
        ):
            return "too few features"
        if name in blurred:
            return "blurred"
        if name not in matches["matched"]:
            return "no matches with other photos"
        return "too few matches with the posed photos"

    return {name: reason(name) for name in names if name not in posed}
