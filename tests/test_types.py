"""A type checker accepts correct programs that use the library, and reports each line of a wrong one."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("mypy", reason="mypy is not installed")
REPOSITORY_ROOT = Path(__file__).parents[1]
CORRECT_PROGRAM = """
import numpy as np
import hyrfpack

scene = hyrfpack.load_scene("photos")
result: hyrfpack.TrainResult = hyrfpack.train_model(scene, "run", hyrfpack.TrainConfig(steps=10))
report = hyrfpack.compress_model("run/model.hyrf", "small.hyrf", data=scene)
size: int = report.bytes_after
model: hyrfpack.HybridModel = hyrfpack.load_model("small.hyrf")
rgb = hyrfpack.render_view(model, scene.test[0].camera).rgb.numpy()
mean: float = hyrfpack.evaluate_model(model, scene.test).psnr
written = hyrfpack.export_model("small.hyrf", "small.spz", hyrfpack.ExportConfig(degree=2)).bytes
imported: float = hyrfpack.import_splats("a.ply", "a.hyrf", hyrfpack.ImportConfig(psnr=30)).psnr
rows = hyrfpack.benchmark_model("small.hyrf").rows
camera = hyrfpack.Camera(640, 480, 500.0, 500.0, 320.0, 240.0, np.eye(4))
facts = hyrfpack.describe_file("small.hyrf")["profile"]
hyrfpack.save_model(model, "copy.hyrf")
"""
# Each line has one mistake, with the error code that the checker must report.
ERROR_CODES_BY_LINE = {
    'hyrfpack.load_scene("photos", every=8)': "call-arg",
    'hyrfpack.train_model("photos", "run")': "arg-type",
    "hyrfpack.TrainConfig(step=10)": "call-arg",
    'hyrfpack.load_model("a.hyrf", frction=0.5)': "call-arg",
    'hyrfpack.render_view(hyrfpack.load_model("a.hyrf"), "camera")': "arg-type",
    'hyrfpack.compress_model("a.hyrf", "b.hyrf").bytes': "attr-defined",
    'hyrfpack.evaluate_model(hyrfpack.load_model("a.hyrf"), "photos").psnr': "arg-type",
    'size: str = hyrfpack.export_model("a.hyrf", "a.ply").bytes': "assignment",
    "hyrfpack.redner": "attr-defined",
}


@pytest.mark.acceptance
def test_a_correct_program_passes_and_each_mistaken_line_is_reported(tmp_path):
    (tmp_path / "right.py").write_text(CORRECT_PROGRAM)
    (tmp_path / "wrong.py").write_text("\n".join(["import hyrfpack", *ERROR_CODES_BY_LINE]))
    command = [sys.executable, "-m", "mypy", "--config-file", REPOSITORY_ROOT / "pyproject.toml", "--no-pretty"]
    command += [tmp_path / "right.py", tmp_path / "wrong.py"]
    done = subprocess.run(command, cwd=REPOSITORY_ROOT, capture_output=True, text=True)
    messages = re.findall(r"(right|wrong)\.py:(\d+): error: .*\[([\w-]+)\]$", done.stdout, re.MULTILINE)
    expected = [("wrong", str(line), code) for line, code in enumerate(ERROR_CODES_BY_LINE.values(), start=2)]
    assert messages == expected, done.stdout + done.stderr
