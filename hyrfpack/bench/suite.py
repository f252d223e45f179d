"""The whole measurement: groups of rows on one subject."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass

from hyrfpack.bench.codec import codec_rows
from hyrfpack.bench.operations import hash_encode_rows, mlp_rows, rasterize_rows
from hyrfpack.bench.rendering import render_rows
from hyrfpack.bench.rows import Row
from hyrfpack.bench.subject import Subject, built_in_subject, read_subject
from hyrfpack.checks import check_type
from hyrfpack.errors import needs_package
from hyrfpack.measure.machine import describe_machine
from hyrfpack.measure.timing import MAX_SECONDS_PER_TASK
from hyrfpack.scene import Scene

# What is measured, in order: functions of a subject, a number of repeats, and what to call with what was left out.
GROUPS: dict[str, Callable[[Subject, int, Callable[[str], None]], Iterator[Row]]] = {
    "rasterize": rasterize_rows,
    "hash_encode": hash_encode_rows,
    "mlp": mlp_rows,
    "render": render_rows,
    "codec": codec_rows,
}


@dataclass(frozen=True)
class BenchReport:
    """What a measurement came to.

    Attributes:
        machine: what the times belong to.
        subject: what was measured on, and what quality is against, in one sentence.
        notes: what was left out or cut short, one sentence each.
        rows: in order of measurement.
    """

    machine: dict[str, object]
    subject: str
    notes: list[str]
    rows: list[Row]

    def to_dict(self) -> dict:
        """Plain numbers, strings, lists and dictionaries, ready for JSON."""
        return asdict(self)


def bench(
    model: str | os.PathLike[str] | None = None,
    scene: Scene | None = None,
    *,
    repeats: int = 7,
    only: Sequence[str] | None = None,
    say: Callable[[str], None] = lambda sentence: None,
) -> BenchReport:
    """Measure operations, renderer settings and file profiles of a model: time, beside error.

    Contenders of one setting take turns, so that ratios hold on a busy machine. All may use all cores; torch's part
    runs on as many threads as torch is set to. Set the environment variable OMP_WAIT_POLICY=PASSIVE before torch is
    loaded, as the command line does: otherwise torch's threads go on spinning after a reference has run and take the
    cores from the next contender.

    Args:
        model: a `.hyrf` file, best the one that training wrote; None trains a built-in one for about a minute, and
            brings its own photos.
        scene: held-out photos to measure quality against; without it, it is measured against the model's own
            pictures, from viewpoints that the file hints at.
        repeats: turns of each contender, at least 1; those that take seconds get fewer.
        only: groups to measure, names out of `GROUPS`; all when None.
        say: told what is going on, a sentence before each part.

    Raises:
        HyrfError: the model or the photos cannot be used, a result is not finite, or Numba is missing.
        ValueError: there is no such group, no repeat, or a scene without a model.
        TypeError: `scene` is no Scene.

    Example:
        >>> import hyrfpack
        >>> report = hyrfpack.bench("bonsai.hyrf", repeats=1, only=["mlp"])
        >>> sorted({row.group for row in report.rows})
        ['mlp']
    """
    for name in only or ():
        if name not in GROUPS:
            raise ValueError(f"there is no group '{name}'; there are {', '.join(GROUPS)}")
    if repeats < 1:
        raise ValueError(f"repeats is {repeats}; it must be at least 1")
    if scene is not None and model is None:
        raise ValueError("a scene was given without the model of it; the built-in model has its own photos")
    if scene is not None:
        check_type("scene", scene, Scene)
    with needs_package("numba", "measuring the compiled kernels"):
        import numba  # noqa: F401 - asked for here, before the work starts
    subject = built_in_subject(say) if model is None else read_subject(model, scene)
    notes: list[str] = []
    rows: list[Row] = []
    for name in GROUPS:
        if name in (only or GROUPS):
            say(f"measuring {name}")
            rows += GROUPS[name](subject, repeats, notes.append)
    if any(row.time.repeats < repeats for row in rows):
        notes.append(f"a contender that has been measured for {MAX_SECONDS_PER_TASK:g} s gets no further turn")
    return BenchReport(describe_machine(), subject.in_words(), notes, rows)
