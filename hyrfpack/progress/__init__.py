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
    items_of_progress,
    part_of_progress,
    round_of_progress,
)

__all__ = [
    "Event",
    "Progress",
    "StageEvent",
    "StepEvent",
    "TaskEvent",
    "count_calls",
    "ignore_progress",
    "items_of_progress",
    "open_display",
    "part_of_progress",
    "round_of_progress",
]
