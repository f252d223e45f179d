"""Run all groups of measurements on one subject."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass

from hyrfpack.bench.codec import measure_codec
from hyrfpack.bench.operations import measure_hash_encode, measure_mlp, measure_rasterize
from hyrfpack.bench.rendering import measure_renderer
from hyrfpack.bench.rows import Row
from hyrfpack.bench.subject import Subject, read_subject, train_built_in_subject
from hyrfpack.checks import check_type
from hyrfpack.errors import needs_package
from hyrfpack.measure.machine import describe_machine
from hyrfpack.measure.timing import MAX_SECONDS_PER_TASK
from hyrfpack.scene import Scene

_LOG = logging.getLogger(__name__)

# Groups in order of measurement. Each function takes a subject, the number of repeats, and a list, to which it appends
# a sentence for each part that is left out.
ROW_FUNCTIONS_BY_GROUP: dict[str, Callable[[Subject, int, list[str]], Iterator[Row]]] = {
    "rasterize": measure_rasterize,
    "hash_encode": measure_hash_encode,
    "mlp": measure_mlp,
    "render": measure_renderer,
    "codec": measure_codec,
}


@dataclass(frozen=True)
class BenchReport:
    """Results of `benchmark_model`.

    Attributes:
        machine: the processor that the times belong to, and versions, see `describe_machine`.
        subject: one sentence about the model, and about what quality is measured against.
        notes: sentences about what was left out or cut short.
        rows: the measurements in order.
    """

    machine: dict[str, object]
    subject: str
    notes: list[str]
    rows: list[Row]

    def to_dict(self) -> dict:
        """Convert the report to numbers, strings, lists and dictionaries, ready for JSON."""
        return asdict(self)


def benchmark_model(
    model: str | os.PathLike[str] | None = None,
    scene: Scene | None = None,
    *,
    repeats: int = 7,
    only: Sequence[str] | None = None,
) -> BenchReport:
    """Measure the time and the error of operations, renderer settings and file profiles on a model, on the CPU.

    The values of one setting are measured in turns, so that ratios are valid on a busy machine. All cores are used;
    torch uses as many threads as it is set to. Set the environment variable OMP_WAIT_POLICY=PASSIVE before torch is
    loaded, as the command line does. Otherwise torch's threads busy-wait after a reference has run, and take cores from
    the next measurement.

    Args:
        model: a `.hyrf` file, preferably the one that training wrote. None trains a built-in model for about a minute,
            which has its own photos.
        scene: held-out photos to measure quality against. Without it, quality is measured against the model's own
            pictures, from an orbit around the viewpoint stored in the file.
        repeats: measured runs of each value, at least 1; tasks that take seconds get fewer.
        only: names of the groups to measure, out of `ROW_FUNCTIONS_BY_GROUP`; None for all.

    Raises:
        HyrfError: the model or the photos cannot be used, a result is not finite, or Numba is missing.
        ValueError: a group does not exist, `repeats` is less than 1, or there is a scene without a model.
        TypeError: `scene` is not a Scene.

    Example:
        >>> import hyrfpack
        >>> report = hyrfpack.benchmark_model("bonsai.hyrf", repeats=1, only=["mlp"])
        >>> sorted({row.group for row in report.rows})
        ['mlp']
    """
    for name in only or ():
        if name not in ROW_FUNCTIONS_BY_GROUP:
            raise ValueError(f"there is no group '{name}'; there are {', '.join(ROW_FUNCTIONS_BY_GROUP)}")
    if repeats < 1:
        raise ValueError(f"repeats is {repeats}; it must be at least 1")
    if scene is not None and model is None:
        raise ValueError("a scene was given without the model of it; the built-in model has its own photos")
    if scene is not None:
        check_type("scene", scene, Scene)
    with needs_package("measuring the compiled kernels"):
        import numba  # noqa: F401 - imported here, so that it fails before the work starts
    subject = train_built_in_subject() if model is None else read_subject(model, scene)
    notes: list[str] = []
    rows: list[Row] = []
    for name in ROW_FUNCTIONS_BY_GROUP:
        if name in (only or ROW_FUNCTIONS_BY_GROUP):
            _LOG.info(f"measuring {name}")
            rows += ROW_FUNCTIONS_BY_GROUP[name](subject, repeats, notes)
    if any(row.time.repeats < repeats for row in rows):
        notes.append(f"a variant that has been measured for {MAX_SECONDS_PER_TASK:g} s is not measured again")
    return BenchReport(describe_machine(), subject.describe(), notes, rows)
