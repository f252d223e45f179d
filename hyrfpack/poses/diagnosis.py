"""What is wrong with photos: why no poses can be found for a set of them, and why single ones are left out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from hyrfpack.data.quality import is_blurred
from hyrfpack.data.unusable import explain_no_photos, unreadable_sentences
from hyrfpack.errors import HyrfDataError
from hyrfpack.poses.prepare import COPY_REASON, only_unreadable

LEAST = 3  # photos that poses can be found for
_FEATURELESS = 60  # features of a typical photo, below which there is nothing to match
_BLANK = 0.1  # sharpness: what is blurred and shows something has more
_TURNED = 0.8  # of all pairs: a panorama


def check_count(given: Path, folder: Path, usable: int, left_out: Mapping[str, str]) -> None:
    """Raises HyrfDataError: there are too few photos.

    Args:
        given: what the user named.
        folder: of the photos; the same, or where an archive was unpacked.
        usable: how many of them can be read and are no copies.
        left_out: the reason for each other one.
    """
    if usable >= LEAST:
        return
    count = usable + len(left_out)
    copies = [reason for reason in left_out.values() if reason.startswith(COPY_REASON)]
    if not count:
        raise HyrfDataError(explain_no_photos(given, folder))
    if copies and usable + len(copies) >= LEAST:
        raise HyrfDataError(
            f"{given}: {len(copies)} of {count} files are copies of another, and {usable} different "
            f"{'photo is' if usable == 1 else 'photos are'} too few; take photos from many places"
        )
    if unreadable := only_unreadable(left_out):
        left = f"; the {usable} that can be read {'is' if usable == 1 else 'are'} too few" if usable else ""
        raise HyrfDataError(f"{given}: {'; '.join(unreadable_sentences(unreadable, count))}{left}")
    raise HyrfDataError(
        f"{given}: {usable} {'photo is' if usable == 1 else 'photos are'} too few to find poses; take 20 or more from "
        "different places, each sharing two thirds of its view with the next"
    )


def check_features(folder: Path, count: int, features: Mapping[str, Any], unreadable: Mapping[str, str]) -> None:
    """Raises HyrfDataError: too few photos can be decoded, or they show too little.

    Args:
        folder: what the user named.
        count: photos in all.
        features: the answer of `features.find_features`.
        unreadable: the reason for each photo that cannot be read, by its name for the user.
    """
    counts = list(features["keypoints"].values())
    if len(counts) < LEAST:
        raise HyrfDataError(f"{folder}: {'; '.join(unreadable_sentences(unreadable, count))}")
    if np.median(counts) < _FEATURELESS:
        raise HyrfDataError(
            f"{folder}: there is hardly anything in these photos that can be recognised in another (a typical one has "
            f"{int(np.median(counts))} features); take sharp, well lit photos of things that have texture"
        )


def check_matches(folder: Path, count: int, matches: Mapping[str, Any]) -> None:
    """Raises HyrfDataError: photos do not overlap, or are taken from one place (`matching.match`)."""
    if len(matches["matched"]) < LEAST:
        raise HyrfDataError(
            f"{folder}: {matches['pairs'] or 'no'} pairs of these {count} photos show the same thing; take sharp "
            "photos of one scene, each sharing two thirds of its view with the next"
        )
    if matches["turned"] >= _TURNED:
        raise HyrfDataError(
            f"{folder}: the photos are all taken from one place, where the camera turned at most, so that no depth can "
            "be seen in them; walk around the scene, a step to the side between photos"
        )


def check_found(folder: Path, count: int, found: Mapping[str, Any]) -> None:
    """Raises HyrfDataError: too few photos have a pose (`finish.finish`)."""
    if len(found["registered"]) < LEAST:
        raise HyrfDataError(
            f"{folder}: no poses could be found, for these {count} photos share too little with each other; take more "
            "between them, each sharing two thirds of its view with the next"
        )


def blurred(features: Mapping[str, Any]) -> frozenset[str]:
    """Photos that are blurred beside the others."""
    sharp = features["sharpness"]
    return frozenset(name for name, is_so in zip(sharp, is_blurred(list(sharp.values())), strict=True) if is_so)


def unposed(
    names: Sequence[str], features: Mapping[str, Any], matches: Mapping[str, Any], found: Mapping[str, Any]
) -> dict[str, str]:
    """The reason for each photo that has no pose.

    Args:
        names: of photos that could be decoded.
        features, matches, found: the answers of the stages.
    """
    soft, posed = blurred(features), set(found["registered"])

    def reason(name: str) -> str:
        if name in found["apart"]:
            return "belongs to a piece of its own, which too little joins to the rest"
        if features["keypoints"].get(name, 0) < _FEATURELESS and features["sharpness"].get(name, 0) < _BLANK:
            return "nothing in it that can be recognised"
        if name in soft:
            return "blurred"
        if name not in matches["matched"]:
            return "no matches with other photos"
        return "too few matches with the posed photos"

    return {name: reason(name) for name in names if name not in posed}
