"""The scripts in examples/ run, on photos and Gaussians of a few pixels."""

from __future__ import annotations

import runpy
import sys
from pathlib import Path

import pytest
from explicit_balls import ball_splats
from PIL import Image

import hyrfpack
from hyrfpack.format import describe_file
from hyrfpack.splats.formats import ply

REPOSITORY_ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("examples")


def test_the_example_scripts_train_compress_render_and_import(folder, data, monkeypatch, capsys):
    def run(script: str, *arguments: object) -> str:
        monkeypatch.setattr(sys, "argv", [script, *map(str, arguments)])
        runpy.run_path(str(REPOSITORY_ROOT / "examples" / script), run_name="__main__")
        return capsys.readouterr().out

    monkeypatch.chdir(folder)
    said = run("train_and_compress.py", data, "run", "--steps", 5)
    assert "8 photos to train on, 2 held out" in said and "small.hyrf" in said

    said = run("read_and_render.py", "run/small.hyrf", "frames", "--frames", 2)
    assert said.startswith("frames: 2 pictures of ")
    assert [Image.open(folder / "frames" / f"{number:04d}.png").size for number in (0, 1)] == [(48, 48)] * 2

    hyrfpack.merge_models(["run/small.hyrf", "run/model.hyrf"], "merged.hyrf")
    said = run("read_and_render.py", "merged.hyrf", "merged_frames", "--frames", 1)
    count = sum(describe_file(f"run/{name}.hyrf")["gaussians"] for name in ("small", "model"))
    assert said == f"merged_frames: 1 pictures of {count:,} Gaussians\n"

    (folder / "scene.ply").write_bytes(ply.encode(ball_splats(40)))
    files = ("scene.ply", "scene.hyrf", "compare.png")
    run("import_and_compare.py", *files, "--psnr", 15, "--size", 48)
    width, height = Image.open(folder / "compare.png").size
    assert describe_file(folder / "scene.hyrf")["gaussians"] > 0 and (width, height) == (2 * 48, 3 * 48)


def test_every_script_states_its_usage():
    scripts = sorted(path.name for path in (REPOSITORY_ROOT / "examples").glob("*.py"))
    assert scripts == ["import_and_compare.py", "read_and_render.py", "train_and_compress.py"]
    for script in scripts:
        assert f"python examples/{script} " in (REPOSITORY_ROOT / "examples" / script).read_text()
