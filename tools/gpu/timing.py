"""Times of tasks on a device, and what the device can do at best: copied bytes and multiplied numbers a second."""

from __future__ import annotations

import gc
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

import torch

from hyrfpack.measure.timing import Clock, time_alternately

# Written before each measurement: more than any L2 cache holds, so that each starts cold, and so much that the host has
# queued a short task before it begins.
FLUSHED_BYTES = 1 << 30
WARM_RUNS = 3
# What torch calls to read a number from the device. It ends a profile by waiting for all of the device.
WAITS = ("cudaStreamSynchronize", "hipStreamSynchronize")


@dataclass(frozen=True)
class Rates:
    """What was measured on this very device.

    Attributes:
        copy: bytes a second of a large copy, those read and those written.
        bf16, fp32: floating point operations a second of a large matrix product; fp32 without TF32.
    """

    copy: float
    bf16: float
    fp32: float


def synchronize(device: torch.device) -> None:
    """Wait until the device has done what it was given."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def median_ms(tasks: Mapping[str, Callable[[], object]], repeats: int, device: torch.device) -> dict[str, float]:
    """Median milliseconds of each task; they take turns.

    On a GPU between two events of the stream, warm and each after a cache flush; elsewhere by the processor's clocks.
    """
    clock = None
    if device.type == "cuda":
        clock = event_clock(device)
        for task in WARM_RUNS * list(tasks.values()):  # the first builds kernels
            task()
    return {name: time.ms for name, time in time_alternately(tasks, repeats, clock)[0].items()}


def event_clock(device: torch.device) -> Clock:
    """What times a task on a GPU by events."""
    flushed = torch.empty(FLUSHED_BYTES, dtype=torch.uint8, device=device)

    def measure(task: Callable[[], object]) -> tuple[None, float, float]:
        start, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
        flushed.zero_()
        start.record()
        task()
        end.record()
        end.synchronize()
        return None, 1e-3 * start.elapsed_time(end), 0.0

    return measure


def reset_peak(device: torch.device) -> None:
    """Let `peak_mb` begin anew."""
    gc.collect()  # what training held
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)


def peak_mb(device: torch.device) -> float | None:
    """Most memory that tensors took since `reset_peak`, in MB; None where nobody counts it."""
    return torch.cuda.max_memory_allocated(device) / 1e6 if device.type == "cuda" else None


@cache
def measure_rates(device: torch.device) -> Rates:
    """Best of several: a copy of 1 GiB and products of 8192 x 8192 random matrices; small ones on a CPU."""
    large = device.type == "cuda"
    count, side = (1 << 28, 8192) if large else (1 << 18, 128)
    source = torch.rand(count, device=device)
    target = torch.empty_like(source)
    single = torch.randn(side, side, device=device)
    half = single.bfloat16()
    tf32 = torch.backends.cuda.matmul.allow_tf32
    torch.backends.cuda.matmul.allow_tf32 = False
    try:
        times = median_ms(
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
    """What one run of a task asks of a GPU.

    Attributes:
        times: milliseconds in each kernel, by name, longest first; copies and fills are among them.
        launches: how many there are.
        waits: how often the host waits for the device.
    """

    times: dict[str, float]
    launches: float
    waits: float


def profiled(task: Callable[[], object], runs: int, device: torch.device) -> Profile:
    """One run of a task, by torch's profiler; nothing where there is no GPU."""
    if device.type != "cuda":
        return Profile({}, 0.0, 0.0)
    from torch.profiler import ProfilerActivity, profile

    task()
    synchronize(device)
    with profile(activities=[ProfilerActivity.CUDA]) as profiler:
        for _ in range(runs):
            task()
        synchronize(device)
    return sum_up(profiler.key_averages(), runs)


def sum_up(events: Iterable[Any], runs: int) -> Profile:
    """One run's profile, from the averages of torch's profiler over so many runs."""
    times: dict[str, float] = {}
    launches = waits = 0.0
    for event in events:
        if str(event.device_type).endswith("CUDA") and event.self_device_time_total:
            times[event.key] = times.get(event.key, 0.0) + 1e-3 * event.self_device_time_total / runs
            launches += event.count / runs
        elif event.key in WAITS:
            waits += event.count / runs
    return Profile(dict(sorted(times.items(), key=lambda item: -item[1])), launches, waits)


def group_kernels(
    times: Mapping[str, float], groups: Mapping[str, tuple[str, ...]], rest: str = "other"
) -> dict[str, float]:
    """Milliseconds of each group of kernels; a kernel belongs to the first group one of whose words is in its name.

    Those that belong to none are under `rest`.
    """
    grouped = dict.fromkeys((*groups, rest), 0.0)
    for name, ms in times.items():
        lower = name.lower()
        grouped[next((group for group, words in groups.items() if any(w in lower for w in words)), rest)] += ms
    return grouped
