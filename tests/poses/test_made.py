"""Nothing is removed from a scene's folder but what an estimation put there and does not read."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import hyrfpack
from hyrfpack.poses.made import still_there


def photos(folder: Path, seed: int = 0) -> Path:
    folder.mkdir(parents=True)
    rng = np.random.default_rng(seed)
    for number in range(4):
        Image.fromarray(rng.integers(0, 255, (20, 30, 3), np.uint8)).save(folder / f"{number}.png")
    return folder


def begin(source: Path, scene: Path, **settings) -> None:
    """Estimate until the photos are in the scene's folder."""

    def stop(doing: str, share: float) -> None:
        if "features" in doing:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        hyrfpack.estimate_poses(source, scene, report=stop, **settings)


def finished(source: Path, scene: Path) -> None:
    """What a whole estimation leaves, but for the model."""
    begin(source, scene)
    made = json.loads((scene / ".poses" / "made.json").read_text())
    (scene / "poses.json").write_text(json.dumps({"mapper": "global", "registered": 4, "made": made}))
    shutil.rmtree(scene / ".poses")
    (scene / "sparse" / "0").mkdir(parents=True)


def pictures(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.glob("*.png"))


def test_links_that_are_all_that_is_left_of_the_photos_are_posed_again_in_place(tmp_path):
    finished(photos(tmp_path / "photos"), tmp_path / "scene")
    shutil.rmtree(tmp_path / "photos")
    for source in (tmp_path / "scene", tmp_path / "scene" / "images"):
        begin(source, tmp_path / "scene", overwrite=True)
        assert pictures(tmp_path / "scene" / "images") == ["0.png", "1.png", "2.png", "3.png"]


def test_photos_beside_the_links_to_them_go_on_where_they_were(tmp_path):
    scene, said = photos(tmp_path / "scene"), []
    begin(scene, scene)
    begin(scene, scene, say=said.append)
    assert said == ["an interrupted estimation goes on"]
    begin(scene, scene, seed=1)
    assert pictures(scene) == pictures(scene / "images") == ["0.png", "1.png", "2.png", "3.png"]


def test_other_photos_take_the_place_of_those_that_we_put_there_and_of_no_others(tmp_path):
    finished(photos(tmp_path / "photos"), tmp_path / "scene")
    begin(photos(tmp_path / "others", 1), tmp_path / "scene", overwrite=True)
    images = tmp_path / "scene" / "images"
    assert (images / "0.png").samefile(tmp_path / "others" / "0.png")
    Image.new("RGB", (30, 20)).save(images / "mine.png")
    with pytest.raises(hyrfpack.HyrfError, match="not of these photos"):
        hyrfpack.estimate_poses(tmp_path / "photos", tmp_path / "scene", overwrite=True)
    assert pictures(images) == ["mine.png"]


def test_photos_that_are_refused_leave_what_is_there(tmp_path):
    finished(photos(tmp_path / "photos"), tmp_path / "scene")
    (tmp_path / "none").mkdir()
    with pytest.raises(hyrfpack.HyrfDataError, match="no photos here"):
        hyrfpack.estimate_poses(tmp_path / "none", tmp_path / "scene", overwrite=True)
    assert len(pictures(tmp_path / "scene" / "images")) == 4


def test_masks_that_lie_there_are_not_taken_for_those_that_were_named(tmp_path):
    photos(tmp_path / "photos")
    for folder, level in (("named", 255), ("scene/masks", 0)):
        (tmp_path / folder).mkdir(parents=True)
        Image.new("L", (30, 20), level).save(tmp_path / folder / "0.png")
    with pytest.raises(hyrfpack.HyrfError, match="masks: there are files that are not of these photos"):
        hyrfpack.estimate_poses(tmp_path / "photos", tmp_path / "scene", masks=tmp_path / "named")
    shutil.rmtree(tmp_path / "scene" / "masks")
    begin(tmp_path / "photos", tmp_path / "scene", masks=tmp_path / "named")
    assert (tmp_path / "scene" / "masks" / "0.png.png").samefile(tmp_path / "named" / "0.png")


@pytest.mark.parametrize("forged", ["{", "[]", '{"made": ["images"]}'])
def test_a_report_of_another_program_gives_nothing_away(forged, tmp_path):
    finished(photos(tmp_path / "photos"), tmp_path / "scene")
    (tmp_path / "scene" / "poses.json").write_text(forged)
    with pytest.raises(hyrfpack.HyrfError, match="poses of another program"):
        hyrfpack.estimate_poses(tmp_path / "photos", tmp_path / "scene", overwrite=True)
    assert (tmp_path / "scene" / "sparse" / "0").is_dir()


def test_a_record_lists_nothing_outside_the_scene_nor_what_has_changed(tmp_path):
    photos(tmp_path / "photos")
    images = photos(tmp_path / "scene" / "images")
    size = (images / "0.png").stat().st_size
    (tmp_path / "scene" / "masks").symlink_to(tmp_path / "photos")
    (tmp_path / "scene" / "own.txt").write_text("mine")
    forged = {
        "images/0.png": size,
        "images/1.png": 1,
        "images/../../photos/0.png": size,
        "masks/0.png": size,
        str(tmp_path / "photos" / "0.png"): size,
        "own.txt": 4,
        "": 0,
    }
    assert still_there(tmp_path / "scene", forged) == {"images/0.png": size}
