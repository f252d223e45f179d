"""Time tasks on a device, and measure the device's peak rates: copied bytes and matrix operations per second."""

from __future__ import annotations

import gc
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

import torch

from hyrfpack.measure.timing import Clock, time_alternately

# This buffer is written before each measurement. It is larger than any L2 cache, so that each task starts with a cold
# cache, and writing it takes so long that the host has queued a short task before the task starts.
FLUSH_BYTES = 1 << 30
WARM_RUNS = 3
# torch calls the first to read a number from the device, and the trainer the second for the numbers of the step before.
# The wait at the end of a profile is another call, which is not counted.
WAIT_CALL_NAMES = ("cudaStreamSynchronize", "cudaEventSynchronize", "hipStreamSynchronize", "hipEventSynchronize")


@dataclass(frozen=True)
class Rates:
    """Peak rates that were measured on this device.

    Attributes:
        copy: bytes read plus bytes written per second in a large copy.
        bf16, fp32: floating point operations per second in a large matrix product; fp32 without TF32.
    """

    copy: float
    bf16: float
    fp32: float


def synchronize(device: torch.device) -> None:
    """Wait until the device has finished all queued work."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def measure_median_ms(
    tasks: Mapping[str, Callable[[], object]], repeats: int, device: torch.device
) -> dict[str, float]:
    """Return the median milliseconds of each task; the tasks alternate.

    On a GPU the time is that between two CUDA events, after warm-up runs and each time after a cache flush. On a CPU it
    is wall-clock time.
    """
    clock = None
    if device.type == "cuda":
        clock = make_event_clock(device)
        for task in WARM_RUNS * list(tasks.values()):  # the first run builds the kernels
            task()
    return {name: time.ms for name, time in time_alternately(tasks, repeats, clock)[0].items()}


def make_event_clock(device: torch.device) -> Clock:
    """Return a clock that times a task on a GPU by CUDA events."""
    flushed = torch.empty(FLUSH_BYTES, dtype=torch.uint8, device=device)

    def measure(task: Callable[[], object]) -> tuple[None, float, float]:
        start, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
        flushed.zero_()
        start.record()
        task()
        end.record()
        end.synchronize()
        return None, 1e-3 * start.elapsed_time(end), 0.0

    return measure


def reset_peak_memory(device: torch.device) -> None:
    """Reset the peak that `read_peak_memory_mb` reports."""
    gc.collect()  # frees the tensors of a finished training run
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)


def read_peak_memory_mb(device: torch.device) -> float | None:
    """Return the peak memory of tensors since `reset_peak_memory` in MB; None on a CPU, where it is not counted."""
    return torch.cuda.max_memory_allocated(device) / 1e6 if device.type == "cuda" else None


@cache
def measure_rates(device: torch.device) -> Rates:
    """Measure the peak rates: medians of copying 1 GiB and of multiplying 8192 x 8192 matrices; smaller on a CPU."""
    large = device.type == "cuda"
    count, side = (1 << 28, 8192) if large else (1 << 18, 128)
    source = torch.rand(count, device=device)
    target = torch.empty_like(source)
    single = torch.randn(side, side, device=device)
    half = single.bfloat16()
    tf32 = torch.backends.cuda.matmul.allow_tf32
    torch.backends.cuda.matmul.allow_tf32 = False
    try:
        times = measure_median_ms(
            {
                "copy": lambda: target.copy_(source),
                "bf16": lambda: half @ half,
                "fp32": lambda: single @ single,
            },
            7,
            device,
        )
    finally:
        torch.backends.cuda.matmul.allow_tf32 = tf32
    return Rates(
        copy=2 * 4 * count / (1e-3 * times["copy"]),
        bf16=2 * side**3 / (1e-3 * times["bf16"]),
        fp32=2 * side**3 / (1e-3 * times["fp32"]),
    )


@dataclass(frozen=True)
class Profile:
    """Kernels, launches and waits of one run of a task on a GPU.

    Attributes:
        times: milliseconds in each kernel by name, longest first, including copies and fills.
        launches: number of kernel launches.
        waits: number of times that the host waits for the device.
    """

    times: dict[str, float]
    launches: float
    waits: float


def profile_task(task: Callable[[], object], runs: int, device: torch.device) -> Profile:
    """Profile a task with torch's profiler; return the mean of `runs` runs, or an empty profile without a GPU."""
    if device.type != "cuda":
        return Profile({}, 0.0, 0.0)
    from torch.profiler import ProfilerActivity, profile

    task()
    synchronize(device)
    with profile(activities=[ProfilerActivity.CUDA]) as profiler:
        for _ in range(runs):
            task()
        synchronize(device)
    return summarize_events(profiler.key_averages(), runs)


def summarize_events(events: Iterable[Any], runs: int) -> Profile:
    """Return the profile of one run from the sums that torch's profiler reports over `runs` runs."""
    times: dict[str, float] = {}
    launches = waits = 0.0
    for event in events:
        if str(event.device_type).endswith("CUDA") and event.self_device_time_total:
            times[event.key] = times.get(event.key, 0.0) + 1e-3 * event.self_device_time_total / runs
            launches += event.count / runs
        elif event.key in WAIT_CALL_NAMES:
            waits += event.count / runs
    return Profile(dict(sorted(times.items(), key=lambda item: -item[1])), launches, waits)


def group_kernels(
    times: Mapping[str, float], groups: Mapping[str, tuple[str, ...]], rest: str = "other"
) -> dict[str, float]:
    """Return the milliseconds of each group of kernels.

    Args:
        times: milliseconds by kernel name.
        groups: the words of each group; a kernel belongs to the first group that has a word of the kernel's name.
        rest: the name of the group for all other kernels.
    """
    grouped = dict.fromkeys((*groups, rest), 0.0)
    for name, ms in times.items():
        lower = name.lower()
        grouped[next((group for group, words in groups.items() if any(w in lower for w in words)), rest)] += ms
    return grouped
