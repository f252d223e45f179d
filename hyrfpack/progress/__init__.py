"""Progress of long work: the events that a call reports, and the displays that show them.

A call reports `Event`s to one function, its `Progress`. `hyrfpack.RunContext` names that function, or leaves the choice
of a display to `open_display`. Nothing here imports torch.
"""

from hyrfpack.progress.display import open_display
from hyrfpack.progress.events import (
    Event,
    Progress,
    StageEvent,
    StepEvent,
    TaskEvent,
    count_calls,
    ignore_progress,
    part_of_progress,
    round_of_progress,
)
from hyrfpack.progress.reports import Report, no_report, report_each_call, report_part, report_round, report_to

__all__ = [
    "Event",
    "Progress",
    "Report",
    "StageEvent",
    "StepEvent",
    "TaskEvent",
    "count_calls",
    "ignore_progress",
    "no_report",
    "open_display",
    "part_of_progress",
    "report_each_call",
    "report_part",
    "report_round",
    "report_to",
    "round_of_progress",
]
