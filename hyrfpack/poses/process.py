"""Work that a library may crash, or be long in, is done in a process of its own."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from queue import Empty, Queue
from threading import Thread
from typing import Any

from hyrfpack.errors import HyrfDataError, HyrfError

REPEAT_SECONDS = 2.0  # without news, after which the last is told again: what is shown then goes on counting
_PATIENCE = 3.0  # seconds that a process gets to end before it is killed
_DOING = {
    "features": "finding features",
    "matches": "matching photos",
    "global": "posing all photos at once",
    "incremental": "posing photos one by one",
}
_FINISHING = "finishing the poses"
_ROOT = str(Path(__file__).parents[2])  # what hyrfpack is imported from

Tell = Callable[[str, float], None]


class Crashed(HyrfError):
    """The process of a stage ended by itself, without an answer."""


def run_stage(job: Path, stage: str, tell: Tell, *more: str) -> dict[str, Any]:
    """Run one stage of an estimation and wait for it.

    An exception here, KeyboardInterrupt above all, ends the process before it is raised on; what the stage has saved
    stays. The process ends also when this one is killed.

    Args:
        job: file of the Job.
        stage: its name, as `worker.run` knows it.
        tell: called with what is going on and the share of the stage that is done, at least every two seconds.
        more: arguments of the stage.

    Returns:
        What the stage has to say.

    Raises:
        HyrfDataError: the stage refuses the photos.
        Crashed: the process ended without an answer: the library crashed or ran out of memory or disk.
    """
    command = [sys.executable, "-m", "hyrfpack.poses.worker", str(job), stage, *more]
    path = os.pathsep.join(filter(None, (_ROOT, os.environ.get("PYTHONPATH"))))
    environment = {**os.environ, "PYTHONPATH": path}
    log = job.parent / f"{stage}.log"
    with log.open("wb") as errors:
        process = subprocess.Popen(
            command,
            env=environment,
            stdin=subprocess.PIPE,  # never written to: its end tells the process that this one is gone
            stdout=subprocess.PIPE,
            stderr=errors,
            text=True,
            encoding="utf-8",
            errors="replace",  # in what a library prints
            start_new_session=True,  # Ctrl-C reaches this process alone, which ends the other
        )
        try:
            answer = _listen(process, tell, _DOING.get(stage, _FINISHING))
            code = process.wait()
        finally:
            _end(process)
    if "refused" in answer:
        raise HyrfDataError(answer["refused"])
    if code or not answer:
        raise Crashed(_explain(stage, code, log))
    return answer


def _listen(process: subprocess.Popen, tell: Tell, doing: str) -> dict[str, Any]:
    """Hear a process out, and tell `doing` until it says something itself; returns its answer, empty for none."""
    answer: dict[str, Any] = {}
    latest: dict[str, Any] = {"doing": doing, "share": 0.0}
    tell(latest["doing"], latest["share"])
    lines: Queue[str | None] = Queue()
    Thread(target=_read_lines, args=(process, lines), daemon=True).start()
    while True:
        try:
            line = lines.get(timeout=REPEAT_SECONDS)
        except Empty:
            tell(latest["doing"], latest["share"])
            continue
        if line is None:
            return answer
        with suppress(ValueError):  # what a library prints is no JSON
            message = json.loads(line)
            if isinstance(message, dict) and "doing" in message:
                latest = message
                tell(latest["doing"], latest["share"])
            elif isinstance(message, dict) and "answer" in message:
                answer = message["answer"]


def _read_lines(process: subprocess.Popen, lines: Queue[str | None]) -> None:
    """Put the lines of a process into a queue, and None behind the last."""
    assert process.stdout is not None
    with suppress(ValueError, OSError):  # closed by `_end`
        for line in process.stdout:
            lines.put(line)
    lines.put(None)


def _end(process: subprocess.Popen) -> None:
    if process.poll() is None:
        process.terminate()
        try:
            process.wait(_PATIENCE)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
    for pipe in (process.stdin, process.stdout):
        if pipe is not None:
            with suppress(OSError):
                pipe.close()


def _explain(stage: str, code: int, log: Path) -> str:
    """One sentence about a process that ended without an answer."""
    doing = _DOING.get(stage, _FINISHING)
    text = log.read_text(encoding="utf-8", errors="replace") if log.exists() else ""
    if "disk is full" in text or "No space left" in text or "disk I/O error" in text:
        return f"{log.parent}: the disk is full; free some space and run the same command again, which goes on here"
    if "MemoryError" in text or "bad_alloc" in text or code == -signal.SIGKILL:
        return (
            f"{log.parent}: {doing} took more memory than there is; close other programs and run the same command "
            "again, which goes on here"
        )
    how = f"by signal {signal.Signals(-code).name}" if code < 0 else f"with code {code}"
    last = next((line.strip() for line in reversed(text.splitlines()) if line.strip()), "it said nothing")
    return (
        f"{log.parent}: {doing} ended {how} ({last[-160:]}); run the same command again, which goes on here, and "
        f"report it with {log.name} if it ends so again"
    )
