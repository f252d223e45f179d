"""The public function of comparisons: from the folders of training runs to a page."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from hyrfpack.atomic import write_atomic
from hyrfpack.checks import check_several
from hyrfpack.errors import HyrfError
from hyrfpack.format.run_folder import METRICS_FILE, MODEL_FILE
from hyrfpack.outputs import Outputs, StrPath
from hyrfpack.report.comparison_page import encode_comparison
from hyrfpack.report.differences import check_scores, describe_doubts
from hyrfpack.report.run import choose_short_names, read_run
from hyrfpack.report.views import read_views


@dataclass(frozen=True)
class ComparisonReport:
    """The result of a comparison.

    Attributes:
        file: path of the page.
        bytes: size of the page.
        runs: names of the runs on the page.
        views: names of the held-out photos whose renders the page shows.
        doubts: a sentence for each reason why some numbers of the runs cannot be compared; the page shows them, too.
    """

    file: str
    bytes: int
    runs: list[str]
    views: list[str]
    doubts: list[str]


def compare_runs(runs: Sequence[StrPath], out: StrPath, *, overwrite: bool = False) -> ComparisonReport:
    """Write one page that shows finished training runs side by side.

    The page has a table of scores, sizes, times and of all settings and choices that differ; the training curves; and
    held-out photos against renders, or renders of two runs against each other, with a slider. It is a single file that
    fetches nothing. Its pictures come from the folders of the runs, so neither photos nor rendering are needed.

    Args:
        runs: folders that `hyrfpack.train_model` wrote to, two or more.
        out: the page to write, an .html file.
        overwrite: replace an existing file. If False, an existing file is an error. A file that appears in the meantime
            is kept, and the page is written beside it under a free name, which the report names.

    Raises:
        TypeError: `runs` is a single path.
        HyrfError: there are fewer than two runs, a run is given twice or not finished, its files are damaged, the
            scores are of different photos, or the page cannot be written.

    Example:
        >>> import hyrfpack
        >>> report = hyrfpack.compare_runs(["runs/bonsai", "runs/again"], "comparison.html", overwrite=True)
        >>> report.runs, report.views, report.doubts
        (['bonsai', 'again'], ['0000.png', '0008.png'], [])
    """
    check_several("runs", runs)
    folders = [Path(run) for run in runs]
    if len({os.path.realpath(folder) for folder in folders}) < max(2, len(folders)):
        raise HyrfError(
            "a comparison needs at least two different runs",
            fix="give two or more folders of runs, each once",
        )
    loaded_runs = [read_run(folder) for folder in folders]
    source_files = [
        path
        for run in loaded_runs
        for path in (run.folder / METRICS_FILE, run.folder / MODEL_FILE, *run.pictures.values())
    ]
    Outputs(*source_files, overwrite=overwrite).file(out, ".html", ".htm")
    names = choose_short_names(folders)
    check_scores(loaded_runs, names)
    views = read_views(loaded_runs)
    doubts = describe_doubts(loaded_runs, names, [view.name for view in views if not view.shows_same_photo])
    views = [view for view in views if view.shows_same_photo]
    page = encode_comparison(loaded_runs, names, views, doubts)
    written_path = write_atomic(out, page, overwrite=overwrite)
    return ComparisonReport(str(written_path), len(page), names, [view.name for view in views], doubts)
