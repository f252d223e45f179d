"""Run the self-test in child processes, because a broken kernel may end its process or hang."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch

from hyrfpack.parallel.child_items import Row, run_in_children
from hyrfpack.self_test.cases import list_self_test_cases

# A case compiles up to ten kernels. Compilation of one takes seconds on a slow CPU, and a kernel that hangs never ends.
MAX_CASE_SECONDS = 120.0
MAX_SECONDS = 900.0
# The first item only uses the device. If it fails, the device is unusable or in use by others, whatever the kernels do.
DEVICE_ITEM = "device"
# The second item, for a GPU, launches the simplest kernel. If it fails, all other kernels would fail for that reason.
LAUNCH_ITEM = "launch"


@dataclass(frozen=True)
class SelfTest:
    """The result of a self-test.

    Attributes:
        implementation: the implementation that was tested, "gpu" or "cpu".
        device: the tested device, as torch names it.
        rows: for each case its name ("item"), what a failure replaces ("operation", see
            `SelfTestCase.replaced_operation`), its errors and the seconds that it took with compilation.
            A failed one has "status" "failed", the reason as "note", and if its kernels and plain torch ran, as
            "slowdown" how many times as long plain torch took. It has "is_temporary" True if it failed because of the
            machine's present state: memory ran out, or its process ran out of time or was killed.
        problem: why no case could run; None if they ran.
        can_launch: False if the simplest kernel could not be compiled and launched, which is then the problem.
    """

    implementation: str
    device: str
    rows: tuple[Row, ...]
    problem: str | None = None
    can_launch: bool = True

    @property
    def failed_rows(self) -> list[Row]:
        """The rows of the cases that failed."""
        return [row for row in self.rows if row.get("status") == "failed"]

    @property
    def failed_operations(self) -> dict[str, Row]:
        """The first failed row of each operation that failed in some case; temporary failures come last."""
        failed: dict[str, Row] = {}
        for row in sorted(self.failed_rows, key=is_temporary):
            failed.setdefault(str(row["operation"]), row)
        return failed

    @property
    def is_conclusive(self) -> bool:
        """Whether all cases ran, and none failed because of the machine's present state."""
        return self.problem is None and not any(map(is_temporary, self.rows))


def is_temporary(row: Row) -> bool:
    """Return whether a case failed because of the machine's present state."""
    return row.get("is_temporary") is True


def run_self_test(
    implementation: str,
    device: torch.device,
    command: Callable[[str, str, Sequence[str]], list[str]] | None = None,
    *,
    max_case_seconds: float = MAX_CASE_SECONDS,
    max_seconds: float = MAX_SECONDS,
) -> SelfTest:
    """Test the kernels of an implementation on a device against the float64 reference, values and gradients.

    Args:
        implementation: "gpu" or "cpu".
        device: the device, which this process need not have used yet.
        command: returns the command that runs the cases of some names, from the implementation and the device's name;
            None for `hyrfpack.self_test.worker`.
        max_case_seconds: time limit for each case with its compilation; a case that exceeds it has failed.
        max_seconds: time limit for all cases together.
    """
    cases = list_self_test_cases()
    names = [name for name, case in cases.items() if implementation == "gpu" or case.has_cpu_kernels]
    make_command = command or _worker_command
    rows_by_name: dict[str, Row] = {}
    for row in run_in_children(
        lambda left: make_command(implementation, str(device), left),
        [DEVICE_ITEM, *([LAUNCH_ITEM] if implementation == "gpu" else []), *names],
        max_seconds,
        max_case_seconds,
    ):
        name = str(row["item"])
        if name in cases:
            rows_by_name[name] = {"operation": cases[name].replaced_operation, **row}
        elif "status" in row and name == DEVICE_ITEM:
            return SelfTest(implementation, str(device), (), str(row["note"]))
        elif "status" in row:
            fix = f"; {row['fix']}" if "fix" in row else ""
            problem = f"Triton cannot compile and launch kernels here ({row['note']}){fix}"
            return SelfTest(implementation, str(device), (), problem, can_launch=False)
    return SelfTest(implementation, str(device), tuple(rows_by_name[name] for name in names))


def _worker_command(implementation: str, device: str, names: Sequence[str]) -> list[str]:
    return [sys.executable, "-m", "hyrfpack.self_test.worker", implementation, device, *names]
