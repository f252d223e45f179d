"""The process that one stage of an estimation runs in: `python -m hyrfpack.poses.worker JOB STAGE [MODEL ...]`.

It says what it does as lines of JSON on standard output, the last of them the answer. It ends when whoever started it
is gone: standard input is closed then, and on Linux the kernel kills it, for a long call into the library holds up
every thread of Python's.
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

import hyrfpack  # first: it imports zlib before pycolmap  # noqa: F401
from hyrfpack.errors import HyrfError
from hyrfpack.poses.job import Job

_one_at_a_time = threading.Lock()  # a second thread tells of progress during long calls, see `watch`
_DIES_WITH_PARENT = 1  # PR_SET_PDEATHSIG


def say(message: dict[str, Any]) -> None:
    """Send one line to whoever started this."""
    with _one_at_a_time:
        sys.stdout.write(json.dumps(message) + "\n")
        sys.stdout.flush()


def tell(doing: str, share: float) -> None:
    """Say what is going on, and the share of this stage that is done."""
    say({"doing": doing, "share": share})


def run(job: Job, stage: str, models: list[str]) -> dict[str, Any]:
    """Run one stage; `models` are the mappers' results that "finish" chooses between."""
    if stage == "features":
        from hyrfpack.poses.features import find_features

        return find_features(job, tell)
    if stage == "matches":
        from hyrfpack.poses.matching import match

        return match(job, tell)
    if stage == "finish":
        from hyrfpack.poses.finish import finish

        return finish(job, models, tell)
    from hyrfpack.poses.mapping import map_globally, map_incrementally

    return {"global": map_globally, "incremental": map_incrementally}[stage](job, tell)


def main(job: str, stage: str, *models: str) -> None:
    """Run one stage of a job and say what came out."""
    _die_with_parent()
    try:
        answer = run(Job.load(Path(job)), stage, list(models))
    except HyrfError as error:
        answer = {"refused": str(error)}
    say({"answer": answer})


def _die_with_parent() -> None:
    parent = os.getppid()
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_DIES_WITH_PARENT, signal.SIGKILL)
        if os.getppid() != parent:
            os._exit(1)

    def watch() -> None:
        os.read(0, 1)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


if __name__ == "__main__":
    main(*sys.argv[1:])
