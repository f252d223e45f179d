"""Runs the tests with the newest or the oldest versions of everything, on every Python that is here.

    python -m tools.safety.versions newest
    python -m tools.safety.versions oldest --python 3.10

`make test` runs with the versions of constraints.txt; people get the newest that their Python allows, or keep what they
have. The newest are installed as pip would take them, the oldest at the lower bounds of pyproject.toml. Each run has an
environment of its own below .versions/ (torch's GPU build: 6 GB), and the package is installed, not linked. Arguments
after `--` go to pytest. The whole log of each run lies beside its environment.
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

ROOT = Path(__file__).parents[2]
FOLDER = ROOT / ".versions"
PYTHONS = {"newest": ("3.10", "3.11", "3.12", "3.13", "3.14"), "oldest": ("3.10",)}
RESOLUTIONS = {"newest": "highest", "oldest": "lowest-direct"}  # uv's words
TOLD = ("torch", "numpy", "numba", "pycolmap", "pillow", "click")
SHOW = (
    "import sys; from importlib.metadata import version; print(*(f'{n} {version(n)}' for n in sys.argv[1:]), sep=', ')"
)


def find_python(version: str) -> str | None:
    """An interpreter of that version that runs: on the PATH, or kept by pyenv."""
    kept = os.environ.get("PYENV_ROOT", os.path.expanduser("~/.pyenv"))
    for program in (shutil.which(f"python{version}"), *sorted(glob.glob(f"{kept}/versions/{version}.*/bin/python"))):
        if program and subprocess.run([program, "-c", ""], capture_output=True, check=False).returncode == 0:
            return program
    return None


def installer() -> str:
    """uv, which knows lower bounds; in an environment of its own."""
    program = FOLDER / "uv" / "bin" / "uv"
    if not program.exists():
        subprocess.run([sys.executable, "-m", "venv", FOLDER / "uv"], check=True)
        subprocess.run([program.parent / "pip", "install", "-q", "uv"], check=True)
    return str(program)


def run_tests(kind: str, version: str, program: str, arguments: list[str]) -> str:
    """Make the environment, run the tests, and say in a line what came out; raises CalledProcessError."""
    place = FOLDER / f"{kind}-{version}"
    python = place / "bin" / "python"
    log = place.with_suffix(place.suffix + ".log")
    uv, start = installer(), time.monotonic()
    subprocess.run([uv, "venv", "-q", "--clear", "--python", program, place], check=True)
    wanted = ["--resolution", RESOLUTIONS[kind], f"{ROOT}[dev]"]
    # Not from a cache of builds: the package itself keeps its version while it changes.
    wanted += ["--reinstall-package", "hyrfpack", "--refresh-package", "hyrfpack"]
    subprocess.run([uv, "pip", "install", "-q", "--python", python, *wanted], check=True)
    shown = subprocess.run([python, "-c", SHOW, *TOLD], check=True, capture_output=True, text=True).stdout.strip()
    print(f"Python {version}: {shown}; running the tests, log in {log.relative_to(ROOT)}", flush=True)
    command = [place / "bin" / "pytest", "-n", "auto", "--maxprocesses", "4", "--dist", "worksteal", "-q", *arguments]
    with log.open("w") as file:
        code = subprocess.run(command, cwd=ROOT, stdout=file, stderr=subprocess.STDOUT, check=False).returncode
    lines = log.read_text(errors="replace").splitlines()
    told = "\n".join(f"  {line}" for line in lines if line.startswith(("FAILED", "ERROR")))
    last = lines[-1].strip("= ") if lines else "no output"
    if code:
        print(told)
    return f"Python {version}, {kind}: {'ok' if code == 0 else 'FAILED'}: {last} ({time.monotonic() - start:.0f} s)"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kind", choices=RESOLUTIONS)
    parser.add_argument("--python", action="append", metavar="3.X", help="only this one; may be given again")
    parser.add_argument("arguments", nargs="*", help="for pytest, after --")
    options = parser.parse_args()
    told = []
    for version in options.python or PYTHONS[options.kind]:
        program = find_python(version)
        if program is None:
            told.append(f"Python {version}, {options.kind}: not on this machine")
            continue
        try:
            told.append(run_tests(options.kind, version, program, options.arguments))
        except subprocess.CalledProcessError as error:
            told.append(f"Python {version}, {options.kind}: FAILED: {error}")
    print("\n".join(told))
    return int(any("FAILED" in line for line in told) or not any(": ok" in line for line in told))


if __name__ == "__main__":
    sys.exit(main())
