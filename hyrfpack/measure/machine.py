"""Describe the machine that times are measured on."""

from __future__ import annotations

import platform
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import torch

from hyrfpack.parallel.pool import thread_count
from hyrfpack.version import __version__


def describe_machine() -> dict[str, object]:
    """Return facts that run times depend on: processor, cores in use, GPU, and versions of packages."""
    facts: dict[str, object] = {
        "cpu": _processor_name(),
        "cores": thread_count(),
        "python": platform.python_version(),
        "hyrfpack": __version__,
        **package_versions("torch", "numba", "numpy"),
    }
    if torch.cuda.is_available():
        facts["gpu"] = torch.cuda.get_device_name()
    return facts


def package_versions(*packages: str) -> dict[str, str | None]:
    """Return the installed version of each package, None for those that are not installed."""
    found: dict[str, str | None] = dict.fromkeys(packages)
    for package in packages:
        with suppress(PackageNotFoundError):
            found[package] = version(package)
    return found


def format_machine(facts: dict[str, object]) -> str:
    """Format the result of `describe_machine` as one line."""
    return ", ".join(f"{key} {value}" for key, value in facts.items())


def _processor_name() -> str:
    """Return the model name of the processor, or its architecture if the name is unknown."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()
