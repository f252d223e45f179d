"""Models with an exposure map on the command line: `--exposure`, and the score at one exposure."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
from commands import hyrfpack, refused, succeeded
from exposures import random_map
from PIL import Image

from hyrfpack import format as hyrf_format
from hyrfpack.cli.make import _print_result as print_result
from hyrfpack.data import load_scene
from hyrfpack.format import load_model
from hyrfpack.format.codec import load_with_provenance
from hyrfpack.make import MakeResult
from hyrfpack.render import render_view
from hyrfpack.render.files import to_image

EXPOSURE_CHOICES = ("as-photographed", "consistent")


@pytest.fixture(scope="module")
def run(data, tmp_path_factory) -> Path:
    """A run of three steps whose model has no exposure map."""
    folder = tmp_path_factory.mktemp("runs") / "plain"
    succeeded("train", data, "-o", folder, "--steps", 3, "--max-gaussians", 60)
    return folder


@pytest.fixture(scope="module")
def model_with_map(run, tmp_path_factory) -> Path:
    """The model of that run with an exposure map added."""
    model, provenance = load_with_provenance(run / "model.hyrf")
    model.exposure = random_map(3, centers=6)
    path = tmp_path_factory.mktemp("mapped") / "mapped.hyrf"
    hyrf_format.save_model(model, path, provenance=provenance)
    return path


@pytest.fixture(scope="module")
def splats(run, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("splats") / "splats.ply"
    succeeded("export", run, "-o", path, "--sh-degree", 0)
    return path


def read_pictures(folder: Path) -> list[np.ndarray]:
    return [np.asarray(Image.open(path)) for path in sorted(folder.glob("*.png"))]


def test_render_writes_views_as_photographed_or_at_one_exposure(run, model_with_map, data, tmp_path):
    views = load_scene(data).test
    for exposure, model in (
        ("as-photographed", load_model(model_with_map)),
        ("consistent", load_model(run / "model.hyrf")),
    ):
        out = tmp_path / exposure
        succeeded("render", model_with_map, "-o", out, "--data", data, "--exposure", exposure)
        expected = [np.asarray(to_image(render_view(model, view.camera).rgb)) for view in views]
        # The command decodes the model once for all views, so bytes may be rounded otherwise.
        np.testing.assert_allclose(np.array(read_pictures(out), int), np.array(expected, int), rtol=0, atol=1)
    succeeded("render", model_with_map, "-o", tmp_path / "default", "--data", data)
    np.testing.assert_array_equal(read_pictures(tmp_path / "default"), read_pictures(tmp_path / "as-photographed"))
    assert not np.array_equal(read_pictures(tmp_path / "default"), read_pictures(tmp_path / "consistent"))


@pytest.mark.parametrize("subject", ["run", "splats"])
def test_without_an_exposure_map_both_exposures_give_the_same_pictures(subject, request, tmp_path):
    for exposure in EXPOSURE_CHOICES:
        path = request.getfixturevalue(subject)
        succeeded("render", path, "-o", tmp_path / exposure, "--orbit", 2, "--exposure", exposure)
    np.testing.assert_array_equal(*(read_pictures(tmp_path / exposure) for exposure in EXPOSURE_CHOICES))


@pytest.mark.parametrize("words", [("render", "-o", "out"), ("evaluate", "--data", "photos")], ids=" ".join)
def test_another_exposure_is_rejected_and_the_choices_are_named(words):
    sentence = refused(words[0], "model.hyrf", *words[1:], "--exposure", "bright")
    assert "'bright' is not one of 'as-photographed', 'consistent'" in sentence


def test_evaluate_scores_the_requested_exposure_and_prints_the_score_at_one_exposure(run, model_with_map, data):
    command = ("evaluate", model_with_map, "--data", data)
    default = json.loads(succeeded(*command, "--json").stdout)
    at_one = json.loads(succeeded(*command, "--json", "--exposure", "consistent").stdout)
    plain = json.loads(succeeded("evaluate", run, "--data", data, "--json").stdout)

    assert default["psnr"] != default["psnr_consistent"] == at_one["psnr"] == at_one["psnr_consistent"] == plain["psnr"]
    assert default["ssim"] != at_one["ssim"] == plain["ssim"] and plain["psnr_consistent"] is None
    words = f"mean PSNR {default['psnr']:.2f} dB ({default['psnr_consistent']:.2f} dB at one exposure)"
    assert words in succeeded(*command).stdout.splitlines()
    for other in ((*command, "--exposure", "consistent"), ("evaluate", run, "--data", data)):
        assert "at one exposure" not in succeeded(*other).stdout


def test_evaluate_of_splats_accepts_either_exposure_and_has_no_score_at_one_exposure(splats, data):
    scores = [
        json.loads(succeeded("evaluate", splats, "--data", data, "--exposure", exposure, "--json").stdout)
        for exposure in EXPOSURE_CHOICES
    ]
    assert scores[0]["psnr"] == scores[1]["psnr"] and scores[0]["psnr_consistent"] is None


def test_train_and_info_print_the_score_at_one_exposure_for_a_model_with_a_map(data, tmp_path, monkeypatch):
    def with_map(*arguments):
        model = load_model(*arguments)
        model.exposure = random_map(3, centers=6)
        return model

    monkeypatch.setattr(hyrf_format, "load_model", with_map)  # replaces a run that has learnt gains
    printed = succeeded("train", data, "-o", tmp_path / "run", "--steps", 3, "--max-gaussians", 60).stdout
    monkeypatch.undo()
    scores = json.loads((tmp_path / "run" / "metrics.json").read_text())["evaluation"]

    words = f"{scores['psnr']:.2f} dB ({scores['psnr_consistent']:.2f} dB at one exposure), SSIM"
    assert words in printed and words in succeeded("info", tmp_path / "run").stdout
    facts = json.loads(succeeded("info", tmp_path / "run", "--json").stdout)["run"]
    assert facts["psnr_consistent"] == scores["psnr_consistent"] != scores["psnr"]


@pytest.mark.parametrize("consistent, words", [(18.204, " (18.20 dB at one exposure)"), (None, "")])
def test_make_prints_the_score_at_one_exposure_for_a_model_with_a_map(consistent, words, capsys):
    result = MakeResult(
        Path("scene.html"), 9, 9, Path("model.hyrf"), Path("work"), 3, 21.5, psnr_consistent=consistent, ssim=0.75
    )
    print_result(result)
    assert f"3 photos held out: PSNR 21.50 dB{words}, SSIM 0.7500\n" in capsys.readouterr().out


def test_info_of_a_run_of_an_earlier_version_omits_its_predicted_score(run, tmp_path):
    folder = tmp_path / "run"
    folder.mkdir()
    (folder / "model.hyrf").write_bytes((run / "model.hyrf").read_bytes())
    metrics = json.loads((run / "metrics.json").read_text())
    del metrics["evaluation"]["psnr_consistent"]
    metrics["evaluation"] |= {"psnr_predicted": 12.3456, "ssim_predicted": 0.5}
    (folder / "metrics.json").write_text(json.dumps(metrics))

    result = hyrfpack("info", folder)
    assert result.exit_code == 0 and "12.35" not in result.output
    assert re.search(r"held-out photos: PSNR \d+\.\d\d dB, SSIM", result.stdout)
