"""Entry point of the process that runs one stage of an estimation.

The command is `python -m hyrfpack.poses.worker JOB STAGE [MODEL ...]`.
It writes its progress as lines of JSON to standard output; the last line is the answer: that of the stage, or an error,
"refused" if the photos cannot be used, otherwise "failed". It ends when its parent process
ends, because its standard input is then closed. On Linux the kernel kills it as well, because a long call into pycolmap
can block every Python thread.
"""

from __future__ import annotations

import ctypes
import json
import os
import signal
import sys
import threading
from pathlib import Path
from typing import Any

import hyrfpack  # must come first, because it imports zlib before pycolmap  # noqa: F401
from hyrfpack.errors import HyrfDataError, HyrfError, needs_package
from hyrfpack.poses.job import Job
from hyrfpack.poses.output import disk_full_error, is_disk_full
from hyrfpack.progress import Event, TaskEvent

_output_lock = threading.Lock()  # a second thread reports progress during long calls, see `watch`
_PR_SET_PDEATHSIG = 1  # option of Linux's prctl: the signal that a process gets when its parent ends


def send_message(message: dict[str, Any]) -> None:
    """Send one message to the parent process, as a line of JSON."""
    with _output_lock:
        sys.stdout.write(json.dumps(message) + "\n")
        sys.stdout.flush()


def report_progress(event: Event) -> None:
    """Send the description of the current task and the share of this stage that is done."""
    if isinstance(event, TaskEvent):
        send_message({"doing": event.task, "share": event.share})


def run(job: Job, stage: str, models: list[str]) -> dict[str, Any]:
    """Run one stage and return its answer; `models` names the mappers' results from which "finish" chooses."""
    if stage == "features":
        from hyrfpack.poses.features import find_features

        return find_features(job, report_progress)
    if stage == "matches":
        from hyrfpack.poses.matching import match_photos

        return match_photos(job, report_progress)
    if stage == "finish":
        from hyrfpack.poses.finish import finish_reconstruction

        return finish_reconstruction(job, models, report_progress)
    from hyrfpack.poses.mapping import map_globally, map_incrementally, repeat_mapping

    run_mapping = {"global": map_globally, "incremental": map_incrementally, "repeat": repeat_mapping}[stage]
    return run_mapping(job, report_progress)


def main(job: str, stage: str, *models: str) -> None:
    """Run one stage of a saved job and send its answer."""
    _exit_with_parent()
    try:
        with needs_package("estimating poses"):
            answer = run(Job.load(Path(job)), stage, list(models))
    except HyrfDataError as error:
        answer = {"refused": [error.problem, error.fix]}
    except (HyrfError, OSError) as error:
        shown = disk_full_error(Path(job).parent) if is_disk_full(error) else error
        if not isinstance(shown, HyrfError):
            raise
        answer = {"failed": [shown.problem, shown.fix]}
    send_message({"answer": answer})


def _exit_with_parent() -> None:
    """Make this process exit when its parent process ends."""
    parent = os.getppid()
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != parent:
            os._exit(1)

    def wait_for_end_of_input() -> None:
        os.read(0, 1)
        os._exit(1)

    threading.Thread(target=wait_for_end_of_input, daemon=True).start()


if __name__ == "__main__":
    main(*sys.argv[1:])
