"""One small pool of threads for every compiled CPU kernel.

Kernels release the GIL, so plain Python threads run them on all cores. One pool for all of them (and not OpenMP
inside each) keeps a second threading runtime from fighting torch's over the same cores.
"""

from __future__ import annotations

import ctypes
import os
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import cache
from typing import TypeVar

import torch

S = TypeVar("S")
T = TypeVar("T")


def thread_count() -> int:
    """Threads to use: HYRFPACK_THREADS, else the cores this process may run on."""
    asked = os.environ.get("HYRFPACK_THREADS", "")
    if asked.isdigit() and int(asked) > 0:
        return int(asked)
    return cores()


def cores() -> int:
    """Cores this process may run on."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


_this_thread = threading.local()


def _be_one_core() -> None:
    """Each worker is one core's worth of work: neither torch nor this pool shall fan out again inside it."""
    torch.set_num_threads(1)
    _this_thread.works = True


@cache
def _executor(threads: int) -> ThreadPoolExecutor:
    # A thread that torch has not asked for its number yet takes the one that was set last, in whatever thread: asked
    # now, this one keeps its own.
    torch.get_num_threads()
    return ThreadPoolExecutor(threads, thread_name_prefix="hyrfpack", initializer=_be_one_core)


def _after_fork() -> None:
    """A forked child has none of its parent's threads: the pool starts its own; torch would wait for them for ever."""
    _executor.cache_clear()
    torch.set_num_threads(1)


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_after_fork)


@cache
def keep_freed_memory() -> None:
    """Ask the C library to reuse large blocks instead of giving them back to the system (glibc only).

    A training step frees and allocates the same tens of megabytes again and again; having the system clear fresh
    pages for them each time costs a tenth of the step.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None) if os.name == "posix" else None
    if mallopt is not None:
        trim_threshold, mmap_threshold = -1, -3
        mallopt(trim_threshold, 1 << 30)
        mallopt(mmap_threshold, 1 << 30)


@contextmanager
def torch_on_one_thread() -> Iterator[None]:
    """Keep torch from spreading single operations over threads while this pool does the work.

    The many small operations of a training step gain nothing from torch's own threads, which go on spinning after
    each one on the cores the pool needs: with both, a step takes 3 to 10 times as long.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def run_tasks(task: Callable[[int], None], count: int, *, little: bool = False) -> None:
    """Call task(0) ... task(count - 1) on the pool's threads and wait for all; then the first error is raised here.

    Tasks are pulled one by one, so uneven ones balance. Results must not depend on which thread ran what: each
    task writes to its own place. Inside of a task, further ones run one after the other, and so do those that are so
    `little` work all together that they are done before a thread is awake (some 50 microseconds).
    """
    threads = thread_count()
    if little or count == 1 or threads == 1 or getattr(_this_thread, "works", False):
        for index in range(count):
            task(index)
        return
    pending = iter(range(count))
    errors: dict[int, BaseException] = {}

    def worker() -> None:
        # next() on a range iterator is atomic under the GIL.
        for index in pending:
            try:
                task(index)
            except BaseException as error:
                errors[index] = error
                for _ in pending:  # nothing new is begun
                    pass

    for future in [_executor(threads).submit(worker) for _ in range(min(threads, count))]:
        future.result()
    if errors:
        raise errors[min(errors)]


def run_ranges(task: Callable[[int, int], None], length: int, minimum: int = 2048) -> None:
    """Split [0, length) into contiguous ranges, a few for each thread, and call task(start, stop) on each."""
    if length == 0:
        return
    ranges = max(1, min(4 * thread_count(), length // minimum))
    edges = [length * i // ranges for i in range(ranges + 1)]
    run_tasks(lambda i: task(edges[i], edges[i + 1]), ranges)


def side_by_side(
    function: Callable[[S], T],
    items: Sequence[S],
    device: torch.device = torch.device("cpu"),  # noqa: B008 - a constant
) -> list[T]:
    """What a function returns for each item, in their order; an item a core at a time.

    Args:
        device: where it does its work. Any but the CPU takes one item after the other, which fill it.

    Example:
        >>> side_by_side(abs, [-2, 3])
        [2, 3]
    """
    if device.type != "cpu":
        return [function(item) for item in items]
    done: dict[int, T] = {}

    def run(index: int) -> None:
        done[index] = function(items[index])

    run_tasks(run, len(items))
    return [done[index] for index in range(len(items))]


def run_jobs(jobs: dict[str, Callable[[], T]]) -> dict[str, T]:
    """What independent jobs return; they run side by side."""
    return dict(zip(jobs, side_by_side(lambda job: job(), list(jobs.values())), strict=True))
