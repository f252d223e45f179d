"""Run the tests with the newest or the oldest versions of the dependencies, on every installed Python.

    python -m tools.safety.versions newest
    python -m tools.safety.versions oldest --python 3.10

`make test` uses the versions of constraints.txt, but users have other versions. "newest" installs the newest versions
that pip would choose, "oldest" the lower bounds of pyproject.toml. Each run has its own environment in .versions/ (6 GB
with torch's GPU build), where the package is installed with its dependencies. As in `make test`, the tests import the
package of this repository; `tests/test_package.py` checks what an installed one contains. Arguments after `--` go to
pytest. The log of a run is beside its environment. It prints one line for each Python with pytest's result and the
seconds, and exits with 1 after a failure.
"""

from __future__ import annotations

import argparse
import glob
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

REPOSITORY_ROOT = Path(__file__).parents[2]
ENVIRONMENTS_FOLDER = REPOSITORY_ROOT / ".versions"
PYTHON_VERSIONS = {"newest": ("3.10", "3.11", "3.12", "3.13"), "oldest": ("3.10",)}
UV_RESOLUTIONS = {"newest": "highest", "oldest": "lowest-direct"}  # values of uv's option --resolution
PRINTED_PACKAGES = ("torch", "numpy", "numba", "pycolmap", "pillow", "click")
PRINT_VERSIONS_SCRIPT = (
    "import sys; from importlib.metadata import version; print(*(f'{n} {version(n)}' for n in sys.argv[1:]), sep=', ')"
)


def find_python(version: str) -> str | None:
    """Return a working interpreter of a version from the PATH or from pyenv; None without one."""
    pyenv_root = os.environ.get("PYENV_ROOT", os.path.expanduser("~/.pyenv"))
    for program in (
        shutil.which(f"python{version}"),
        *sorted(glob.glob(f"{pyenv_root}/versions/{version}.*/bin/python")),
    ):
        if program and subprocess.run([program, "-c", ""], capture_output=True, check=False).returncode == 0:
            return program
    return None


def find_uv() -> str:
    """Return the path of uv, which can install lower bounds; install it into its own environment if it is missing."""
    program = ENVIRONMENTS_FOLDER / "uv" / "bin" / "uv"
    if not program.exists():
        subprocess.run([sys.executable, "-m", "venv", ENVIRONMENTS_FOLDER / "uv"], check=True)
        subprocess.run([program.parent / "pip", "install", "-q", "uv"], check=True)
    return str(program)


def run_tests(kind: str, version: str, program: str, arguments: list[str]) -> str:
    """Make the environment, run the tests, and return one line with the result.

    Raises:
        CalledProcessError: the environment cannot be made.
    """
    environment = ENVIRONMENTS_FOLDER / f"{kind}-{version}"
    python = environment / "bin" / "python"
    log = environment.with_suffix(environment.suffix + ".log")
    uv, start = find_uv(), time.monotonic()
    subprocess.run([uv, "venv", "-q", "--clear", "--python", program, environment], check=True)
    requirements = ["--resolution", UV_RESOLUTIONS[kind], f"{REPOSITORY_ROOT}[dev]"]
    # The package changes without a new version, so it must not come from uv's cache of builds.
    requirements += ["--reinstall-package", "hyrfpack", "--refresh-package", "hyrfpack"]
    subprocess.run([uv, "pip", "install", "-q", "--python", python, *requirements], check=True)
    version_line = subprocess.run(
        [python, "-c", PRINT_VERSIONS_SCRIPT, *PRINTED_PACKAGES], check=True, capture_output=True, text=True
    ).stdout.strip()
    print(f"Python {version}: {version_line}; running the tests, log in {log.relative_to(REPOSITORY_ROOT)}", flush=True)
    command = [
        environment / "bin" / "pytest",
        "-n",
        "auto",
        "--maxprocesses",
        "4",
        "--dist",
        "worksteal",
        "-q",
        *arguments,
    ]
    with log.open("w") as file:
        code = subprocess.run(
            command, cwd=REPOSITORY_ROOT, stdout=file, stderr=subprocess.STDOUT, check=False
        ).returncode
    lines = log.read_text(errors="replace").splitlines()
    failures = "\n".join(f"  {line}" for line in lines if line.startswith(("FAILED", "ERROR")))
    last = lines[-1].strip("= ") if lines else "no output"
    if code:
        print(failures)
    return f"Python {version}, {kind}: {'ok' if code == 0 else 'FAILED'}: {last} ({time.monotonic() - start:.0f} s)"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kind", choices=UV_RESOLUTIONS)
    parser.add_argument("--python", action="append", metavar="3.X", help="only this version; may be repeated")
    parser.add_argument("arguments", nargs="*", help="arguments for pytest, after --")
    options = parser.parse_args()
    results = []
    for version in options.python or PYTHON_VERSIONS[options.kind]:
        program = find_python(version)
        if program is None:
            results.append(f"Python {version}, {options.kind}: this Python is not installed")
            continue
        try:
            results.append(run_tests(options.kind, version, program, options.arguments))
        except subprocess.CalledProcessError as error:
            results.append(f"Python {version}, {options.kind}: FAILED: {error}")
    print("\n".join(results))
    return int(any("FAILED" in line for line in results) or not any(": ok" in line for line in results))


if __name__ == "__main__":
    sys.exit(main())
