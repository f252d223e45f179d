"""The checks that protect a user's files, called directly; `test_every_command` checks each command."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path

import pytest
from scenes import QUIET_CONTEXT

from hyrfpack.data import load_scene
from hyrfpack.demo.scene import write_demo_scene
from hyrfpack.errors import HyrfError
from hyrfpack.outputs import Outputs
from hyrfpack.train import TrainConfig, train_model

TINY_TRAIN_CONFIG = TrainConfig(steps=2, max_gaussians=50)


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    """A set of three photos, in nerfstudio's layout."""
    return write_demo_scene(tmp_path / "photos", views=3, size=16)


@pytest.fixture
def model(tmp_path: Path) -> Path:
    path = tmp_path / "model.hyrf"
    path.write_bytes(b"a model")
    return path


def test_new_files_and_folders_are_allowed_and_not_yet_created(tmp_path, model):
    Outputs(model).file(tmp_path / "new" / "small.hyrf", ".hyrf")
    Outputs(model).folder(tmp_path / "pictures", ["0000.png", "left/0001.png"])

    assert list(tmp_path.iterdir()) == [model]


@pytest.mark.parametrize("name", ["model.hyrf", "soft.hyrf", "hard.hyrf", "sub/../model.hyrf"])
@pytest.mark.parametrize("overwrite", [False, True])
def test_an_input_is_never_replaced_under_any_of_its_names(name, overwrite, tmp_path, model):
    (tmp_path / "sub").mkdir()
    (tmp_path / "soft.hyrf").symlink_to(model)
    os.link(model, tmp_path / "hard.hyrf")

    with pytest.raises(HyrfError, match="the output is an input itself"):
        Outputs(model, overwrite=overwrite).file(tmp_path / name)
    with pytest.raises(HyrfError, match="the output is an input itself"):
        Outputs(model, overwrite=overwrite).folder(tmp_path, [name])


@pytest.mark.parametrize("place", [".", "images", "elsewhere/..", "images/left"])
@pytest.mark.parametrize("overwrite", [False, True])
def test_nothing_is_written_into_a_folder_whose_photos_and_poses_are_read(place, overwrite, photos):
    (photos / "elsewhere").mkdir()
    (photos / "images" / "left").mkdir()
    first, poses = photos / "images" / "0000.png", photos / "transforms.json"
    first.rename(photos / "images" / "left" / "0000.png")
    poses.write_text(poses.read_text().replace("images/0000", "images/left/0000"))
    outputs = Outputs(scene=load_scene(photos), overwrite=overwrite)

    with pytest.raises(HyrfError, match="the same command reads what lies in this folder"):
        outputs.file(photos / place / "new.hyrf")
    with pytest.raises(HyrfError, match="the same command reads what lies in this folder"):
        outputs.folder(photos / place, ["new.png"])
    outputs.folder(photos / "run", ["new.png"])


def test_existing_files_are_replaced_only_with_overwrite(tmp_path, model):
    (tmp_path / "old.spz").write_bytes(b"of another program")
    (tmp_path / "dangling.spz").symlink_to(tmp_path / "nowhere")

    for name in ("old.spz", "dangling.spz"):
        with pytest.raises(HyrfError, match="there is a file of this name; .* `overwrite=True`"):
            Outputs(model).file(tmp_path / name)
        with pytest.raises(HyrfError, match=f"{name} of the files to be written is there; .* `overwrite=True`"):
            Outputs(model).folder(tmp_path, ["new.spz", name])
    Outputs(model, overwrite=True).file(tmp_path / "old.spz")
    Outputs(model, overwrite=True).folder(tmp_path, ["old.spz"])


@pytest.mark.parametrize("place", ["", "images"])
def test_folders_of_other_photos_are_protected_too(place, photos, model):
    with pytest.raises(HyrfError, match="photos or poses lie in this folder"):
        Outputs(model).file(photos / place / "new.hyrf")
    with pytest.raises(HyrfError, match="photos or poses lie in this folder"):
        Outputs(model).folder(photos / place, ["new.png"])
    Outputs(model, overwrite=True).file(photos / place / "new.hyrf")


def test_tables_of_a_reconstruction_count_as_poses(tmp_path, model):
    table = tmp_path / "sparse" / "0" / "cameras.bin"
    table.parent.mkdir(parents=True)
    table.write_bytes(b"")

    for refused in (table.parent, tmp_path):
        with pytest.raises(HyrfError, match="photos or poses lie in this folder"):
            Outputs(model).folder(refused, ["new.png"])


def test_a_folder_counts_as_poses_by_its_files_and_not_by_its_name(tmp_path, model):
    for name in ("sparse", "colmap"):
        (tmp_path / name).mkdir()
    (tmp_path / "screenshot.png").write_bytes(b"")

    Outputs(model).file(tmp_path / "scene.html")


def test_pictures_beside_a_single_new_file_do_not_matter(tmp_path, model):
    """A desktop with screenshots is no set of photos. A run folder inside a set has pictures of its own."""
    (tmp_path / "screenshot.png").write_bytes(b"")
    (tmp_path / "photos").mkdir()
    run = write_demo_scene(tmp_path / "photos", views=2, size=16) / "run"
    run.mkdir()
    (run / "model.hyrf").write_bytes(b"")
    (run / "curve.png").write_bytes(b"")

    Outputs(model).file(tmp_path / "scene.html")
    Outputs(model).file(run / "small.hyrf")


@pytest.mark.parametrize(
    "name, words",
    [
        ("small.ply", "extension must be .hyrf"),
        ("small", "extension must be .hyrf"),
        ("folder", "this is a folder"),
        ("file/small.hyrf", "is a file, not a folder"),
        ("a" * 300 + ".hyrf", "longer than 255 bytes"),
        ("a" * 300 + "/small.hyrf", "longer than 255 bytes"),
        ("aaaa/" * 1000 + "small.hyrf", "longer than 4095 bytes"),
        ("\N{CJK UNIFIED IDEOGRAPH-6F22}" * 90 + ".hyrf", "longer than 255 bytes"),
    ],
)
def test_an_output_that_cannot_be_written_is_an_error_before_the_work(name, words, tmp_path):
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").write_bytes(b"")

    with pytest.raises(HyrfError, match=words):
        Outputs().file(tmp_path / name, ".hyrf")


def test_an_empty_path_is_not_the_current_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(HyrfError, match="'' is not a path"):
        Outputs().folder("", ["index.html"])


def test_a_working_folder_that_was_removed_is_a_clear_error(tmp_path, monkeypatch):
    (tmp_path / "gone").mkdir()
    monkeypatch.chdir(tmp_path / "gone")
    (tmp_path / "gone").rmdir()

    with pytest.raises(HyrfError, match="the path cannot be resolved"):
        Outputs().file("small.hyrf")
    with pytest.raises(HyrfError, match="the path cannot be resolved"):
        Outputs().folder("pictures", ["0000.png"])


@pytest.mark.skipif(not os.path.exists("/dev/null"), reason="there is no /dev/null")
def test_a_device_is_rejected_as_an_output_file():
    with pytest.raises(HyrfError, match="device or a pipe"):
        Outputs(overwrite=True).file("/dev/null")


def test_a_file_is_rejected_as_a_folder_for_pictures(model):
    with pytest.raises(HyrfError, match="this is a file; name a folder"):
        Outputs().folder(model, ["0000.png"])


# -- training: the library call checks as the command line does -------------------------------------------------------


@pytest.mark.parametrize("overwrite", [False, True])
def test_training_never_writes_into_the_folder_of_its_photos(overwrite, photos):
    before = {path: path.read_bytes() for path in photos.rglob("*") if path.is_file()}
    scene = load_scene(photos, test_every=2)

    for place in (photos, photos / "images"):
        with pytest.raises(HyrfError, match="the same command reads"):
            train_model(scene, place, TINY_TRAIN_CONFIG, overwrite=overwrite, context=QUIET_CONTEXT)

    assert {path: path.read_bytes() for path in photos.rglob("*") if path.is_file()} == before


def test_training_never_replaces_photos_in_its_output_folder(photos):
    (photos / "images").rename(photos / "views")
    poses = photos / "transforms.json"
    poses.write_text(poses.read_text().replace("images/", "views/"))

    with pytest.raises(HyrfError, match="the same command reads"):
        train_model(load_scene(photos, test_every=2), photos, TINY_TRAIN_CONFIG, overwrite=True, context=QUIET_CONTEXT)


@pytest.mark.integration
def test_training_keeps_a_foreign_metrics_json_without_overwrite(photos, tmp_path):
    out = tmp_path / "run"
    out.mkdir()
    (out / "metrics.json").write_text("mine")
    scene = dataclasses.replace(load_scene(photos), test=[])

    with pytest.raises(HyrfError, match="metrics.json of the files to be written is there"):
        train_model(scene, out, TINY_TRAIN_CONFIG, context=QUIET_CONTEXT)
    assert (out / "metrics.json").read_text() == "mine"

    train_model(scene, out, TINY_TRAIN_CONFIG, overwrite=True, context=QUIET_CONTEXT)
    assert (out / "metrics.json").read_text() != "mine"
