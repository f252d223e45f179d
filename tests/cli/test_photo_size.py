"""The size at which photos are read is stored with a model, used by later commands, and reported."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from commands import hyrfpack, succeeded
from PIL import Image

from hyrfpack.cameras.capture import Capture
from hyrfpack.format import describe_file


@pytest.fixture(scope="module")
def shrunk_run(data, tmp_path_factory) -> Path:
    """A run on ten photos, reduced from 48 to 24 pixels."""
    folder = tmp_path_factory.mktemp("runs") / "shrunk"
    succeeded("train", data, "-o", folder, "--steps", 10, "--max-gaussians", 200, "--max-size", 24)
    return folder


def test_a_model_stores_the_photo_size_of_its_training(shrunk_run, tmp_path):
    packed = tmp_path / "packed.hyrf"
    succeeded("compress", shrunk_run / "model.hyrf", "-o", packed, "--profile", "paper")
    for file in (shrunk_run / "model.hyrf", packed):
        assert describe_file(file)["provenance"]["max_size"] == 24
    metrics = json.loads((shrunk_run / "metrics.json").read_text())
    assert metrics["scene"]["max_size"] == 24
    assert any("shrunk from up to 48 x 48 to 24 pixels" in note for note in metrics["notes"])


def test_evaluate_reads_photos_at_the_training_size_and_reports_it(shrunk_run, data):
    command = ("evaluate", shrunk_run / "model.hyrf", "--data", data)
    plain, numbers = succeeded(*command), json.loads(succeeded(*command, "--json").stdout)
    assert "2 photos of up to 24 x 24 pixels (--max-size 24)" in plain.stdout
    assert "10 of 10 photos are shrunk from up to 48 x 48 to 24 pixels on the longer side" in plain.stderr
    assert (numbers["max_size"], numbers["picture_size"]) == (24, [24, 24])
    stored = json.loads((shrunk_run / "metrics.json").read_text())["evaluation"]
    assert numbers["psnr"] == pytest.approx(stored["psnr"], abs=1e-9)


def test_an_explicit_max_size_overrides_that_of_the_model(shrunk_run, data):
    command = ("evaluate", shrunk_run / "model.hyrf", "--data", data, "--max-size")
    assert json.loads(succeeded(*command, 0, "--json").stdout)["picture_size"] == [48, 48]
    assert "of up to 16 x 16 pixels (--max-size 16)" in succeeded(*command, 16).stdout
    assert "of up to 48 x 48 pixels (as they are stored)" in succeeded(*command, 0).stdout


def test_render_uses_the_training_size_and_reports_it(shrunk_run, data, tmp_path):
    printed = succeeded("render", shrunk_run / "model.hyrf", "-o", tmp_path, "--data", data).stdout
    assert "2 pictures, 24 x 24 pixels" in printed
    assert Image.open(tmp_path / "0000.png").size == (24, 24)


@pytest.mark.parametrize(
    ("command", "output"), [("compress", "packed.hyrf"), ("export", "scene.splat"), ("bench", "bench.png")]
)
def test_every_command_reads_photos_at_the_training_size_of_the_model(shrunk_run, data, command, output, tmp_path):
    (tmp_path / output).touch()  # an existing output makes the command fail once the photos are read
    result = hyrfpack(command, shrunk_run / "model.hyrf", "--data", data, "-o", tmp_path / output)
    assert result.exit_code == 2 and "to 24 pixels on the longer side" in result.stderr


def test_a_model_of_small_photos_stores_no_photo_size(data, tmp_path):
    """A model of small photos is byte for byte the same as without a limit."""
    succeeded("train", data, "-o", tmp_path, "--steps", 2, "--max-gaussians", 50)
    assert "max_size" not in describe_file(tmp_path / "model.hyrf")["provenance"]
    assert json.loads((tmp_path / "metrics.json").read_text())["scene"]["max_size"] == 1600


def test_a_model_trained_without_a_size_limit_stores_that(data, tmp_path):
    succeeded("train", data, "-o", tmp_path, "--steps", 2, "--max-gaussians", 50, "--max-size", 0)
    assert describe_file(tmp_path / "model.hyrf")["provenance"]["max_size"] == 0


@pytest.mark.parametrize("stored", [None, -1, 5, True, 1.5, "800", [800], {}])
def test_an_invalid_stored_size_is_ignored(stored):
    assert Capture({"provenance": {"max_size": stored}}).max_size == 1600
    assert Capture({"provenance": {"max_size": 0}}).max_size == 0
