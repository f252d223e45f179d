"""Runs several processes that join as under torchrun but without its start-up cost.

They are forked from a process that has already loaded torch. What they run has to lie in a module that a fresh
process can import, as the modules in this folder do.
"""

from __future__ import annotations

import multiprocessing
import os
import socket
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from multiprocessing import forkserver
from pathlib import Path
from typing import Any
from unittest import mock

import pytest
import torch.distributed as dist

from hyrfpack.cli import main
from hyrfpack.errors import HyrfError
from hyrfpack.parallel.ranks import join_processes

needs_ranks = pytest.mark.skipif(
    os.name != "posix" or not dist.is_available() or not dist.is_gloo_available(),
    reason="these processes are forked and communicate over gloo",
)
PRELOADED_MODULES = ["torch.distributed", "matplotlib.backends.backend_agg", "rank_preload", "rank_processes"]


@dataclass(frozen=True)
class ProcessOutcome:
    """How a process ended.

    Attributes:
        exit_code: of the process; negative for the signal that killed it.
        result: what its function returned; None if it raised an error or was killed.
        error_text: the text of the HyrfError that it raised, if any.
        output, errors: standard output and standard error of a command.
    """

    exit_code: int | None
    result: Any = None
    error_text: str | None = None
    output: str = ""
    errors: str = ""

    @property
    def error_line(self) -> str:
        """The single error line that a command has printed to standard error."""
        (line,) = [line for line in self.errors.splitlines() if line.startswith("Error: ")]
        assert "Traceback" not in self.errors
        return line


def free_port() -> int:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        return taken.getsockname()[1]


def torchrun_environment(rank: int, size: int, port: int) -> dict[str, str]:
    """Return the environment that torchrun gives a rank."""
    numbers = {"RANK": rank, "WORLD_SIZE": size, "LOCAL_RANK": rank, "LOCAL_WORLD_SIZE": size, "MASTER_PORT": port}
    return {"MASTER_ADDR": "127.0.0.1", **{name: str(number) for name, number in numbers.items()}}


def run_on_ranks(
    work: Callable[..., Any], *arguments: Any, size: int = 2, timeout_seconds: float = 120
) -> list[ProcessOutcome]:
    """Call `work(ranks, *arguments)` in `size` processes that have joined, and return their outcomes by rank."""
    return _run_jobs([(_send_result, (work, *arguments))] * size, timeout_seconds)


def run_command_on_ranks(
    *words: object, folder: Path, size: int = 2, timeout_seconds: float = 120
) -> list[ProcessOutcome]:
    """Run the command line in `size` processes, as torchrun would, and return their outcomes by rank.

    Args:
        folder: for files with what they print; created if missing.
    """
    folder.mkdir(parents=True, exist_ok=True)
    files_by_rank = [(folder / f"output{rank}", folder / f"errors{rank}") for rank in range(size)]
    jobs = [(_run_command_line, ([str(word) for word in words], *files_by_rank[rank])) for rank in range(size)]
    return [
        ProcessOutcome(end.exit_code, output=output.read_text(), errors=errors.read_text())
        for end, (output, errors) in zip(_run_jobs(jobs, timeout_seconds), files_by_rank, strict=True)
    ]


def _run_jobs(jobs: Sequence[tuple[Callable, tuple]], timeout_seconds: float) -> list[ProcessOutcome]:
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(PRELOADED_MODULES)
    with mock.patch.dict(os.environ, PYTHONPATH=os.pathsep.join(filter(None, sys.path))):
        forkserver.ensure_running()
    port, deadline, started = free_port(), time.monotonic() + timeout_seconds, []
    for rank, (task, arguments) in enumerate(jobs):
        receiver, sender = context.Pipe(duplex=False)
        environment = torchrun_environment(rank, len(jobs), port)
        process = context.Process(target=_run_rank, args=(environment, sender, task, arguments), daemon=True)
        process.start()
        sender.close()
        started.append((process, receiver))
    try:
        return [_wait_for_outcome(*each, deadline) for each in started]
    finally:
        for process, _ in started:
            if process.is_alive():
                process.kill()


def _wait_for_outcome(process: Any, receiver: Any, deadline: float) -> ProcessOutcome:
    result = error_text = None
    try:
        if receiver.poll(max(0, deadline - time.monotonic())):
            result, error_text = receiver.recv()
    except EOFError:  # it was killed, or it runs a command, which sends no result
        pass
    process.join(max(0, deadline - time.monotonic()))
    if process.exitcode is None:
        pytest.fail(f"{process.name} has not ended in time")
    return ProcessOutcome(process.exitcode, result, error_text)


def _run_rank(environment: dict[str, str], sender: Any, task: Callable, arguments: tuple) -> None:
    os.environ.update(environment)
    task(sender, *arguments)


def _send_result(sender: Any, work: Callable, *arguments: Any) -> None:
    try:
        with join_processes() as ranks:
            answer = work(ranks, *arguments), None
    except HyrfError as error:
        answer = None, str(error)
    sender.send(answer)
    sys.exit(2 if answer[1] else 0)


def _run_command_line(sender: Any, words: list[str], output: Path, errors: Path) -> None:
    for number, path in ((1, output), (2, errors)):
        file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
        os.dup2(file, number)
    main(words)
