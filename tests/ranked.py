"""Processes that meet as torchrun's do, without its cost: forked from one that has loaded torch already; see also
`scenes` and `commands`.

What they run has to lie in a module that a fresh process can import, as those beside this one.
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
    reason="processes are forked here, which talk by gloo",
)
PRELOADED = ["torch.distributed", "matplotlib.backends.backend_agg", "ranked_warm", "ranked"]


@dataclass(frozen=True)
class Ended:
    """How a process ended: what its work returned, or the sentence of its HyrfError; nothing of one that was killed.

    Attributes:
        output, errors: what a command printed.
    """

    exit_code: int | None
    result: Any = None
    refusal: str | None = None
    output: str = ""
    errors: str = ""

    @property
    def sentence(self) -> str:
        """The one line on standard error that a command refused with."""
        (line,) = [line for line in self.errors.splitlines() if line.startswith("Error: ")]
        assert "Traceback" not in self.errors
        return line


def free_port() -> int:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        return taken.getsockname()[1]


def told_by_torchrun(rank: int, size: int, port: int) -> dict[str, str]:
    """The environment of a rank."""
    numbers = {"RANK": rank, "WORLD_SIZE": size, "LOCAL_RANK": rank, "LOCAL_WORLD_SIZE": size, "MASTER_PORT": port}
    return {"MASTER_ADDR": "127.0.0.1", **{name: str(number) for name, number in numbers.items()}}


def together(work: Callable[..., Any], *arguments: Any, size: int = 2, patience: float = 120) -> list[Ended]:
    """Have so many processes join and call `work(ranks, *arguments)`; by rank, how they ended."""
    return _ended([(_joined, (work, *arguments))] * size, patience)


def commanded(*words: object, folder: Path, size: int = 2, patience: float = 120) -> list[Ended]:
    """Call the command line in so many processes, as torchrun would; by rank, how they ended.

    Args:
        folder: for what they print, made if missing.
    """
    folder.mkdir(parents=True, exist_ok=True)
    said = [(folder / f"output{rank}", folder / f"errors{rank}") for rank in range(size)]
    jobs = [(_commanded, ([str(word) for word in words], *said[rank])) for rank in range(size)]
    return [
        Ended(end.exit_code, output=output.read_text(), errors=errors.read_text())
        for end, (output, errors) in zip(_ended(jobs, patience), said, strict=True)
    ]


def _ended(jobs: Sequence[tuple[Callable, tuple]], patience: float) -> list[Ended]:
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(PRELOADED)
    with mock.patch.dict(os.environ, PYTHONPATH=os.pathsep.join(filter(None, sys.path))):
        forkserver.ensure_running()
    port, until, started = free_port(), time.monotonic() + patience, []
    for rank, (task, arguments) in enumerate(jobs):
        answers, telling = context.Pipe(duplex=False)
        told = told_by_torchrun(rank, len(jobs), port)
        process = context.Process(target=_rank, args=(told, telling, task, arguments), daemon=True)
        process.start()
        telling.close()
        started.append((process, answers))
    try:
        return [_end_of(*each, until) for each in started]
    finally:
        for process, _ in started:
            if process.is_alive():
                process.kill()


def _end_of(process: Any, answers: Any, until: float) -> Ended:
    result = refusal = None
    try:
        if answers.poll(max(0, until - time.monotonic())):
            result, refusal = answers.recv()
    except EOFError:  # it was killed, or a command that answers otherwise
        pass
    process.join(max(0, until - time.monotonic()))
    if process.exitcode is None:
        pytest.fail(f"{process.name} has not ended in time")
    return Ended(process.exitcode, result, refusal)


def _rank(told: dict[str, str], telling: Any, task: Callable, arguments: tuple) -> None:
    os.environ.update(told)
    task(telling, *arguments)


def _joined(telling: Any, work: Callable, *arguments: Any) -> None:
    try:
        with join_processes() as ranks:
            answer = work(ranks, *arguments), None
    except HyrfError as error:
        answer = None, str(error)
    telling.send(answer)
    sys.exit(2 if answer[1] else 0)


def _commanded(telling: Any, words: list[str], output: Path, errors: Path) -> None:
    for number, path in ((1, output), (2, errors)):
        file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
        os.dup2(file, number)
    main(words)
