"""Merge models into one file, and extract parts of a merged file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from hyrfpack.atomic import write_atomic
from hyrfpack.cameras.placement import Placement
from hyrfpack.checks import check_several
from hyrfpack.config.edit import Move
from hyrfpack.edit.transform import move_frame, move_provenance, placement_of
from hyrfpack.errors import HyrfError
from hyrfpack.format.arrays import read_config
from hyrfpack.format.container import Container
from hyrfpack.format.metadata import read_metadata
from hyrfpack.format.part_names import clean_part_name, open_parts
from hyrfpack.format.parts import write_parts
from hyrfpack.format.rewrite import with_metadata
from hyrfpack.format.run_folder import find_model, name_model
from hyrfpack.format.sections import MAX_PARTS, PART_NAMES, SECTION_CONTENTS
from hyrfpack.format.shared import read_provenance, self_contained_bytes
from hyrfpack.outputs import Outputs, StrPath


@dataclass(frozen=True)
class MergedPart:
    """One part of a merged file.

    Attributes:
        name: its name in the file.
        source: path of the file that it comes from.
        gaussians, bytes: its size.
    """

    name: str
    source: str
    gaussians: int
    bytes: int


@dataclass(frozen=True)
class MergeReport:
    """What `merge_models` has written.

    Attributes:
        file: path of the file.
        bytes: its size.
        parts: its parts, the scene first.
    """

    file: str
    bytes: int
    parts: list[MergedPart]

    def to_dict(self) -> dict:
        """Return the report as numbers, strings, lists and dictionaries for JSON."""
        return asdict(self)


def merge_models(
    sources: Sequence[StrPath],
    target: StrPath,
    moves: Mapping[str, Sequence[Move]] | None = None,
    *,
    overwrite: bool = True,
) -> MergeReport:
    """Write several models into one file, in which they are drawn together in one order of depth.

    The bytes of each model are copied. The first source is the scene: its background, viewpoint and cameras are those
    of the result. The parts of a source that is a merged file itself become parts of the result.

    Args:
        sources: `.hyrf` files or folders of runs, in one world.
        target: the file to write.
        moves: moves of sources, by the name of their file without its ending or of their folder; in order.
        overwrite: replace an existing file. If False, an existing file is an error.

    Raises:
        HyrfError: a file cannot be read or written, `moves` names no source or two, there are too many parts, a
            model has no Gaussians, or some models are antialiased and others not.
        TypeError: an action of `moves` is no move.
        ValueError: there is no source.

    Example:
        >>> import hyrfpack
        >>> from hyrfpack.config.edit import Translate
        >>> report = hyrfpack.merge_models(["bonsai.hyrf", "bonsai.hyrf"], "two.hyrf")
        >>> len(report.parts), report.parts[1].name
        (2, 'bonsai 2')
    """
    check_several("sources", sources)
    if not sources:
        raise ValueError("there are no models; give at least one")
    paths = [find_model(source) for source in sources]
    stems = [name_model(source) for source in sources]
    placements = _check_moves(stems, moves or {})
    Outputs(*paths, overwrite=overwrite).file(target, ".hyrf")
    parts = _read_parts(paths, stems, placements)
    written = write_parts([(part.name, data) for part, data in parts], target, overwrite=overwrite)
    return MergeReport(written.file, written.bytes_after, [part for part, _ in parts])


def _read_parts(
    paths: Sequence[Path], stems: Sequence[str], placements: Mapping[str, Placement]
) -> list[tuple[MergedPart, bytes]]:
    """Return the parts of a merged file with their bytes, in order.

    Args:
        paths: files of the sources.
        stems: names of the sources, from which their parts get their names.
        placements: placements of moved sources, by name.

    Raises:
        HyrfError: a file cannot be read, there are too many parts, a model is empty, or some models are antialiased and
            others not.
    """
    parts: list[tuple[MergedPart, bytes]] = []
    antialiased: dict[bool, str] = {}  # the last file with and without antialiasing
    for path, stem in zip(paths, stems, strict=True):
        with Container.open(path, SECTION_CONTENTS) as container:
            is_merged = PART_NAMES in container.entries
            for name, part in open_parts(container) if is_merged else [(stem, container)]:
                if len(parts) == MAX_PARTS:
                    raise HyrfError(
                        f"{path}: with this model there are more than {MAX_PARTS} parts, which a file cannot hold",
                        fix="merge fewer models",
                    )
                count = read_metadata(part).gaussians
                if not count:
                    place = f"{path}: part '{name}'" if is_merged else path
                    raise HyrfError(f"{place}: there is no Gaussian in it to merge", fix="leave it out")
                antialiased[read_config(part).antialiased] = str(path)
                data = _move_bytes(part, placements[stem]) if stem in placements else self_contained_bytes(part)
                taken = {other.name for other, _ in parts}
                merged = MergedPart(_free_name(name, taken), str(path), count, len(data))
                parts.append((merged, data))
    if len(antialiased) > 1:
        raise HyrfError(
            f"{antialiased[True]} is antialiased and {antialiased[False]} is not, so one picture cannot show both",
            fix="train both with the same `antialiased`",
        )
    return parts


def extract_part(path: Path, part: str | None, folder: StrPath) -> Path:
    """Copy a part of a merged file into a folder and return the path of the copy; without `part`, return `path` itself.

    Raises:
        HyrfError: the file is damaged, or there is no such part.
    """
    if part is None:
        return path
    with Container.open(path, SECTION_CONTENTS) as container:
        parts = dict(open_parts(container)) if PART_NAMES in container.entries else {}
        if not parts:
            raise HyrfError(f"{path}: this file holds one model and no parts", fix="leave out `part`")
        if part not in parts:
            names = ", ".join(f"'{name}'" for name in parts)
            raise HyrfError(
                f"{path}: there is no part '{part}'; the file holds the parts {names}",
                fix="name one of them with `part`",
            )
        copy = Path(folder, "part.hyrf")
        write_atomic(copy, parts[part].read_bytes())
        return copy


def _check_moves(stems: Sequence[str], moves: Mapping[str, Sequence[Move]]) -> dict[str, Placement]:
    """Return the placement of each source that is moved, by its name."""
    placements = {}
    for name, actions in moves.items():
        if stems.count(name) != 1:
            matching = "none" if name not in stems else "more than one"
            raise HyrfError(
                f"a move names the model '{name}', but {matching} of the models {', '.join(stems)} has this name",
                fix="name a file without its folder and ending; rename a file if two have the same name",
            )
        placement = Placement()
        for action in actions:
            placement = placement.then(placement_of(action))
        placements[name] = placement
    return placements


def _move_bytes(part: Container, placement: Placement) -> bytes:
    """Return the bytes of a model that is placed elsewhere; only its metadata differ."""
    config = read_config(part)
    moved = replace(config, frame=move_frame(placement, config.frame))
    return with_metadata(part, moved, move_provenance(placement, read_provenance(part)))


def _free_name(name: str, taken: set[str]) -> str:
    """Return a name that is not taken: "chair", "chair 2", ..."""
    base = clean_part_name(name)
    names = [base, *(f"{base} {number}" for number in range(2, MAX_PARTS + 1))]
    return next(free for free in names if free not in taken)
