"""A rehearsal of tools/gpu/check.py in an environment like that of a bare GPU machine, with a pretended GPU.

The tree is copied without .git and data; packages that such a machine lacks cannot be imported.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from ops.device import IS_INTERPRETED, needs_triton

REPOSITORY_ROOT = Path(__file__).parents[2]
MISSING_PACKAGES = ("OpenEXR", "av", "constriction", "dahuffman", "fast_simplification", "gsply", "pillow_heif")
MISSING_PACKAGES += ("playwright", "pxr", "pycolmap", "trimesh", "zstandard")
LIMIT_SECONDS = 590
# Items that need GPU kernels, or whose bounds hold for them alone.
NOT_ON_THE_CPU = {"mlp 32-64-64-8, mixed", "mlp 56-64-64-3, mixed", "mlp mixed", "rasterize shaded"}

pytestmark = [needs_triton, pytest.mark.skipif(not IS_INTERPRETED, reason="there is a GPU to run the check on")]

# Python imports this module at the start of every process.
SITE_CUSTOMIZE = f"""
import sys
for name in {MISSING_PACKAGES}:
    sys.modules[name] = None
"""
# The pretended GPU is the CPU, with tiny sizes. pytest runs one file of tests, whose kernels are interpreted; the other
# parts run the CPU's kernels, because interpreted ones exceed the parts' time limits.
RUN_CHECK = """
import sys
from dataclasses import replace
import torch
torch.cuda.is_available = lambda: True
from tools.gpu import check
sizes = dict(width=16, height=16, kernel_gaussians=24, frame_gaussians=(60,), trained_gaussians=(60,), error_rows=32)
sizes |= dict(crop=16, repeats=1, views=4, warm_steps=1, steps=2, demo_views=9, demo_size=16, quality_steps=4)
sizes |= dict(device="cpu", implementation="cpu", doctor_seconds=200.0)
whole = check.Setup
check.Setup = lambda data: whole(data=data, test_paths=("tests/ops/test_contraction.py",), **sizes)
sys.exit(check.main(["--long", "--commit", "abc123", "--out", sys.argv[1]]))
"""


def copy_bare_tree(to: Path) -> None:
    skipped = shutil.ignore_patterns("node_modules", "__pycache__", "golden", "web")
    for name in ("hyrfpack", "tools", "tests"):
        shutil.copytree(REPOSITORY_ROOT / name, to / name, ignore=skipped if name == "tests" else None)
    shutil.copy(REPOSITORY_ROOT / "pyproject.toml", to)


def test_the_default_parts_run_through_on_a_machine_without_optional_packages(tmp_path: Path) -> None:
    tree, site, out = tmp_path / "tree", tmp_path / "site", tmp_path / "out"
    copy_bare_tree(tree)
    site.mkdir()
    (site / "sitecustomize.py").write_text(SITE_CUSTOMIZE)
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PYTEST_")}
    environment |= {"PYTHONPATH": str(site), "TRITON_INTERPRET": "1"}
    command = [sys.executable, "-c", RUN_CHECK, str(out)]
    done = subprocess.run(command, cwd=tree, env=environment, capture_output=True, text=True, timeout=LIMIT_SECONDS)
    (report,) = out.glob("*.json")
    rows = json.loads(report.read_text())["rows"]
    failed = {row["item"] for row in rows if row.get("status") == "failed"}
    assert failed <= NOT_ON_THE_CPU, done.stdout + done.stderr
    assert done.returncode == (1 if failed else 0), done.stderr
    timed = [row["what"] for row in rows if row.get("table") == "Time taken"]
    assert timed == ["self-test", "tests", "kernels", "frames", "sanitizer", "repeat"]
    assert json.loads(report.read_text())["machine"]["commit"] == "abc123"
    (tested,) = [row for row in rows if row.get("case") == "tests/ops/test_contraction.py"]
    assert "passed" in tested["result"]
