"""The estimation of poses from end to end, on photos with known poses."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
from commands import refused, succeeded

import hyrfpack
from hyrfpack.poses.alignment import align_poses


def poses_of(scene: hyrfpack.Scene) -> dict[str, np.ndarray]:
    return {view.name: view.camera.camera_from_world[:3] for view in scene.views}


def test_estimated_poses_match_the_true_ones_for_photos_of_any_name(photos_and_poses, estimated_scene):
    folder, known = photos_and_poses
    out, report, _ = estimated_scene
    scene = hyrfpack.load_scene(out)
    assert align_poses(poses_of(scene), known).agreeing == set(known)
    assert (report.photos, report.registered, report.left_out) == (len(known), len(known), {})
    assert report.sure == len(known)
    assert report.mapper in ("incremental", "global") and report.why.startswith(
        f"the {report.mapper} mapper was chosen"
    )


def test_points_lie_on_the_walls_and_have_the_photos_colours(photos_and_poses, estimated_scene):
    scene = hyrfpack.load_scene(estimated_scene[0])
    found = align_poses(poses_of(scene), photos_and_poses[1])
    points = found.scale * scene.points @ found.rotation.T + found.shift
    off = np.abs(points).min(axis=1)  # the walls are x = 0, y = 0 and z = 0
    assert np.median(off) < 0.02
    assert len(scene.points) > 100
    assert scene.point_colors.std() > 0.1


def test_photos_are_copied_and_intermediate_files_are_removed(photos_and_poses, estimated_scene):
    folder, known = photos_and_poses
    out = estimated_scene[0]
    assert sorted(os.listdir(out)) == ["images", "poses.json", "sparse"]
    for name in known:
        assert (folder / name).read_bytes() == (out / "images" / name).read_bytes()
        assert not os.path.samefile(folder / name, out / "images" / name)
    assert any("edits there do not change yours" in note for note in estimated_scene[1].notes)
    written = json.loads((out / "poses.json").read_text())
    assert written["registered"] == len(known) and written["why"] == estimated_scene[1].why


def test_progress_runs_from_0_to_1(estimated_scene):
    shares = [event.share for event in estimated_scene[2]]
    assert shares[0] == 0 and shares == sorted(shares) and 0.9 < shares[-1] <= 1
    assert any("matching pair" in event.task for event in estimated_scene[2])


def test_existing_poses_are_replaced_only_with_overwrite(photos_and_poses, estimated_scene, tmp_path):
    out = tmp_path / "scene"
    shutil.copytree(estimated_scene[0], out)
    before = (out / "sparse" / "0" / "images.bin").read_bytes()
    assert "--overwrite" in refused("poses", photos_and_poses[0], "-o", out)
    (out / "poses.json").unlink()
    assert "poses of another program" in refused("poses", photos_and_poses[0], "-o", out, "--overwrite")
    assert (out / "sparse" / "0" / "images.bin").read_bytes() == before


def test_the_command_prints_its_result_and_the_next_command(estimated_scene, monkeypatch, tmp_path):
    out, report, *_ = estimated_scene
    partly = {"a.jpg": "blurred", "b.jpg": "blurred"}
    made = type(report)(**{**vars(report), "left_out": partly, "scene": Path("scenes/garden")})
    monkeypatch.setattr("hyrfpack.poses.estimate_poses", lambda *args, **settings: made)
    said = succeeded("poses", tmp_path, "-o", "scenes/garden").stdout
    assert f"{report.registered} of {report.photos} photos have a pose, {report.sure} confirmed by both mappers" in said
    assert "left out, blurred: a.jpg, b.jpg" in said
    assert "next: hyrfpack train scenes/garden -o runs/garden" in said


@pytest.mark.parametrize("wrong", [{"matching": "guess"}, {"seed": -1}])
def test_a_wrong_setting_is_rejected_at_once(wrong, photos_and_poses, tmp_path):
    with pytest.raises(ValueError, match="matching is 'guess'|seed is -1"):
        hyrfpack.estimate_poses(photos_and_poses[0], tmp_path / "scene", hyrfpack.PosesConfig(**wrong))
    assert not (tmp_path / "scene").exists()
