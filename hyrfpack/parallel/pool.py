"""One thread pool that all compiled CPU kernels share.

Kernels release the GIL, so plain Python threads run them on all cores. One pool for all kernels, instead of OpenMP in
each kernel, avoids a second threading runtime that would compete with torch's for the same cores.
"""

from __future__ import annotations

import ctypes
import os
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from functools import cache
from typing import TypeVar

import torch

from hyrfpack.parallel.threads import thread_count

S = TypeVar("S")
T = TypeVar("T")

# The C library keeps at most this much free memory: inside `keep_freed_memory`, and after it.
MAX_KEPT_BYTES_INSIDE = 1 << 30
MAX_KEPT_BYTES_AFTER = 1 << 20
# The largest size of kept blocks that older versions of glibc accept.
MAX_OLD_MMAP_THRESHOLD_BYTES = 1 << 25
ROWS_PER_BLOCK = 1 << 14

_thread_state = threading.local()


def _limit_worker_to_one_core() -> None:
    """Initialise a worker thread so that neither torch nor this pool starts further threads inside it."""
    torch.set_num_threads(1)
    _thread_state.is_worker = True


def _available_threads() -> int:
    """Return the number of threads for tasks: that of the pool, or 1 in one of its threads."""
    return 1 if getattr(_thread_state, "is_worker", False) else thread_count()


@cache
def _executor(threads: int) -> ThreadPoolExecutor:
    # torch assigns a thread its thread count at the first query, and takes the count that any thread set last. The
    # query here fixes the count of the calling thread before the workers set theirs to 1.
    torch.get_num_threads()
    return ThreadPoolExecutor(threads, thread_name_prefix="hyrfpack", initializer=_limit_worker_to_one_core)


def _reset_threads_after_fork() -> None:
    """Make the pool start new threads in a forked child, which has none of its parent's threads.

    torch is limited to one thread there, because it would wait for its missing threads for ever.
    """
    _executor.cache_clear()
    torch.set_num_threads(1)


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_reset_threads_after_fork)


@contextmanager
def keep_freed_memory() -> Iterator[None]:
    """Make the C library reuse large memory blocks instead of returning them to the system while the block runs.

    Every training step frees and allocates the same tens of megabytes. If the system clears new pages for them each
    time, a step takes 10 % longer. Afterwards all free memory is returned, and blocks of 1 MiB and more for which the
    heap has no room are returned as soon as they are freed, which makes a compression that follows 15 to 20 % slower.
    This needs glibc; with other C libraries it does nothing.
    """
    _set_max_kept_bytes(MAX_KEPT_BYTES_INSIDE)
    try:
        yield
    finally:
        _set_max_kept_bytes(MAX_KEPT_BYTES_AFTER)
        return_freed_memory()


def return_freed_memory() -> None:
    """Return all free memory of the C library to the system, before the next stage allocates blocks of other sizes.

    Free blocks between others stay with the process otherwise: a third of a gigabyte while a million Gaussians are
    compressed. This needs glibc; with other C libraries it does nothing.
    """
    if (malloc_trim := getattr(_c_library(), "malloc_trim", None)) is not None:
        malloc_trim(0)


def _set_max_kept_bytes(max_bytes: int) -> None:
    """Let the C library keep at most `max_bytes` of free memory, and freed blocks below that size."""
    if (mallopt := getattr(_c_library(), "mallopt", None)) is not None:
        trim_threshold, mmap_threshold = -1, -3
        mallopt(trim_threshold, max_bytes)
        if not mallopt(mmap_threshold, max_bytes):
            mallopt(mmap_threshold, MAX_OLD_MMAP_THRESHOLD_BYTES)


@cache
def _c_library() -> ctypes.CDLL | None:
    return ctypes.CDLL(None) if os.name == "posix" else None


@contextmanager
def torch_on_one_thread() -> Iterator[None]:
    """Limit torch to one thread for each operation while the block runs, so that this pool has the cores.

    The many small operations of a training step do not run faster on torch's own threads. After each operation those
    threads keep spinning on the cores that the pool needs: a step then takes 3 to 10 times as long.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def run_tasks(task: Callable[[int], None], count: int, *, sequential: bool = False) -> None:
    """Call task(0) ... task(count - 1) on the threads of the pool and wait until all have finished.

    Threads take tasks one by one, so that tasks of different length are balanced. The result must not depend on which
    thread runs which task, so each task must write to its own memory. Tasks that are started inside a task run one
    after the other in the same thread. After the first error or an interrupt no further task is started.
    After an interrupt, tasks that have begun may still run when this raises.

    Args:
        task: function of the task's index.
        count: number of tasks.
        sequential: run all tasks in the calling thread. This is faster if they take less time together than waking a
            thread (about 50 microseconds).

    Raises:
        BaseException: the error of the failed task with the lowest index.
    """
    threads = _available_threads()
    if sequential or count == 1 or threads == 1:
        for index in range(count):
            task(index)
        return
    pending = iter(range(count))
    errors: dict[int, BaseException] = {}

    def drop_pending_tasks() -> None:
        """Keep all threads from starting further tasks."""
        for _ in pending:
            pass

    def worker() -> None:
        # next() on a range iterator is atomic under the GIL.
        for index in pending:
            try:
                task(index)
            except BaseException as error:
                errors[index] = error
                drop_pending_tasks()

    try:
        for future in [_executor(threads).submit(worker) for _ in range(min(threads, count))]:
            future.result()
    except BaseException:  # such as Ctrl-C, which only the main thread notices
        drop_pending_tasks()
        raise
    if errors:
        raise errors[min(errors)]


def run_ranges(task: Callable[[int, int], None], length: int, minimum: int = 2048) -> None:
    """Split [0, length) into contiguous ranges, up to four for each thread, and call task(start, stop) on each.

    Args:
        task: function of a range's start and stop.
        length: number of items.
        minimum: smallest number of items in a range, unless there are fewer.
    """
    if length == 0:
        return
    ranges = max(1, min(4 * thread_count(), length // minimum))
    edges = [length * i // ranges for i in range(ranges + 1)]
    run_tasks(lambda i: task(edges[i], edges[i + 1]), ranges)


def parallel_map(
    function: Callable[[S], T],
    items: Sequence[S],
    device: torch.device = torch.device("cpu"),  # noqa: B008 - a constant
) -> list[T]:
    """Call a function for each item on the threads of the pool and return the results in the order of the items.

    Args:
        function: called once for each item, in any order.
        items: arguments of the calls.
        device: the device that the function computes on. On any other than the CPU the calls run one after the other,
            because each of them occupies the whole device.

    Example:
        >>> parallel_map(abs, [-2, 3])
        [2, 3]
    """
    if device.type != "cpu":
        return [function(item) for item in items]
    results: dict[int, T] = {}

    def run(index: int) -> None:
        results[index] = function(items[index])

    run_tasks(run, len(items))
    return [results[index] for index in range(len(items))]


def iterate_results(
    function: Callable[[S], T],
    items: Iterable[S],
    device: torch.device = torch.device("cpu"),  # noqa: B008 - a constant
) -> Iterator[T]:
    """Yield the results of a function in the order of the items, while the pool's threads compute the next ones.

    Unlike `parallel_map` it holds few items and results at a time: up to twice as many as the pool has threads. A
    thread that has finished an item does not wait for the others. After an error, or if the iterator is closed early,
    no further call is started, and those that have begun are waited for.

    Args:
        function: called once for each item, on any of the threads.
        items: arguments of the calls, taken from the iterable in the thread of the caller.
        device: as `parallel_map` takes it.

    Example:
        >>> list(iterate_results(abs, [-2, 3]))
        [2, 3]
    """
    threads = _available_threads()
    if device.type != "cpu" or threads == 1:
        yield from map(function, items)
        return
    calls: deque[Future[T]] = deque()
    try:
        for item in items:
            if len(calls) == 2 * threads:
                yield calls.popleft().result()
            calls.append(_executor(threads).submit(function, item))
        while calls:
            yield calls.popleft().result()
    finally:
        for call in calls:
            call.cancel()
        wait(calls)


def map_row_blocks(function: Callable[[slice], torch.Tensor], rows: int, device: torch.device) -> torch.Tensor:
    """Call a function for blocks of rows on the threads of the pool and join its results (n, ...) along the rows.

    Large element-wise operations run faster in blocks, because their temporary arrays then stay in the caches.

    Args:
        function: called without gradients with the rows of each block; their values must not depend on other rows.
        rows: number of rows.
        device: as `parallel_map` takes it.
    """
    starts = range(0, max(rows, 1), ROWS_PER_BLOCK)
    blocks = [slice(start, min(start + ROWS_PER_BLOCK, rows)) for start in starts]
    return torch.cat(parallel_map(torch.no_grad()(function), blocks, device))


def run_jobs(jobs: dict[str, Callable[[], T]]) -> dict[str, T]:
    """Run independent jobs on the threads of the pool and return their results by the names of the jobs."""
    return dict(zip(jobs, parallel_map(lambda job: job(), list(jobs.values())), strict=True))
