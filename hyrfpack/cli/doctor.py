"""The command `hyrfpack doctor`."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

from hyrfpack.cli.common import device_option, is_self_test_wanted, json_option, print_json
from hyrfpack.cli.console import print_line
from hyrfpack.cli.wording import use_option_names
from hyrfpack.counts import format_count

if TYPE_CHECKING:
    from hyrfpack.doctor import MachineReport


@click.command(short_help="Check this machine, for a bug report.")
@device_option
@json_option
def doctor(device: str, as_json: bool) -> None:
    """Print versions, devices and missing packages, and test the kernels of a device against float64 arithmetic.

    The test takes a few seconds; where kernels are not compiled yet, up to a minute or two. It runs in a process of its
    own, which a broken kernel may crash. On a GPU its result is stored: kernels that fail are replaced by plain torch.

    Paste the lines that this command prints on standard output into a bug report.

    \b
    Examples:
      hyrfpack doctor
      hyrfpack doctor --device cuda --json
      hyrfpack doctor --no-self-test
    """
    from hyrfpack.doctor import diagnose_machine

    report = diagnose_machine(device, self_test=is_self_test_wanted())
    if as_json:
        print_json(report.to_dict())
        return
    print_line("```")
    for line in _format_report(report):
        print_line(line)
    print_line("```")


def _format_report(report: MachineReport) -> list[str]:
    """Return the report as lines of text."""
    versions = [f"{name} {version or 'is not installed'}" for name, version in report.versions.items()]
    lines = [", ".join(versions), report.system]
    memory = "unknown memory" if report.memory_bytes is None else f"{report.memory_bytes / 2**30:.1f} GiB of memory"
    lines.append(f"CPU: {report.cpu}, {format_count(report.cores, 'core')}, {memory}")
    for number, gpu in enumerate(report.gpus):
        lines.append(
            f"GPU {number}: {gpu['name']}, {gpu['memory_bytes'] / 2**30:.1f} GiB, capability {gpu['capability']}, "
            f"driver {gpu['driver']}"
        )
    if not report.gpus:
        lines.append("GPU: torch sees none")
    lines.append(f"device: {report.device or 'none'}")
    test = report.self_test
    if test is None or test.problem is not None:
        lines.append("self-test: not run")
    else:
        passed = len(test.rows) - len(test.failed_rows)
        seconds = sum(float(str(row.get("seconds", 0))) for row in test.rows)
        cases = f"{passed} of {len(test.rows)} cases of the {test.implementation} kernels"
        lines.append(f"self-test: {cases} passed in {seconds:.1f} s")
    lines += [f"problem: {use_option_names(problem)}" for problem in report.problems]
    for package, about in report.missing.items():
        lines.append(f"{package} is not installed; needed for {about['needed_for']}: {about['install']}")
    return lines
