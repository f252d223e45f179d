"""Build the wheel and the sdist from a clean copy, and make environments that hold only some packages."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import venv
import zipfile
from email import message_from_bytes
from importlib import metadata
from pathlib import Path, PurePosixPath
from shutil import copyfile

import pytest

REPOSITORY_ROOT = Path(__file__).parents[1]


def list_repository_files() -> list[str]:
    """Return the relative paths of all files that git tracks or would add. Skips the test outside a git checkout."""
    if not (REPOSITORY_ROOT / ".git").exists():
        pytest.skip("this is no git checkout")
    command = ["git", "ls-files", "--cached", "--others", "--exclude-standard", "-z"]
    listed = subprocess.run(command, cwd=REPOSITORY_ROOT, capture_output=True, check=True).stdout.decode()
    return [name for name in listed.split("\0") if (REPOSITORY_ROOT / name).is_file()]


def copy_repository(folder: Path) -> Path:
    """Copy these files to `folder`, so that a build there finds no files of earlier builds."""
    for name in list_repository_files():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        copyfile(REPOSITORY_ROOT / name, folder / name)
    return folder


def build_distribution(kind: str, source: Path, out: Path) -> Path:
    """Build the "wheel" or the "sdist" of a source tree without a network, and return the path of the file in `out`."""
    code = f"from setuptools import build_meta; print(build_meta.build_{kind}({str(out)!r}))"
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, cwd=source, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return out / done.stdout.splitlines()[-1]


def distribution_name(requirement: str) -> str:
    """Return the name of a distribution in a requirement such as "numpy>=1.26"."""
    return re.match(r"[\w.-]+", requirement)[0].lower().replace("_", "-")


def wheel_requirements(wheel: Path) -> list[str]:
    """Return what a wheel requires without extras. Skips the test if this Python lacks any of it.

    The requirements of an editable installation are those of the tree and the day that it was made from.
    """
    with zipfile.ZipFile(wheel) as archive:
        (name,) = [name for name in archive.namelist() if name.endswith(".dist-info/METADATA")]
        lines = message_from_bytes(archive.read(name)).get_all("Requires-Dist")
    for line in lines:
        if ";" not in line and not any(metadata.distributions(name=distribution_name(line))):
            pytest.skip(f"the wheel requires {line}, which this Python lacks; refresh its environment: make .venv")
    return [line for line in lines if "extra ==" not in line]


def required_distributions(*roots: str) -> set[str]:
    """Return the names of distributions and of everything that they require."""
    found, waiting = set(), list(roots)
    while waiting:
        name = distribution_name(waiting.pop())
        if name not in found:
            found.add(name)
            try:
                waiting += [line for line in metadata.requires(name) or () if "extra ==" not in line]
            except metadata.PackageNotFoundError:
                continue  # is required on another platform only
    return found


def make_environment(folder: Path, wheel: Path, *packages: str) -> Path:
    """Make an environment with these installed packages, what they require, and the wheel without what it requires.

    The packages are links to those of this Python, so that nothing is downloaded or copied. The wheel is installed by
    the command that a user would run, `pip install --no-deps`.

    Returns:
        The environment's Python.
    """
    pytest.importorskip("pip", reason="pip is not installed")
    venv.create(folder)
    (site_packages,) = folder.glob("lib/python*/site-packages")
    for name in required_distributions(*packages):
        try:
            distribution = metadata.distribution(name)
        except metadata.PackageNotFoundError:
            continue  # is required on another platform only
        for top in {PurePosixPath(file).parts[0] for file in distribution.files or ()} - {"..", "__pycache__"}:
            (site_packages / top).symlink_to(distribution.locate_file(top))
    python = folder / "bin" / "python"
    install = [sys.executable, "-m", "pip", "--python", str(python), "install", "--quiet", "--no-deps", "--no-index"]
    subprocess.run([*install, str(wheel)], check=True)
    return python


def run_in_environment(python: Path, *arguments: object) -> subprocess.CompletedProcess[str]:
    """Run an environment's Python with these arguments, so that it sees only what is installed in the environment."""
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    command = [str(argument) for argument in (python, *arguments)]
    return subprocess.run(command, cwd=python.parent, env=environment, capture_output=True, text=True, check=False)
