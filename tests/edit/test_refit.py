"""A region is trained on the photos, and everything else stays bit for bit."""

from __future__ import annotations

import copy
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from commands import hyrfpack, refused, succeeded
from scenes import QUIET_CONTEXT

from hyrfpack.config.edit import CropBox, CropSphere, Refit, Remove, Scale, Translate
from hyrfpack.edit import edit_model, merge_models, plan_edit
from hyrfpack.edit.refit import refit_region, score_region
from hyrfpack.errors import HyrfError
from hyrfpack.format import load_model, save_model
from hyrfpack.format.codec import load_with_provenance
from hyrfpack.model import HybridModel
from hyrfpack.model.exposure import apply_exposure_gains
from hyrfpack.scene import View
from tools.safety.train_golden import DEMO_MODEL_FILE

CENTER_BALL = CropSphere((0.0, 0.0, 0.0), 1.0)
STEPS, REPAIR_STEPS = 60, 100


@pytest.fixture(scope="module")
def model() -> HybridModel:
    return load_model(DEMO_MODEL_FILE).requires_grad_(False)


@pytest.fixture(scope="module")
def is_inside(model) -> np.ndarray:
    positions = model.config.frame.to_world(model.gaussians.positions.numpy())
    return np.linalg.norm(positions - CENTER_BALL.center, axis=1) <= CENTER_BALL.radius


@pytest.fixture(scope="module")
def damaged(model, is_inside) -> HybridModel:
    """Return the model with shuffled colours in the ball."""
    changed, places = copy.deepcopy(model), torch.from_numpy(np.flatnonzero(is_inside))
    order = np.random.default_rng(0).permutation(len(places))
    changed.gaussians.color_logits[places] = model.gaussians.color_logits[places[torch.from_numpy(order)]]
    return changed


@pytest.fixture(scope="module")
def damaged_file(damaged, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("damaged") / "damaged.hyrf"
    save_model(damaged, path, "raw", load_with_provenance(DEMO_MODEL_FILE)[1])
    return path


def test_planted_damage_is_repaired_and_all_else_stays_bit_for_bit(scene, model, is_inside, damaged_file, tmp_path):
    assert 50 < is_inside.sum() < 0.7 * len(is_inside)
    report = edit_model(
        damaged_file, tmp_path / "out.hyrf", [Refit(CENTER_BALL, REPAIR_STEPS)], data=scene, context=QUIET_CONTEXT
    )
    before, after = load_model(damaged_file), load_model(report.file)
    (step,) = report.actions
    assert step.gaussians_trained == is_inside.sum() and step.gaussians_after == len(model)
    for (name, old), new in zip(before.named_parameters(), after.parameters(), strict=True):
        changed = (old != new).reshape(len(old), -1).any(dim=1).numpy()
        if name.startswith("gaussians"):
            assert not changed[~is_inside].any() and changed[is_inside].mean() > 0.9, name
        else:
            assert not changed.any(), name
    original, broken, repaired = score_region((model, before, after), is_inside, scene.test)
    assert broken < original - 3 and repaired > original - 1.5
    assert (step.region_psnr_before, step.region_psnr_after) == pytest.approx((broken, repaired), abs=0.1)
    assert report.psnr_after > report.psnr_before + 1


@pytest.mark.acceptance
def test_a_region_of_a_moved_scene_is_trained_on_the_moved_photos(scene, damaged_file):
    moves = [Scale(2.0), Translate((1.0, 2.0, 3.0))]
    region = Refit(CropSphere((1.0, 2.0, 3.0), 2.0), STEPS)
    here = plan_edit(damaged_file, [Refit(CENTER_BALL, STEPS)], data=scene, context=QUIET_CONTEXT).actions[-1]
    there = plan_edit(damaged_file, [*moves, region], data=scene, context=QUIET_CONTEXT).actions[-1]
    assert there.gaussians_trained == here.gaussians_trained
    assert there.region_psnr_after == pytest.approx(here.region_psnr_after, abs=0.3)


@pytest.mark.acceptance
def test_photos_of_other_exposure_do_not_change_the_colours(scene, model, is_inside):
    """The photos are darker and redder; with gains, an undamaged region keeps its colours."""
    gains = torch.tensor([0.6, 0.4, 0.4])

    def exposed(view: View) -> View:
        def load():
            picture = view.load()
            rgb = apply_exposure_gains(torch.from_numpy(picture.rgb / 255.0), gains)
            return replace(picture, rgb=(255 * rgb).round().byte().numpy())

        return replace(view, load=load)

    views = [exposed(view) for view in scene.train]
    changes = []
    for has_gains in (True, False):
        trained = refit_region(model, is_inside, views, STEPS, has_gains=has_gains)
        change = torch.sigmoid(trained.gaussians.color_logits) - torch.sigmoid(model.gaussians.color_logits)
        changes.append(float(change[torch.from_numpy(is_inside)].mean(0).abs().max()))
    assert changes[0] < 0.03 and changes[1] > 3 * changes[0]


def test_the_outside_of_a_region_can_be_trained(scene, is_inside, damaged_file):
    report = plan_edit(damaged_file, [Refit(Remove(CENTER_BALL), 1)], data=scene, context=QUIET_CONTEXT)
    assert report.actions[0].gaussians_trained == (~is_inside).sum()
    assert report.actions[0].action.startswith("refit all but the sphere")


def test_a_region_without_gaussians_or_photos_is_refused(scene, model, damaged_file):
    nowhere = Refit(CropBox((90.0, 90.0, 90.0), (91.0, 91.0, 91.0)))
    with pytest.raises(HyrfError, match="its region holds no Gaussian"):
        plan_edit(damaged_file, [nowhere], data=scene, context=QUIET_CONTEXT)
    with pytest.raises(HyrfError, match="trained on photos, but no photos are given"):
        plan_edit(damaged_file, [Refit(CENTER_BALL)], context=QUIET_CONTEXT)
    hidden = copy.deepcopy(model)
    hidden.gaussians.positions[0] = torch.tensor([0.0, 0.0, 60.0])
    is_selected = np.arange(len(model)) == 0
    with pytest.raises(
        HyrfError, match="training photos shows the 1 Gaussian of the region in at least 16 pixels; .*larger"
    ):
        refit_region(hidden, is_selected, scene.train, 1)


def test_photos_without_a_pixel_to_train_on_change_nothing_that_is_not_finite(scene, model, is_inside):
    masked = [
        replace(
            view,
            load=lambda view=view: replace(view.load(), mask=np.zeros((view.camera.height, view.camera.width), bool)),
        )
        for view in scene.train
    ]
    trained = refit_region(model, is_inside, masked, 3)
    assert all(values.isfinite().all() for values in trained.parameters())


def test_the_command_trains_a_region(photos, damaged_file, tmp_path):
    options = ["--crop-sphere", "0,0,0,1", "--refit", "5", "--data", photos]
    report = json.loads(succeeded("edit", damaged_file, "-o", tmp_path / "out.hyrf", *options, "--json").stdout)
    assert report["actions"][0]["action"] == "refit the sphere of radius 1 around (0, 0, 0) for 5 steps"
    assert "PSNR there on held-out photos" in succeeded("edit", damaged_file, "--plan", *options).stdout
    assert "--data" in refused("edit", damaged_file, "--plan", *options[:4])


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        (["--refit", "5"], "--refit must follow"),
        (["--center", "--refit", "5"], "--refit must follow"),
        (["--crop-sphere", "0,0,0,1", "--refit", "0"], "--refit: steps is 0"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else None,
)
def test_options_that_make_no_sense_are_refused(options, problem):
    result = hyrfpack("edit", DEMO_MODEL_FILE, "--plan", *options)
    assert result.exit_code == 2 and problem in result.stderr and "Traceback" not in result.stderr


def test_a_part_of_a_merged_file_is_trained(scene, photos, damaged_file, tmp_path):
    merge_models([damaged_file, DEMO_MODEL_FILE], tmp_path / "both.hyrf")
    arguments = [tmp_path / "both.hyrf", "--plan", "--crop-sphere", "0,0,0,1", "--refit", "5", "--data", photos]
    assert "--part" in refused("edit", *arguments)
    assert "refit the sphere" in succeeded("edit", *arguments, "--part", "damaged").stdout
