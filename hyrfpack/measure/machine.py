"""Describe the machine that times are measured on."""

from __future__ import annotations

import platform
import re
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import torch

from hyrfpack.parallel.threads import thread_count
from hyrfpack.version import __version__

# Files that hold the versions of NVIDIA's and AMD's kernel modules, and the form of these versions.
_DRIVER_FILES = {"/proc/driver/nvidia/version": r"\d+\.\d+(?:\.\d+)?", "/sys/module/amdgpu/version": r"\S+"}


def describe_machine() -> dict[str, object]:
    """Return facts that run times on the CPU depend on: processor, cores in use, and versions of packages."""
    return {
        "cpu": processor_name(),
        "cores": thread_count(),
        "python": platform.python_version(),
        "hyrfpack": __version__,
        **package_versions("torch", "numba", "numpy"),
    }


def package_versions(*packages: str) -> dict[str, str | None]:
    """Return the installed version of each package, None for those that are not installed."""
    versions: dict[str, str | None] = dict.fromkeys(packages)
    for package in packages:
        with suppress(PackageNotFoundError):
            versions[package] = version(package)
    return versions


def driver_version() -> str | None:
    """Return the version of the GPU's driver: the kernel module's on Linux, else the one that CUDA reports."""
    for path, pattern in _DRIVER_FILES.items():
        with suppress(OSError):
            if match := re.search(pattern, Path(path).read_text()):
                return match[0]
    query = getattr(torch._C, "_cuda_getDriverVersion", None)  # only builds of torch for CUDA have it
    return str(query()) if query is not None and torch.cuda.is_available() else None


def format_machine(facts: dict[str, object]) -> str:
    """Format the result of `describe_machine` as one line."""
    return ", ".join(f"{key} {value}" for key, value in facts.items())


def processor_name() -> str:
    """Return the model name of the processor, or its architecture if the name is unknown."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()
