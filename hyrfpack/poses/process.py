"""Run the stages of an estimation in processes of their own, because pycolmap may crash or block for long."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from contextlib import suppress
from pathlib import Path
from queue import Empty, Queue
from threading import Thread
from typing import Any

from hyrfpack.errors import HyrfDataError, HyrfError
from hyrfpack.parallel.child_items import child_environment, signal_name
from hyrfpack.poses.output import disk_full_error
from hyrfpack.progress import Progress, TaskEvent

MAX_SILENCE_SECONDS = 2.0  # the last message is reported again after this time, so that a display keeps updating
MIN_FREE_BYTES = 1 << 20  # a disk with less free space is full
_TERMINATION_TIMEOUT_SECONDS = 3.0  # a process that takes longer to terminate is killed
_STAGE_DESCRIPTIONS = {
    "features": "finding features",
    "matches": "matching photos",
    "global": "global mapping",
    "incremental": "incremental mapping",
    "repeat": "repeating the mapping",
}
_FINISH_DESCRIPTION = "finishing the poses"


class StageCrashedError(HyrfError):
    """The process of a stage ended without an answer."""


def run_stage(job: Path, stage: str, report_progress: Progress, *arguments: str) -> dict[str, Any]:
    """Run one stage of an estimation in a process of its own and wait for its answer.

    An exception in this process, such as KeyboardInterrupt, terminates the stage's process before it is raised again.
    Files that the stage has saved stay. If this process is killed, the stage's process ends, too.

    Args:
        job: path of the saved Job.
        stage: name of the stage, see `worker.run`.
        report_progress: called with `TaskEvent`s, whose share is that of the stage, at least every MAX_SILENCE_SECONDS.
        arguments: further arguments of the stage.

    Returns:
        The answer of the stage.

    Raises:
        HyrfDataError: the stage rejected the photos.
        StageCrashedError: the process ended without an answer: the library crashed or ran out of memory.
        HyrfError: the disk is full, or a file cannot be read or written.
    """
    command = [sys.executable, "-m", "hyrfpack.poses.worker", str(job), stage, *arguments]
    log = job.parent / f"{stage}.log"
    with log.open("wb") as errors:
        process = subprocess.Popen(
            command,
            env=child_environment(),
            stdin=subprocess.PIPE,  # never written to; it is closed when this process ends, which ends the other one
            stdout=subprocess.PIPE,
            stderr=errors,
            text=True,
            encoding="utf-8",
            errors="replace",  # a library may print text that is not UTF-8
            start_new_session=True,  # Ctrl-C reaches only this process, which then ends the other one
        )
        try:
            answer = _read_answer(process, report_progress, _STAGE_DESCRIPTIONS.get(stage, _FINISH_DESCRIPTION))
            code = process.wait()
        finally:
            _terminate(process)
    if "refused" in answer:
        problem, fix = answer["refused"]
        raise HyrfDataError(problem, fix=fix)
    if "failed" in answer:
        problem, fix = answer["failed"]
        raise HyrfError(problem, fix=fix)
    if code or not answer:
        raise _crash_error(stage, code, log)
    return answer


def _read_answer(process: subprocess.Popen, report_progress: Progress, doing: str) -> dict[str, Any]:
    """Report the progress messages of a process until it ends; return its answer, empty if it sent none."""
    answer: dict[str, Any] = {}
    latest: dict[str, Any] = {"doing": doing, "share": 0.0}
    report_progress(TaskEvent(latest["doing"], latest["share"]))
    lines: Queue[str | None] = Queue()
    Thread(target=_read_lines, args=(process, lines), daemon=True).start()
    while True:
        try:
            line = lines.get(timeout=MAX_SILENCE_SECONDS)
        except Empty:
            report_progress(TaskEvent(latest["doing"], latest["share"]))
            continue
        if line is None:
            return answer
        with suppress(ValueError):  # lines that a library prints are not JSON
            message = json.loads(line)
            if isinstance(message, dict) and "doing" in message:
                latest = message
                report_progress(TaskEvent(latest["doing"], latest["share"]))
            elif isinstance(message, dict) and "answer" in message:
                answer = message["answer"]


def _read_lines(process: subprocess.Popen, lines: Queue[str | None]) -> None:
    """Put the output lines of a process into a queue, and None after the last one."""
    assert process.stdout is not None
    with suppress(ValueError, OSError):  # `_terminate` has closed the pipe
        for line in process.stdout:
            lines.put(line)
    lines.put(None)


def _terminate(process: subprocess.Popen) -> None:
    """Terminate a process, kill it if that takes too long, and close its pipes."""
    if process.poll() is None:
        process.terminate()
        try:
            process.wait(_TERMINATION_TIMEOUT_SECONDS)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
    for pipe in (process.stdin, process.stdout):
        if pipe is not None:
            with suppress(OSError):
                pipe.close()


def _crash_error(stage: str, code: int, log: Path) -> HyrfError:
    """Return the error that states why a process ended without an answer, from its exit code and its log."""
    doing = _STAGE_DESCRIPTIONS.get(stage, _FINISH_DESCRIPTION)
    text = log.read_text(encoding="utf-8", errors="replace") if log.exists() else ""
    is_disk_full = shutil.disk_usage(log.parent).free < MIN_FREE_BYTES  # Then the log is empty.
    if is_disk_full or any(words in text for words in ("disk is full", "No space left", "disk I/O error")):
        return disk_full_error(log.parent)
    if "MemoryError" in text or "bad_alloc" in text or (code < 0 and signal_name(code) == "SIGKILL"):
        return StageCrashedError(
            f"{log.parent}: {doing} needs more memory than is available",
            fix="close other programs and run the same command again, which resumes here",
        )
    end = f"by {signal_name(code)}" if code < 0 else f"with code {code}"
    last = next((line.strip() for line in reversed(text.splitlines()) if line.strip()), "no message in the log")
    return StageCrashedError(
        f"{log.parent}: {doing} ended {end} ({last[-160:]})",
        fix=f"run the same command again, which resumes here; if it fails again, report it and attach {log.name}",
    )
