"""An edit writes the best file within a size or a loss."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from commands import hyrfpack, refused, succeeded
from scenes import QUIET_CONTEXT

from hyrfpack.config.edit import Background, CropSphere, EditLimits, MinOpacity, Scale, Translate
from hyrfpack.data.masked_views import mask_view
from hyrfpack.edit import edit_model, plan_edit
from hyrfpack.errors import HyrfError
from hyrfpack.evaluate import evaluate_model
from hyrfpack.format import describe_file, load_model
from hyrfpack.render import render_view
from tools.safety.train_golden import DEMO_MODEL_FILE

pytestmark = pytest.mark.usefixtures("quick_calibration")
COMPACT_FILE = DEMO_MODEL_FILE.with_name("demo_compact.hyrf")
CENTER_BALL = CropSphere((0.0, 0.0, 0.0), 1.0)


@pytest.mark.acceptance
def test_an_edited_model_fills_a_target_size(tmp_path):
    free = edit_model(DEMO_MODEL_FILE, tmp_path / "free.hyrf", [CENTER_BALL], profile="compact", context=QUIET_CONTEXT)
    limits = EditLimits(target_bytes=free.bytes_after * 2 // 3)
    report = edit_model(DEMO_MODEL_FILE, tmp_path / "small.hyrf", [CENTER_BALL], limits=limits, context=QUIET_CONTEXT)
    assert report.profile == "compact" and str(limits.target_bytes) in report.found.replace(",", "")
    assert 0.9 * limits.target_bytes < report.bytes_after <= limits.target_bytes
    assert Path(report.file).stat().st_size == report.bytes_after


def test_a_file_that_fits_already_is_copied(tmp_path):
    limits = EditLimits(target_bytes=2 * COMPACT_FILE.stat().st_size)
    report = edit_model(
        COMPACT_FILE, tmp_path / "out.hyrf", [Translate((1.0, 0.0, 0.0))], limits=limits, context=QUIET_CONTEXT
    )
    before, after = load_model(COMPACT_FILE), load_model(report.file)
    assert all((old == new).all() for old, new in zip(before.parameters(), after.parameters(), strict=True))
    assert report.bytes_after == pytest.approx(COMPACT_FILE.stat().st_size, abs=100)


@pytest.mark.acceptance
@pytest.mark.parametrize(
    "moves",
    [
        pytest.param([], id="in place"),
        pytest.param([Scale(2.0), Translate((1.0, 2.0, 3.0))], id="moved"),
    ],
)
def test_the_loss_is_that_of_the_pixels_that_the_edit_left(scene, tmp_path, moves):
    """The limit holds for the photos' pixels that the crop does not change."""
    crop, drop = CENTER_BALL, 0.3
    edit_model(DEMO_MODEL_FILE, tmp_path / "raw.hyrf", [crop], context=QUIET_CONTEXT)
    limits = EditLimits(max_psnr_drop=drop)
    report = edit_model(
        DEMO_MODEL_FILE, tmp_path / "small.hyrf", [crop, *moves], data=scene, limits=limits, context=QUIET_CONTEXT
    )
    whole, cropped = load_model(DEMO_MODEL_FILE), load_model(tmp_path / "raw.hyrf")
    left = []
    for view in scene.test:
        change = (render_view(whole, view.camera).rgb - render_view(cropped, view.camera).rgb).abs().amax(-1)
        left.append(mask_view(view, (change <= 8 / 255).numpy()))
    assert 0.05 < np.mean([view.load().mask.mean() for view in left]) < 0.9
    small = report.file
    if moves:
        back = [Translate((-1.0, -2.0, -3.0)), Scale(0.5)]
        small = edit_model(report.file, tmp_path / "back.hyrf", back, context=QUIET_CONTEXT).file
    losses = [evaluate_model(model, left).psnr for model in (cropped, load_model(small))]
    assert 0.3 * drop < losses[0] - losses[1] <= drop + 0.02
    assert f"of {drop:g} dB" in report.found


def test_an_edit_that_changes_every_pixel_has_no_loss_to_limit(scene, tmp_path):
    everything_changes = [Background((1.0, 0.0, 1.0)), MinOpacity(0.998)]
    limits = EditLimits(max_psnr_drop=0.1)
    with pytest.raises(HyrfError, match=r"changes every pixel.*`target_bytes`"):
        edit_model(
            DEMO_MODEL_FILE,
            tmp_path / "out.hyrf",
            everything_changes,
            data=replace(scene, test=scene.test[:1]),
            limits=limits,
            context=QUIET_CONTEXT,
        )


def test_a_limit_is_something_to_do(tmp_path):
    limits = EditLimits(target_bytes=COMPACT_FILE.stat().st_size * 3 // 4)
    report = edit_model(DEMO_MODEL_FILE, tmp_path / "out.hyrf", [], limits=limits, context=QUIET_CONTEXT)
    assert report.actions == [] and report.bytes_after <= limits.target_bytes
    with pytest.raises(ValueError, match="no actions"):
        plan_edit(DEMO_MODEL_FILE, [])


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        (["--target-size", "20"], "a target size of 20 bytes is below the smallest possible file.*did you mean 20MB?"),
        (
            ["--target-size", "2100"],
            "after the edit the model does not fit into 2,100 bytes.*"
            r"use a --target-size of at least [\d,]+, or keep fewer --gaussians",
        ),
        (["--target-size", "1MB", "--profile", "raw"], "use profile 'compact'"),
        (["--max-psnr-drop", "1"], "need photos; name their folder with --data"),
        (["--target-size", "small"], "is not a size"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else None,
)
def test_limits_that_cannot_be_met_are_refused(options, problem, tmp_path):
    sentence = refused("edit", DEMO_MODEL_FILE, "-o", tmp_path / "out.hyrf", "--crop-sphere", "0,0,0,1", *options)
    assert re.search(problem, sentence) and not list(tmp_path.iterdir())


def test_two_limits_are_refused(scene, tmp_path):
    limits = EditLimits(target_bytes=10_000, max_psnr_drop=0.1)
    with pytest.raises(HyrfError, match="give one of them"):
        edit_model(DEMO_MODEL_FILE, tmp_path / "out.hyrf", [], data=scene, limits=limits, context=QUIET_CONTEXT)


def test_a_plan_has_no_size_to_limit():
    result = hyrfpack("edit", DEMO_MODEL_FILE, "--plan", "--center", "--target-size", "1MB")
    assert result.exit_code == 2 and "--plan writes no file" in result.stderr


@pytest.mark.acceptance
def test_the_command_takes_the_words_of_compress(photos, tmp_path):
    out = tmp_path / "out.hyrf"
    options = ["--crop-sphere", "0,0,0,1", "--max-psnr-drop", "0.5", "--data", photos]
    shown = succeeded("edit", DEMO_MODEL_FILE, "-o", out, *options).stdout
    assert "of 0.5 dB on" in shown and describe_file(out)["profile"] == "compact"
    report = succeeded("edit", DEMO_MODEL_FILE, "-o", tmp_path / "b.hyrf", "--target-size", "12kB", "--json").stdout
    assert json.loads(report)["bytes_after"] <= 12_000
