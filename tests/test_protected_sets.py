"""Nothing is written over the photos and poses that a call reads: every path of every layout is protected."""

from __future__ import annotations

from pathlib import Path

import pytest
from photo_sets import READ_PATHS_BY_SET, write_photo_sets

from hyrfpack.data import load_scene
from hyrfpack.errors import HyrfError
from hyrfpack.export.folder import check_export_folder
from hyrfpack.export.kinds import EXPORT_ENDINGS, check_export_target
from hyrfpack.make.source import LoadSettings, Source
from hyrfpack.outputs import Outputs
from hyrfpack.poses import estimate_poses
from hyrfpack.scene import Scene

pytestmark = pytest.mark.unit
PROTECTED_PATHS = [(name, name + part) for name, parts in READ_PATHS_BY_SET.items() for part in parts]
PROTECTED_FOLDERS = [(name, path) for name, path in PROTECTED_PATHS if not Path(path).suffix]


@pytest.fixture(scope="module")
def sets_folder(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("sets")
    write_photo_sets(folder)
    return folder


@pytest.fixture(autouse=True)
def working_folder(sets_folder, monkeypatch):
    monkeypatch.chdir(sets_folder)


@pytest.mark.parametrize("overwrite", [False, True])
@pytest.mark.parametrize(("name", "path"), PROTECTED_PATHS)
def test_no_file_or_folder_replaces_what_a_scene_is_read_from(name, path, overwrite):
    outputs = Outputs("model.hyrf", scene=load_scene(name), overwrite=overwrite)

    with pytest.raises(HyrfError):
        outputs.file(path)
    with pytest.raises(HyrfError):
        outputs.folder(path, ["new.png"])


@pytest.mark.parametrize("overwrite", [False, True])
@pytest.mark.parametrize(("name", "folder"), PROTECTED_FOLDERS)
def test_nothing_new_is_written_beside_what_a_scene_is_read_from(name, folder, overwrite):
    outputs = Outputs(scene=load_scene(name), overwrite=overwrite)

    for ending in (".hyrf", ".png", ".md"):
        with pytest.raises(HyrfError):
            outputs.file(f"{folder}/new{ending}")
    for ending in EXPORT_ENDINGS:
        with pytest.raises(HyrfError):
            check_export_target(f"{folder}/new{ending}", outputs)


@pytest.mark.parametrize("overwrite", [False, True])
@pytest.mark.parametrize(
    ("read", "images", "output"),
    [
        ("nerfstudio", None, "nerfstudio/images/.."),
        ("link-to-set", None, "link-to-set"),
        ("link-to-set", None, "hall"),
        ("link-to-set", None, "hall/images"),
        ("views-of-its-own", "views", "views-of-its-own"),
    ],
)
def test_a_set_is_protected_under_each_of_its_names(read, images, output, overwrite):
    outputs = Outputs(scene=load_scene(read, images=images), overwrite=overwrite)

    for folder in (Path(output), Path(output).absolute()):
        with pytest.raises(HyrfError, match="reads what lies in this folder"):
            outputs.folder(folder, ["model.hyrf"])


@pytest.mark.parametrize("ending", EXPORT_ENDINGS)
def test_an_existing_export_is_replaced_only_with_overwrite(ending, tmp_path):
    (tmp_path / f"a{ending}").write_bytes(b"of another program")

    with pytest.raises(HyrfError, match="there is a file of this name"):
        check_export_target(tmp_path / f"a{ending}", Outputs("model.hyrf"))
    check_export_target(tmp_path / f"a{ending}", Outputs("model.hyrf", overwrite=True))


@pytest.mark.parametrize("name", READ_PATHS_BY_SET)
def test_a_set_that_is_not_read_is_written_to_only_with_overwrite(name):
    with pytest.raises(HyrfError, match="photos or poses lie in this folder"):
        Outputs("model.hyrf").folder(name, ["new.png"])
    with pytest.raises(HyrfError, match="photos or poses lie in this folder"):
        Outputs("model.hyrf").file(f"{name}/new.hyrf")
    Outputs("model.hyrf", overwrite=True).folder(name, ["new.png"])
    Outputs("model.hyrf", overwrite=True).file(f"{name}/new.hyrf")


@pytest.mark.parametrize("is_gallery", [False, True])
@pytest.mark.parametrize(("name", "folder"), PROTECTED_FOLDERS)
def test_a_player_is_not_written_among_photos_and_poses(name, folder, is_gallery):
    def check(scene: Scene | None, overwrite: bool) -> None:
        check_export_folder(folder, [], [scene], overwrite=overwrite, is_gallery=is_gallery)

    for overwrite in (False, True):
        with pytest.raises(HyrfError, match="reads what lies in this folder"):
            check(load_scene(name), overwrite)
    if folder == name:  # of a set that is not read, each folder with photos or poses
        with pytest.raises(HyrfError, match="photos or poses lie in this folder"):
            check(None, overwrite=False)
    check(None, overwrite=True)


@pytest.mark.parametrize("overwrite", [False, True])
@pytest.mark.parametrize(("name", "folder"), PROTECTED_FOLDERS)
def test_make_protects_the_photos_and_poses_of_its_source(name, folder, overwrite):
    source = Source.from_path(Path(name), LoadSettings(None, 0, None))

    for output in (folder, f"{folder}/new.html"):
        with pytest.raises(HyrfError):
            source.output_rules(overwrite).file(output)


@pytest.mark.parametrize("overwrite", [False, True])
@pytest.mark.parametrize(("name", "path"), PROTECTED_PATHS)
def test_poses_are_not_written_over_photos_and_poses_of_others(name, path, overwrite):
    with pytest.raises(HyrfError):
        estimate_poses(name, path, overwrite=overwrite)
