"""Choose between the results of the two mappers, and confirm the chosen poses by the other result."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from hyrfpack.counts import format_count
from hyrfpack.poses.alignment import Poses, align_poses

_MAPPER_NAMES = {"incremental": "the incremental mapper", "global": "the global mapper"}
_TIE_MATCH_RATIO = 0.002  # a lead of at most this ratio of all matches is not significant
_MIN_CONFIRMED_RATIO = 0.9  # a note warns if the mappers agree on a smaller ratio of the photos
_MIN_AGREEING_RATIO = 0.95  # two mappers that agree on this ratio of the photos confirm each other


@dataclass(frozen=True, eq=False)
class Candidate:
    """The result of a mapper, with the figures by which it is compared.

    Attributes:
        mapper: "incremental" or "global".
        poses: (3, 4) camera_from_world by photo name, of the largest piece.
        other_pieces: the poses of the other pieces, each in a frame of its own.
        explained_matches: number of matches between all photos that the largest piece explains
            (`count_explained_matches`).
        mean_track_length: mean number of photos that see a point of the largest piece.
        mean_reprojection_error: mean reprojection error in pixels of the working copies.
    """

    mapper: str
    poses: Poses
    other_pieces: Sequence[Poses]
    explained_matches: int
    mean_track_length: float
    mean_reprojection_error: float


def choose_candidate(candidates: Sequence[Candidate], matches: int) -> tuple[Candidate, str]:
    """Choose the candidate that explains the most matches between photos, and return it with the reason.

    The number of photos and the reprojection error do not reveal that one part of the scene was folded onto another,
    because mappers drop the points that contradict it. If candidates explain about the same number of matches, the one
    with more photos is chosen, then the one with longer tracks.

    Args:
        candidates: one or two results.
        matches: number of verified matches between all photos.
    """
    most = max(candidate.explained_matches for candidate in candidates)
    tied = [candidate for candidate in candidates if most - candidate.explained_matches <= _TIE_MATCH_RATIO * matches]
    chosen = max(tied, key=lambda candidate: (len(candidate.poses), candidate.mean_track_length))
    name, figures = _MAPPER_NAMES[chosen.mapper], _describe_figures(chosen, matches)
    others = [candidate for candidate in candidates if candidate is not chosen]
    if not others:
        return chosen, f"{name} was chosen ({figures}); the other mapper registered no photos"
    (other,) = others
    against = f"{name} was chosen ({figures}; {_MAPPER_NAMES[other.mapper]}: {_describe_figures(other, matches)})"
    if other not in tied:
        return chosen, f"{against}: it explains more of the matches"
    lead = "poses more photos" if len(chosen.poses) > len(other.poses) else "has longer tracks"
    return chosen, f"{against}: both explain about as many matches, and it {lead}"


def confirmed_photos(poses: Poses, other: Candidate | None) -> frozenset[str]:
    """Return the photos whose poses agree with those of the other mapper.

    Only the piece of the other mapper with the most agreeing photos counts, because the pieces have no common frame.
    """
    pieces = [] if other is None else [other.poses, *other.other_pieces]
    return max((align_poses(piece, poses).agreeing for piece in pieces), key=len, default=frozenset())


def confirm_each_other(first: Sequence[Poses], second: Sequence[Poses], count: int) -> bool:
    """Return whether two results agree on nearly all photos, so that further runs of the mappers are unnecessary.

    Two mappers that work differently hardly ever make the same mistake.

    Args:
        first, second: the poses of each piece of a mapper's result.
        count: number of photos that have matches and so could have a pose.
    """
    if len(first) != 1 or len(second) != 1:
        return False
    return len(align_poses(first[0], second[0]).agreeing) >= _MIN_AGREEING_RATIO * count


def describe_unconfirmed_poses(poses: Poses, other: Candidate | None) -> str:
    """Return a sentence about the photos that are not confirmed; "" if enough are."""
    confirmed = confirmed_photos(poses, other)
    if len(confirmed) >= _MIN_CONFIRMED_RATIO * len(poses):
        return ""
    if other is None:
        return (
            f"the poses of these {len(poses)} photos are not confirmed, because only one mapper registered photos, so "
            "check the result before you use it"
        )
    lacking = len(set(poses).difference(other.poses, *other.other_pieces))
    in_other_pieces = len(set().union(*other.other_pieces).intersection(poses).difference(confirmed))
    different = len(poses) - len(confirmed) - lacking - in_other_pieces
    parts = [f"gives {format_count(different, 'photo')} other poses"] if different > 0 else []
    parts += [f"has {format_count(in_other_pieces, 'photo')} in separate reconstructions"] if in_other_pieces else []
    parts += [f"has no pose for {format_count(lacking, 'photo')}"] if lacking else []
    return (
        f"{len(confirmed)} of {len(poses)} poses are confirmed by both mappers; {_MAPPER_NAMES[other.mapper]} "
        f"{' and '.join(parts)}, so check the result before you use it"
    )


def _describe_figures(candidate: Candidate, matches: int) -> str:
    """Return the figures of a candidate as text."""
    share = candidate.explained_matches / matches if matches else 0.0
    return (
        f"{len(candidate.poses)} photos, {share:.1%} of the matches, mean track {candidate.mean_track_length:.2f}, "
        f"error {candidate.mean_reprojection_error:.2f} pixels"
    )
