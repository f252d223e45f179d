"""The thread pool: order of results, errors, and nested tasks."""

from __future__ import annotations

import os
import platform
import subprocess
import sys
import threading
from collections.abc import Iterator
from concurrent.futures import Future

import pytest
import torch

from hyrfpack.parallel import pool
from hyrfpack.parallel.pool import (
    ROWS_PER_BLOCK,
    iterate_results,
    map_row_blocks,
    parallel_map,
    run_jobs,
    run_tasks,
)


@pytest.fixture(autouse=True)
def two_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HYRFPACK_THREADS", "2")


def test_results_have_the_order_of_the_items_and_the_names_of_the_jobs() -> None:
    assert parallel_map(lambda number: number**2, list(range(50))) == [number**2 for number in range(50)]
    assert run_jobs({name: name.upper for name in "cab"}) == {"c": "C", "a": "A", "b": "B"}
    assert parallel_map(abs, []) == []


def test_iterated_results_have_the_order_of_the_items() -> None:
    first_may_end = threading.Event()

    def square(number: int) -> int:
        if number == 0:
            assert first_may_end.wait(timeout=30)
        if number == 3:
            first_may_end.set()  # The other thread goes on while the first item takes long.
        return number**2

    assert list(iterate_results(square, range(50))) == [number**2 for number in range(50)]
    assert list(iterate_results(abs, [])) == []


def test_iterated_results_take_few_items_ahead() -> None:
    taken: list[int] = []

    def items() -> Iterator[int]:
        for number in range(50):
            taken.append(number)
            yield number

    results = iterate_results(abs, items())
    assert next(results) == 0 and len(taken) == 5  # twice the number of threads, and the one that follows
    results.close()
    assert len(taken) == 5


def test_an_error_ends_iterated_results_after_calls_that_have_begun() -> None:
    begun: list[int] = []
    ended: list[int] = []
    failed = threading.Event()

    def fail_at_two(number: int) -> int:
        begun.append(number)
        if number == 2:
            failed.set()
            raise ValueError("2")
        if number == 3:
            failed.wait(timeout=30)
        ended.append(number)
        return number

    results = iterate_results(fail_at_two, range(50))
    assert [next(results), next(results)] == [0, 1]
    with pytest.raises(ValueError, match="2"):
        next(results)
    assert sorted(ended + [2]) == sorted(begun) and len(begun) < 50


def test_iterated_results_for_a_gpu_are_computed_one_after_the_other() -> None:
    threads = list(iterate_results(lambda _: threading.current_thread(), [0, 1, 2], torch.device("cuda")))
    assert threads == 3 * [threading.current_thread()]


@pytest.mark.parametrize("count", [0, 1, ROWS_PER_BLOCK, 2 * ROWS_PER_BLOCK + 1])
def test_blocks_of_rows_are_joined_in_order_without_gradients(count: int) -> None:
    values = torch.arange(2.0 * count).reshape(count, 2).requires_grad_()

    doubled = map_row_blocks(lambda rows: 2 * values[rows], count, values.device)

    assert torch.equal(doubled, 2 * values) and not doubled.requires_grad


def test_two_items_are_processed_at_the_same_time() -> None:
    both = threading.Barrier(2, timeout=30)
    parallel_map(lambda _: both.wait(), [0, 1])


def test_items_for_a_gpu_are_processed_one_after_the_other() -> None:
    threads = []
    parallel_map(lambda _: threads.append(threading.current_thread()), [0, 1, 2], torch.device("cuda"))
    assert threads == 3 * [threading.current_thread()]


def test_nested_tasks_run_in_the_thread_of_their_task() -> None:
    """A pool that made both threads wait for a third one would never end."""

    def nested(number: int) -> set[str]:
        names: list[str] = []
        run_tasks(lambda _: names.append(threading.current_thread().name), 4)
        return {threading.current_thread().name, *names}

    assert all(len(names) == 1 for names in parallel_map(nested, list(range(8))))


def test_the_first_error_is_raised() -> None:
    def fail(number: int) -> None:
        if number >= 3:
            raise ValueError(f"{number}")

    with pytest.raises(ValueError, match="3"):
        parallel_map(fail, list(range(6)))


def test_an_interrupt_starts_no_further_task(monkeypatch: pytest.MonkeyPatch) -> None:
    """Otherwise the program ends only after all tasks, because Python waits for its threads."""
    started: list[int] = []
    interrupted = threading.Event()

    def wait_for_interrupt(number: int) -> None:
        started.append(number)
        interrupted.wait(timeout=30)

    def interrupt(future: Future) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(Future, "result", interrupt)
        run_tasks(wait_for_interrupt, 50)
    interrupted.set()
    both = threading.Barrier(2, timeout=30)
    run_tasks(lambda _: both.wait(), 2)  # both threads have left the interrupted tasks
    assert len(started) <= 2


def test_torch_uses_one_thread_inside_a_task() -> None:
    assert parallel_map(lambda _: torch.get_num_threads(), [0, 1]) == [1, 1]


@pytest.mark.acceptance
def test_torch_keeps_its_number_of_threads_outside_tasks() -> None:
    """The process is new, so that the pool's threads are the first that use torch."""
    script = (
        "import torch\nfrom hyrfpack.parallel.pool import run_tasks\n"
        "run_tasks(lambda _: None, 8)\nprint(torch.get_num_threads())"
    )
    # torch takes the number of MKL where that is set, too.
    environment = os.environ | dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "HYRFPACK_THREADS"), "2")
    done = subprocess.run([sys.executable, "-c", script], env=environment, capture_output=True, text=True)
    assert done.stdout == "2\n", done.stderr


def test_a_c_library_with_a_limit_keeps_as_much_memory_as_it_allows(monkeypatch: pytest.MonkeyPatch) -> None:
    mmap_threshold, limit = -3, 1 << 25
    thresholds = []

    class OldLibrary:
        def mallopt(self, parameter: int, nbytes: int) -> int:
            if parameter == mmap_threshold and nbytes > limit:
                return 0
            if parameter == mmap_threshold:
                thresholds.append(nbytes)
            return 1

    monkeypatch.setattr(pool, "_c_library", OldLibrary)
    with pool.keep_freed_memory():
        assert thresholds == [limit]
    assert thresholds == [limit, 1 << 20]


MEMORY_SCRIPT = """
import os
import torch
from hyrfpack.parallel.pool import keep_freed_memory

def resident_bytes():
    return int(open("/proc/self/statm").read().split()[1]) * os.sysconf("SC_PAGE_SIZE")

def allocate_and_free():
    blocks = [torch.ones(2_500_000) for _ in range(20)]  # 10 MB each

before = resident_bytes()
with keep_freed_memory():
    allocate_and_free()
    kept = resident_bytes() - before
print(kept, resident_bytes() - before)
"""


GAPS_SCRIPT = """
import os
from hyrfpack.parallel.pool import return_freed_memory

def resident_bytes():
    return int(open("/proc/self/statm").read().split()[1]) * os.sysconf("SC_PAGE_SIZE")

blocks = [bytearray(100_000) for _ in range(2000)]  # 200 MB
del blocks[::2]  # blocks between others are not returned when they are freed
before = resident_bytes()
return_freed_memory()
print(before - resident_bytes())
"""


@pytest.mark.acceptance
@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="needs glibc")
def test_freed_memory_between_blocks_is_returned() -> None:
    result = subprocess.run([sys.executable, "-c", GAPS_SCRIPT], capture_output=True, text=True, check=True)
    assert int(result.stdout) > 50e6


@pytest.mark.acceptance
@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="needs glibc")
def test_freed_memory_is_kept_for_the_block_only() -> None:
    result = subprocess.run([sys.executable, "-c", MEMORY_SCRIPT], capture_output=True, text=True, check=True)
    kept, left = map(int, result.stdout.split())
    assert kept > 150e6
    assert left < 50e6
