"""Which reconstruction is taken, why, and of which photos it is sure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from hyrfpack.poses.compare import Poses, compare

_WORDS = {"incremental": "the incremental mapper", "global": "the global mapper"}
_BARELY = 0.002  # of the matches: a lead in what is explained that says nothing
_MOSTLY = 0.9  # of the photos: where the mappers agree on fewer, it is said


@dataclass(frozen=True, eq=False)
class Candidate:
    """What a mapper made, in numbers.

    Attributes:
        mapper: "incremental" or "global".
        poses: (3, 4) camera_from_world by photo, of its largest piece.
        apart: the same of its other pieces, each in a frame of its own.
        explained: matches between all photos that the largest piece explains (`evidence`).
        track: mean number of photos that see a point of it.
        error: mean reprojection error in pixels of the working copies.
    """

    mapper: str
    poses: Poses
    apart: Sequence[Poses]
    explained: int
    track: float
    error: float


def choose(candidates: Sequence[Candidate], matches: int) -> tuple[Candidate, str]:
    """Choose between what the mappers made, and say why.

    The one that explains most of the matches between photos is taken: neither the number of photos nor the reprojection
    error shows that photos are folded onto others, for each mapper drops the points that would. Where they explain the
    same, the one with more photos, then the one with the longer tracks.

    Args:
        candidates: one or two.
        matches: verified matches between all photos.
    """
    most = max(candidate.explained for candidate in candidates)
    near = [candidate for candidate in candidates if most - candidate.explained <= _BARELY * matches]
    chosen = max(near, key=lambda candidate: (len(candidate.poses), candidate.track))
    name, figures = _WORDS[chosen.mapper], _figures(chosen, matches)
    others = [candidate for candidate in candidates if candidate is not chosen]
    if not others:
        return chosen, f"{name} was taken ({figures}); the other one posed no photos"
    (other,) = others
    against = f"{name} was taken ({figures}; {_WORDS[other.mapper]}: {_figures(other, matches)})"
    if other not in near:
        return chosen, f"{against}: it explains more of what was matched"
    lead = "poses more photos" if len(chosen.poses) > len(other.poses) else "follows points through more photos"
    return chosen, f"{against}: both explain what was matched alike, and it {lead}"


def confirmed(poses: Poses, other: Candidate | None) -> frozenset[str]:
    """Photos whose poses agree with those of the other mapper.

    Of its pieces the one that most agree with counts, for how pieces lie to each other it does not say.
    """
    pieces = [] if other is None else [other.poses, *other.apart]
    return max((compare(piece, poses).same for piece in pieces), key=len, default=frozenset())


def doubt(poses: Poses, other: Candidate | None) -> str:
    """One sentence where too few photos are sure; "" where all is well."""
    sure = confirmed(poses, other)
    if len(sure) >= _MOSTLY * len(poses):
        return ""
    if other is None:
        return f"nothing confirms the poses of these {len(poses)} photos, for one mapper alone found any; look at them"
    lacking = len(set(poses).difference(other.poses, *other.apart))
    apart = len(set().union(*other.apart).intersection(poses).difference(sure))
    unlike = len(poses) - len(sure) - lacking - apart
    parts = [f"poses {unlike} of them differently"] if unlike > 0 else []
    parts += [f"has {apart} in pieces of their own"] if apart else []
    parts += [f"has no pose for {lacking}"] if lacking else []
    return (
        f"{len(sure)} of {len(poses)} posed photos are sure; {_WORDS[other.mapper]} {' and '.join(parts)}, so look at "
        "the result before you trust it"
    )


def _figures(candidate: Candidate, matches: int) -> str:
    share = candidate.explained / matches if matches else 0.0
    return (
        f"{len(candidate.poses)} photos, {share:.1%} of the matches, mean track {candidate.track:.2f}, error "
        f"{candidate.error:.2f} pixels"
    )
