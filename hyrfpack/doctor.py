"""Describe this machine for a bug report: versions, devices, the self-test of the kernels, and what is missing.

A package that is missing or broken is part of the result, so that this works where nothing else does.
"""

from __future__ import annotations

import logging
import platform
from dataclasses import asdict, dataclass
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from math import isfinite
from typing import TYPE_CHECKING, Any

from hyrfpack.colmap_library import keep_sigterm_handler
from hyrfpack.errors import HyrfError, install_command, short_reason
from hyrfpack.parallel.threads import thread_count
from hyrfpack.version import __version__

if TYPE_CHECKING:
    import torch

    from hyrfpack.self_test import SelfTest

_LOG = logging.getLogger(__name__)

# Packages that decide how fast and how exactly everything is computed.
COMPUTING_PACKAGES = ("torch", "numpy", "numba", "triton")
# The other packages by the name of their module, with pip's name and what they are needed for.
OPTIONAL_PACKAGES = {
    "PIL": ("pillow", "photos and picture files"),
    "scipy": ("scipy", "training, compression, export"),
    "pycolmap": ("pycolmap", "COLMAP models, estimating poses"),
    "av": ("av", "videos"),
    "pillow_heif": ("pillow-heif", "HEIC photos"),
    "zstandard": ("zstandard", ".spz"),
    "trimesh": ("trimesh", "collision meshes, meshes with fewer triangles"),
    "skimage": ("scikit-image", "meshes"),
    "fast_simplification": ("fast-simplification", "meshes"),
    "pxr": ("usd-core", "USD"),
    "OpenEXR": ("OpenEXR", "depth and normals as OpenEXR"),
    "matplotlib": ("matplotlib", "figures"),
    "dahuffman": ("dahuffman", "writing profile paper"),
}


@dataclass(frozen=True)
class MachineReport:
    """What a bug report needs to know about a machine.

    Attributes:
        versions: versions of hyrfpack, Python and COMPUTING_PACKAGES; None for a package that is not installed.
        system: the operating system.
        cpu, cores, memory_bytes: the processor, the cores that this process may use, and its memory; None if torch or
            numpy cannot be imported.
        gpus: each GPU that torch sees: "name", "memory_bytes", "driver" and "capability" (major.minor, or gfx...).
        device: the device that was asked for, as torch names it; None if there is none.
        self_test: result of the self-test of the kernels of this device; None if it has none or none was asked for.
        missing: for each optional package that is not installed, what it is needed for and how to install it.
        problems: what is wrong on this machine, one sentence each.
    """

    versions: dict[str, str | None]
    system: str
    cpu: str
    cores: int
    memory_bytes: int | None
    gpus: list[dict[str, Any]]
    device: str | None
    self_test: SelfTest | None
    missing: dict[str, dict[str, str]]
    problems: list[str]

    def to_dict(self) -> dict[str, Any]:
        """Return the report as values that JSON can store; an error of a kernel that is not finite is None."""
        values = asdict(self)
        if self.self_test is not None:
            values["self_test"]["rows"] = [
                {key: None if isinstance(value, float) and not isfinite(value) else value for key, value in row.items()}
                for row in self.self_test.rows
            ]
        return values


def diagnose_machine(device: str = "auto", *, self_test: bool = True) -> MachineReport:
    """Describe this machine, and test the kernels of a device against the float64 reference.

    The test always runs anew, in child processes. Its result is stored for a GPU and decides which kernels are used
    there, see `hyrfpack.device.choose_device`.

    Args:
        device: the device whose kernels are tested: "auto", "cpu", "cuda" or "cuda:N".
        self_test: whether to test them.

    Returns:
        The report. A device that is not available is one of its problems.

    Raises:
        HyrfError: the text names no device.

    Example:
        >>> report = diagnose_machine("cpu", self_test=False)
        >>> report.device, report.cores > 0, sorted(report.versions)
        ('cpu', True, ['hyrfpack', 'numba', 'numpy', 'python', 'torch', 'triton'])
    """
    problems = [problem for name in COMPUTING_PACKAGES if (problem := _import_problem(name))]
    versions = {"hyrfpack": __version__, "python": platform.python_version()}
    facts: dict[str, Any] = {
        "versions": versions | {name: _version(name) for name in COMPUTING_PACKAGES},
        "system": platform.platform(),
        "missing": _find_missing_packages(problems),
        "problems": problems,
    }
    try:
        import numpy  # noqa: F401
        import torch  # noqa: F401
    except Exception:  # a broken torch raises errors of many types
        unknown: dict[str, Any] = {"memory_bytes": None, "gpus": [], "device": None, "self_test": None}
        return MachineReport(**facts, cpu=platform.machine(), cores=thread_count(), **unknown)
    return MachineReport(**facts, **_describe_devices(device, self_test, problems))


def _describe_devices(name: str, self_test: bool, problems: list[str]) -> dict[str, Any]:
    """Return the facts about devices; problems that are found are added to the list."""
    import torch

    from hyrfpack.data.cache import memory_bytes
    from hyrfpack.device import choose_device, describe_device
    from hyrfpack.measure.machine import driver_version, processor_name

    gpus: list[dict[str, Any]] = []
    for number in range(torch.cuda.device_count() if torch.cuda.is_available() else 0):
        properties = torch.cuda.get_device_properties(number)
        capability = ".".join(map(str, torch.cuda.get_device_capability(number)))
        gpu = {"name": properties.name, "memory_bytes": properties.total_memory}
        gpus.append(gpu | {"driver": driver_version(), "capability": getattr(properties, "gcnArchName", capability)})
    if not gpus and driver_version() is not None:
        build = torch.version.cuda or torch.version.hip
        reason = f"is built for {build}" if build else "is built for the CPU only"
        problems.append(f"there is a GPU driver, version {driver_version()}, but torch sees no GPU; torch {reason}")
    chosen, result = None, None
    try:
        chosen = choose_device(name, self_test=False)
    except HyrfError as error:
        if "is not a device" in error.problem:
            raise
        problems.append(str(error))
    if chosen is not None and self_test:
        result = _test_kernels(chosen, problems)
    return {
        "cpu": processor_name(),
        "cores": thread_count(),
        "memory_bytes": memory_bytes(),
        "gpus": gpus,
        "device": None if chosen is None else describe_device(chosen),
        "self_test": result,
    }


def _test_kernels(device: torch.device, problems: list[str]) -> SelfTest | None:
    """Run the self-test of the kernels that a device has; problems that are found are added to the list."""
    from hyrfpack.ops.dispatch import has_triton
    from hyrfpack.parallel import has_numba
    from hyrfpack.self_test import run_self_test, store_self_test

    implementation = {"cuda": "gpu", "cpu": "cpu"}.get(device.type)
    if implementation is None or not (has_triton() if implementation == "gpu" else has_numba()):
        return None
    if implementation == "cpu":
        from hyrfpack.parallel.compiled import can_cache_kernels

        if not can_cache_kernels():
            problems.append(
                "compiled kernels cannot be stored, so each run compiles them again; set a folder in NUMBA_CACHE_DIR"
            )
    _LOG.info("testing the kernels; where they are not compiled yet, this takes up to two minutes")
    test = run_self_test(implementation, device)
    if implementation == "gpu":
        store_self_test(test, device)
    if test.problem is not None:
        problems.append(f"the kernels could not be tested: {test.problem}")
    items_by_note: dict[str, list[str]] = {}
    for row in test.failed_rows:
        items_by_note.setdefault(str(row["note"]), []).append(str(row["item"]))
    problems += [f"kernels of {'; '.join(items)}: {note}" for note, items in items_by_note.items()]
    return test


def _find_missing_packages(problems: list[str]) -> dict[str, dict[str, str]]:
    """Return what is missing by pip's name; optional packages that are installed but broken become problems."""
    missing: dict[str, dict[str, str]] = {}
    for module, (package, purpose) in OPTIONAL_PACKAGES.items():
        if _version(package) is None:
            missing[package] = {"needed_for": purpose, "install": install_command(package)}
        elif problem := _import_problem(module):
            problems.append(problem)
    return missing


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def _import_problem(module: str) -> str | None:
    """Return why a package that is installed cannot be imported; None if it can, or if it is not installed."""
    try:
        with keep_sigterm_handler():  # one of the modules is pycolmap
            import_module(module)
    except ModuleNotFoundError as error:
        if error.name == module:
            return None
        return f"{module} cannot be imported: {short_reason(error)}"
    except Exception as error:  # broken libraries raise errors of many types
        return f"{module} cannot be imported: {short_reason(error)}"
    return None
