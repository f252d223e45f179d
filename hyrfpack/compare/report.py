"""The comparison of training runs, from their folders to a page."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from hyrfpack.atomic import write_atomic
from hyrfpack.compare.differences import check_scores, doubts
from hyrfpack.compare.page import encode_comparison
from hyrfpack.compare.run import read_run, short_names
from hyrfpack.compare.views import read_views
from hyrfpack.errors import HyrfError
from hyrfpack.format.run_folder import METRICS_FILE, MODEL_FILE
from hyrfpack.outputs import Outputs, StrPath


@dataclass(frozen=True)
class ComparisonReport:
    """What a comparison came to.

    Attributes:
        file: the page.
        bytes: of it.
        runs: what the page calls the runs.
        views: names of the held-out photos whose renders can be looked at.
        doubts: a sentence for each reason why runs cannot be compared by all their numbers; the page says so, too.
    """

    file: str
    bytes: int
    runs: list[str]
    views: list[str]
    doubts: list[str]


def compare(runs: Sequence[StrPath], out: StrPath, *, overwrite: bool = False) -> ComparisonReport:
    """Write one page that shows finished training runs side by side.

    It has a table of scores, sizes, times and whatever settings and choices differ; the training curves; and held-out
    photos against renders, or renders of two runs against each other, with a slider. Everything is inside the page,
    which fetches nothing. Pictures come from the runs' own, so that neither photos nor rendering are needed.

    Args:
        runs: folders that `hyrfpack.train` wrote to, two or more.
        out: the page, an .html file.
        overwrite: replace the file if it is there. Without it, a file that appears in the meantime is kept, too:
            the page gets a free name beside it, which the report names.

    Raises:
        TypeError: `runs` is one path.
        HyrfError: there are fewer than two runs or the same one twice, one is not finished or its files are damaged,
            the scores are of different photos, or the page cannot be written, or not without overwriting.

    Example:
        >>> import hyrfpack
        >>> report = hyrfpack.compare(["runs/bonsai", "runs/again"], "comparison.html", overwrite=True)
        >>> report.runs, report.views, report.doubts
        (['bonsai', 'again'], ['0000.png', '0008.png'], [])
    """
    if isinstance(runs, str | os.PathLike):
        raise TypeError(f"runs must be several folders, not {os.fspath(runs)!r} alone; give a list of them")
    folders = [Path(run) for run in runs]
    if len({os.path.realpath(folder) for folder in folders}) < max(2, len(folders)):
        raise HyrfError("there are not two different runs to compare; name two folders of runs or more, each once")
    found = [read_run(folder) for folder in folders]
    read = [
        path for run in found for path in (run.folder / METRICS_FILE, run.folder / MODEL_FILE, *run.pictures.values())
    ]
    Outputs(*read, overwrite=overwrite).file(out, ".html", ".htm")
    names = short_names(folders)
    check_scores(found, names)
    views = read_views(found)
    said = doubts(found, names, [view.name for view in views if not view.same])
    views = [view for view in views if view.same]
    page = encode_comparison(found, names, views, said)
    written = write_atomic(out, page, overwrite=overwrite)
    return ComparisonReport(str(written), len(page), names, [view.name for view in views], said)
