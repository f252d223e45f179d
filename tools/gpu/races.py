"""Find races between the programs of a launch, and accesses out of bounds, in Triton's interpreter.

    python -m pytest -p tools.gpu.races -m gpu tests/ops      all launches of these tests; no GPU is needed

The interpreter runs the programs of a launch one after the other, so it hides what a GPU may do at the same time. This
module runs them in random order and records the address of every load, store and atomic operation. After each launch
it compares the addresses of different programs.
"""

from __future__ import annotations

import os
import random
from collections import Counter
from collections.abc import Generator, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any
from unittest import mock

os.environ.setdefault("TRITON_INTERPRET", "1")  # Triton reads it once

import numpy as np
import pytest
import torch
from triton.runtime import interpreter

# What a launch may do wrong.
OUT_OF_BOUNDS = "access outside of all tensors of the launch"
STORED_TWICE = "two programs store different values to one address"
STORED_TWICE_AT_ONCE = "one store writes different values to one address"
LOADED_AND_STORED = "a program loads what another one stores"
LOADED_AND_ADDED = "a program loads what another one changes atomically"
STORED_AND_ADDED = "a program stores where another one changes atomically"
RELOADED = "a program loads what its other threads may have stored, without a barrier"

# This kernel gets the addresses of its tensors in a table, so they are looked up among all tensors.
KERNELS_WITH_ADDRESS_TABLES = ("adam_step_kernel",)
PROGRAM_ORDER_SEED = 1


@dataclass(frozen=True)
class Access:
    """The addresses that one operation of one program has used.

    Attributes:
        kind: "load", "store" or "atomic".
        program: number of the program.
        barriers: number of barriers that the program has passed.
        place: number of the operation in the program.
        addresses: (n,) uint64.
        width: bytes of each element.
        values: (n, width) uint8 that a store writes; None otherwise.
    """

    kind: str
    program: int
    barriers: int
    place: int
    addresses: np.ndarray
    width: int
    values: np.ndarray | None = None


@dataclass
class RaceReport:
    """What was found.

    Attributes:
        launches: number of launches of each kernel.
        compared: number of launches of each kernel with more than one program.
        found: number of launches by kernel and problem.
    """

    launches: Counter[str] = field(default_factory=Counter)
    compared: Counter[str] = field(default_factory=Counter)
    found: Counter[tuple[str, str]] = field(default_factory=Counter)

    def lines(self) -> list[str]:
        """Return the report as lines: one for each kernel, with its problems."""
        rows = [f"{'kernel':32} {'launches':>8} {'of several programs':>19}  problems"]
        for kernel, count in sorted(self.launches.items()):
            problems = [f"{problem} ({times})" for (name, problem), times in self.found.items() if name == kernel]
            rows.append(f"{kernel:32} {count:8} {self.compared[kernel]:19}  {'; '.join(problems) or 'none'}")
        return rows


def find_races(accesses: Sequence[Access]) -> set[str]:
    """Return the problems among the accesses of one launch."""
    unit = min((access.width for access in accesses), default=1)
    loads, stores, atomics = (_units([a for a in accesses if a.kind == kind], unit) for kind in _KINDS)
    problems = set()
    if _has_conflicting_stores(stores, same_place=False):
        problems.add(STORED_TWICE)
    if _has_conflicting_stores(stores, same_place=True):
        problems.add(STORED_TWICE_AT_ONCE)
    for problem, one, other in (
        (LOADED_AND_STORED, loads, stores),
        (LOADED_AND_ADDED, loads, atomics),
        (STORED_AND_ADDED, stores, atomics),
    ):
        if _shared_by_programs(one, other):
            problems.add(problem)
    if _is_reloaded(loads, stores):
        problems.add(RELOADED)
    return problems


_KINDS = ("load", "store", "atomic")
# The columns of `_units`.
_ADDRESS, _PROGRAM, _PLACE, _BARRIERS, _VALUE = range(5)


def _units(accesses: Sequence[Access], unit: int) -> np.ndarray:
    """Split accesses into units of the same number of bytes: a table with a column for each unit, and five rows.

    Without values the last row is 0.
    """
    tables = []
    for access in accesses:
        parts = access.width // unit
        addresses = (access.addresses[:, None] + (unit * np.arange(parts)).astype(np.uint64)).ravel()
        table = np.zeros((5, len(addresses)), dtype=np.int64)
        table[_ADDRESS] = addresses.astype(np.int64)
        table[_PROGRAM], table[_PLACE], table[_BARRIERS] = access.program, access.place, access.barriers
        if access.values is not None:
            padded = np.zeros((len(addresses), 8), dtype=np.uint8)
            padded[:, :unit] = access.values.reshape(-1, unit)
            table[_VALUE] = padded.view(np.int64)[:, 0]
        tables.append(table)
    return np.concatenate(tables, 1) if tables else np.zeros((5, 0), dtype=np.int64)


def _has_conflicting_stores(stores: np.ndarray, *, same_place: bool) -> bool:
    """Return whether different values are stored to one address: by one operation, or by different programs."""
    if same_place:
        order = np.lexsort((stores[_PLACE], stores[_PROGRAM], stores[_ADDRESS]))
        a, b = stores[:, order[:-1]], stores[:, order[1:]]
        is_same_store = (a[_ADDRESS] == b[_ADDRESS]) & (a[_PROGRAM] == b[_PROGRAM]) & (a[_PLACE] == b[_PLACE])
        return bool((is_same_store & (a[_VALUE] != b[_VALUE])).any())
    addresses, group = np.unique(stores[_ADDRESS], return_inverse=True)
    return bool(
        (_varies(stores[_PROGRAM], group, len(addresses)) & _varies(stores[_VALUE], group, len(addresses))).any()
    )


def _varies(values: np.ndarray, group: np.ndarray, groups: int) -> np.ndarray:
    """Return for each group whether its values differ."""
    low, high = np.full(groups, np.iinfo(np.int64).max), np.full(groups, np.iinfo(np.int64).min)
    np.minimum.at(low, group, values)
    np.maximum.at(high, group, values)
    return low != high


def _shared_by_programs(one: np.ndarray, other: np.ndarray) -> bool:
    """Return whether an address is used in both tables, by different programs."""
    shared = np.intersect1d(one[_ADDRESS], other[_ADDRESS])
    both = np.concatenate([table[:, np.isin(table[_ADDRESS], shared)] for table in (one, other)], 1)
    return bool(_varies(both[_PROGRAM], np.searchsorted(shared, both[_ADDRESS]), len(shared)).any())


def _is_reloaded(loads: np.ndarray, stores: np.ndarray) -> bool:
    """Return whether a program loads an address that it stored before, with no barrier in between."""
    first: dict[tuple[int, int, int], int] = {}
    shared = np.intersect1d(loads[_ADDRESS], stores[_ADDRESS])
    for address, program, place, barriers, _ in stores[:, np.isin(stores[_ADDRESS], shared)].T.tolist():
        key = address, program, barriers
        first[key] = min(place, first.get(key, place))
    columns = loads[:, np.isin(loads[_ADDRESS], shared)].T.tolist()
    return any(
        place > first.get((address, program, barriers), place) for address, program, place, barriers, _ in columns
    )


@contextmanager
def watch_launches(report: RaceReport, seed: int = PROGRAM_ORDER_SEED) -> Iterator[None]:
    """Check each launch of the interpreter inside this context, and add what is found to a report."""
    watcher = _Watcher(report, random.Random(seed))
    builder, executor = interpreter.InterpreterBuilder, interpreter.GridExecutor
    with (
        mock.patch.object(builder, "set_grid_dim", watcher.wrap_grid(builder.set_grid_dim)),
        mock.patch.object(builder, "set_grid_idx", watcher.wrap_program(builder.set_grid_idx)),
        mock.patch.object(builder, "create_barrier", watcher.wrap_barrier(builder.create_barrier)),
        mock.patch.object(builder, "create_masked_load", watcher.wrap_load(builder.create_masked_load)),
        mock.patch.object(builder, "create_masked_store", watcher.wrap_store(builder.create_masked_store)),
        mock.patch.object(builder, "create_atomic_rmw", watcher.wrap_atomic(builder.create_atomic_rmw)),
        mock.patch.object(executor, "_init_args_hst", watcher.wrap_arguments(executor._init_args_hst)),
        mock.patch.object(executor, "__call__", watcher.wrap_launch(executor.__call__)),
    ):
        yield


class _Watcher:
    """Replaces methods of the interpreter by ones that record what a launch does."""

    def __init__(self, report: RaceReport, generator: random.Random) -> None:
        self.report, self.generator = report, generator
        self._begin("")

    def _begin(self, kernel: str) -> None:
        self.kernel, self.accesses, self.problems = kernel, list[Access](), set[str]()
        self.grid, self.order = (1, 1, 1), [0]
        self.program = self.barriers = self.place = 0
        self.bounds = np.zeros((2, 0), dtype=np.uint64)

    def wrap_launch(self, launch: Any) -> Any:
        def run(executor: Any, *args: Any, **kwargs: Any) -> Any:
            self._begin(executor.fn.__name__)
            result = launch(executor, *args, **kwargs)
            self.report.launches[self.kernel] += 1
            self.report.compared[self.kernel] += len(self.order) > 1
            for problem in self.problems | find_races(self.accesses):
                self.report.found[self.kernel, problem] += 1
            self._begin("")
            return result

        return run

    def wrap_arguments(self, prepare: Any) -> Any:
        def run(executor: Any, args: Any, kwargs: Any) -> Any:
            prepared = prepare(executor, args, kwargs)
            tensors = [tensor for tensor in _tensors_in([*prepared[0], *prepared[1].values()]) if tensor.numel()]
            self.bounds = _bounds(tensors)
            return prepared

        return run

    def wrap_grid(self, set_grid: Any) -> Any:
        def run(builder: Any, *grid: int) -> None:
            set_grid(builder, *grid)
            self.grid, self.order = grid, list(range(grid[0] * grid[1] * grid[2]))
            self.generator.shuffle(self.order)

        return run

    def wrap_program(self, set_program: Any) -> Any:
        def run(builder: Any, x: int, y: int, z: int) -> None:
            _, height, depth = self.grid
            self.program = self.order[(x * height + y) * depth + z]
            self.barriers = self.place = 0
            row, z = divmod(self.program, depth)
            set_program(builder, *divmod(row, height), z)

        return run

    def wrap_barrier(self, barrier: Any) -> Any:
        def run(builder: Any) -> Any:
            self.barriers += 1
            return barrier(builder)

        return run

    def wrap_load(self, load: Any) -> Any:
        def run(builder: Any, pointers: Any, mask: Any, *rest: Any) -> Any:
            return load(builder, pointers, self._record("load", pointers, mask), *rest)

        return run

    def wrap_store(self, store: Any) -> Any:
        def run(builder: Any, pointers: Any, value: Any, mask: Any, *rest: Any) -> Any:
            return store(builder, pointers, value, self._record("store", pointers, mask, value), *rest)

        return run

    def wrap_atomic(self, change: Any) -> Any:
        def run(builder: Any, operation: Any, pointers: Any, value: Any, mask: Any, *rest: Any) -> Any:
            return change(builder, operation, pointers, value, self._record("atomic", pointers, mask), *rest)

        return run

    def _record(self, kind: str, pointers: Any, mask: Any, value: Any = None) -> Any:
        """Record an access; return the mask without the elements that are out of bounds, which would crash."""
        width = max(1, pointers.get_element_ty().primitive_bitwidth // 8)
        addresses = np.atleast_1d(pointers.data).astype(np.uint64)
        used = np.broadcast_to(np.atleast_1d(mask.data).astype(bool), addresses.shape)
        inside = _are_inside(addresses, width, self.bounds)
        if not inside[used].all() and self.kernel in KERNELS_WITH_ADDRESS_TABLES:
            inside = _are_inside(addresses, width, _bounds(_all_tensors()))
        if not inside[used].all():
            self.problems.add(OUT_OF_BOUNDS)
            mask = interpreter.TensorHandle((used & inside).reshape(np.shape(mask.data) or (1,)), mask.dtype)
            used = used & inside
        values = None
        if value is not None:
            stored = np.ascontiguousarray(np.broadcast_to(value.data, addresses.shape)[used])
            values = stored.view(np.uint8).reshape(len(stored), stored.dtype.itemsize)[:, :width]
        self.place += 1
        if used.any():
            self.accesses.append(Access(kind, self.program, self.barriers, self.place, addresses[used], width, values))
        return mask


def _tensors_in(values: Sequence[Any]) -> Iterator[torch.Tensor]:
    for value in values:
        if isinstance(value, tuple | list):
            yield from _tensors_in(value)
        elif isinstance(value, torch.Tensor):
            yield value


def _all_tensors() -> list[torch.Tensor]:
    import gc

    tensors = [value for value in gc.get_objects() if type(value) in (torch.Tensor, torch.nn.Parameter)]
    return [tensor for tensor in tensors if tensor.device.type == "cpu" and tensor.numel()]


def _bounds(tensors: Sequence[torch.Tensor]) -> np.ndarray:
    """Return the first and the end address of each tensor, as (2, n), with overlapping ones merged, in order.

    The elements of a view count, not those of its storage.
    """
    ranges = []
    for tensor in tensors:
        last = sum((size - 1) * stride for size, stride in zip(tensor.shape, tensor.stride(), strict=True))
        ranges.append((tensor.data_ptr(), tensor.data_ptr() + (last + 1) * tensor.element_size()))
    merged: list[list[int]] = []
    for begin, end in sorted(ranges):
        if merged and begin < merged[-1][1]:
            merged[-1][1] = max(merged[-1][1], end)
        else:
            merged.append([begin, end])
    return np.array(merged, dtype=np.uint64).reshape(-1, 2).T


def _are_inside(addresses: np.ndarray, width: int, bounds: np.ndarray) -> np.ndarray:
    """Return for each element whether it lies inside one of the ranges of `_bounds`."""
    if not bounds.shape[1]:
        return np.zeros(addresses.shape, dtype=bool)
    interval = np.searchsorted(bounds[0], addresses, side="right").astype(np.int64) - 1
    return (interval >= 0) & (addresses + np.uint64(width) <= bounds[1][np.maximum(interval, 0)])


# -- the plugin of pytest ----------------------------------------------------------------------------------------------

_report = RaceReport()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Generator[None, object, object]:
    """Watch the launches of a test."""
    with watch_launches(_report):
        return (yield)


def pytest_sessionfinish(session: pytest.Session) -> None:
    """Fail the session if something was found."""
    if _report.found:
        session.exitstatus = pytest.ExitCode.TESTS_FAILED


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Print the report."""
    terminalreporter.section(
        "launches" if os.environ.get("TRITON_INTERPRET") == "1" else "launches: none, not interpreted"
    )
    for line in _report.lines():
        terminalreporter.write_line(line)
