"""Photos still belong to a model that edits have moved."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from commands import succeeded
from numpy.testing import assert_allclose
from scenes import QUIET_CONTEXT

import hyrfpack
from hyrfpack.cameras.capture import PLACEMENT_KEY, Capture, place_photos
from hyrfpack.cameras.placement import Placement
from hyrfpack.config.edit import MinOpacity, Rotate, Scale, Translate
from hyrfpack.edit import edit_model, merge_models
from hyrfpack.errors import HyrfDataError
from hyrfpack.format import describe_file, save_model
from hyrfpack.format.codec import load_with_provenance
from tools.safety.train_golden import DEMO_MODEL_FILE

pytestmark = pytest.mark.usefixtures("quick_calibration")
TEST_MOVES = [Scale(2.5), Rotate((0.3, -1.0, 0.4), 130.0), Translate((3.0, -2.0, 0.5))]


@pytest.fixture
def moved(tmp_path: Path) -> Path:
    edit_model(DEMO_MODEL_FILE, tmp_path / "moved.hyrf", TEST_MOVES, context=QUIET_CONTEXT)
    return tmp_path / "moved.hyrf"


def test_a_moved_model_scores_on_its_photos_as_before(moved, photos, tmp_path):
    scores = [
        json.loads((run := succeeded("evaluate", model, "--data", photos, "--json")).stdout)["psnr"]
        for model in (DEMO_MODEL_FILE, moved)
    ]
    assert scores[1] == pytest.approx(scores[0], abs=0.02)
    assert "another coordinate frame" not in run.stderr


def test_moves_add_up_and_photos_that_were_moved_stay(moved, scene, tmp_path):
    edit_model(moved, tmp_path / "back.hyrf", [Translate((-3.0, 2.0, -0.5)), Scale(2.0)], context=QUIET_CONTEXT)
    facts = describe_file(tmp_path / "back.hyrf")
    placement = Placement.from_json(facts["provenance"][PLACEMENT_KEY])
    assert placement.factor == 5
    assert_allclose(placement.offset, 0, atol=1e-7)
    placed = place_photos(facts, scene)
    assert Capture(facts, placed).mismatch == "" != Capture(facts, scene).mismatch
    assert place_photos(facts, placed) is placed


def test_a_model_that_was_not_moved_states_no_placement(scene, tmp_path):
    edit_model(DEMO_MODEL_FILE, tmp_path / "cropped.hyrf", [MinOpacity(0.1)], context=QUIET_CONTEXT)
    facts = describe_file(tmp_path / "cropped.hyrf")
    assert PLACEMENT_KEY not in facts["provenance"] and place_photos(facts, scene) is scene


@pytest.mark.parametrize("stored", [None, 3, {}, {"factor": 1, "rotation": [1, 0, 0], "offset": [0, 0, 0]}], ids=str)
def test_an_invalid_placement_is_ignored_and_left_out_of_the_next_file(stored, scene, tmp_path):
    model, provenance = load_with_provenance(DEMO_MODEL_FILE)
    save_model(model, tmp_path / "odd.hyrf", provenance={**provenance, PLACEMENT_KEY: stored})
    assert place_photos(describe_file(tmp_path / "odd.hyrf"), scene) is scene
    edit_model(tmp_path / "odd.hyrf", tmp_path / "next.hyrf", [Scale(2.0)], context=QUIET_CONTEXT)
    assert PLACEMENT_KEY not in describe_file(tmp_path / "next.hyrf")["provenance"]


@pytest.mark.acceptance
def test_compressing_a_moved_model_with_photos_gives_the_numbers_of_one_that_was_not_moved(moved, scene, tmp_path):
    config = hyrfpack.CompressConfig(max_psnr_drop=0.5)
    files = {
        model: hyrfpack.compress_model(model, tmp_path / f"{model.stem}-small.hyrf", config, data=scene).bytes_after
        for model in (DEMO_MODEL_FILE, moved)
    }
    assert files[moved] == pytest.approx(files[DEMO_MODEL_FILE], rel=0.02)


def test_a_moved_model_can_be_edited_exported_and_split_with_its_photos(moved, photos, scene, tmp_path):
    report = edit_model(
        moved, tmp_path / "cleaned.hyrf", [MinOpacity(0.01), *TEST_MOVES], data=scene, context=QUIET_CONTEXT
    )
    assert report.psnr_after == pytest.approx(report.psnr_before, abs=0.3)
    succeeded("split", moved, "-o", tmp_path / "split", "--data", photos, "--levels", "1")
    succeeded("export", moved, "-o", tmp_path / "cameras.json", "--data", photos)
    frames = json.loads((tmp_path / "cameras.json").read_text())["frames"]
    centers = np.array([frame["transform_matrix"] for frame in frames])[:, :3, 3]
    expected = np.array([view.camera.position for view in place_photos(describe_file(moved), scene).train])
    assert_allclose(np.sort(centers, axis=0), np.sort(expected, axis=0), atol=1e-5)


def test_a_part_that_was_moved_while_merging_keeps_its_photos(scene, tmp_path):
    merge_models(
        [DEMO_MODEL_FILE, DEMO_MODEL_FILE.with_name("demo_compact.hyrf")],
        tmp_path / "merged.hyrf",
        moves={DEMO_MODEL_FILE.stem: TEST_MOVES},
    )
    facts = describe_file(tmp_path / "merged.hyrf")
    assert Capture(facts, place_photos(facts, scene)).mismatch == "" != Capture(facts, scene).mismatch


def test_photos_of_another_frame_are_refused_as_before(moved, scene):
    elsewhere = Placement.translation((100.0, 0.0, 0.0)).move_scene(scene)
    with pytest.raises(HyrfDataError, match="another coordinate frame"):
        hyrfpack.plan_edit(moved, [MinOpacity(0.1)], data=elsewhere)
